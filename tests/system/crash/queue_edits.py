"""Kills, full and failing disks while a queue file is edited: it is the older or the newer one, and can be edited."""

from __future__ import annotations

import errno
import itertools
import random
from collections.abc import Generator

from tests.system.crash.campaign import Campaign, Verdict
from tests.system.crash.processes import How, Order
from tests.system.crash.shares import Share
from wavefocus.acquisition.run_queue import add_entry, read_queue
from wavefocus.storage.errors import InputError

NAME = "night.queue.json"
WAYS = (
    (How.KILL_BEFORE, 0),
    (How.KILL_WITHIN, 0),
    (How.KILL_AFTER, 0),
    (How.FAIL_ON, errno.ENOSPC),
    (How.FAIL_ONCE, errno.EIO),
)


def at_calls(campaign: Campaign, chance: random.Random, share: Share) -> Generator[Verdict, None, None]:
    """Move a run of a queue of two, with a fault at each call of the command."""
    queue, processes = campaign.lab / NAME, campaign.processes
    queue.unlink(missing_ok=True)
    for bank in ("a.h5", "b.h5"):
        add_entry(queue, ["check", bank], campaign.lab)
    before = queue.read_bytes()
    around = {path.name for path in campaign.lab.iterdir()}
    calls = processes.run("queue", "move", queue, 2, 1).calls or 0
    trials = list(itertools.product(range(1, calls + 1), WAYS))
    for call, (how, error) in share.evenly(trials, len(trials)):
        queue.write_bytes(before)
        ended = processes.run("queue", "move", queue, 2, 1, order=Order(how, call, error=error or errno.ENOSPC))
        verdict = Verdict()
        if ended.code not in {0, 2, -9} or "Traceback" in ended.err:
            verdict.note("badly_told", f"{how.name} at call {call}: exit {ended.code}: {ended.err[-200:]}")
        try:
            order = [entry.number for entry in read_queue(queue)]
        except InputError as unreadable:
            verdict.note("unreadable", str(unreadable))
        else:
            if sorted(order) != [1, 2]:
                verdict.note("lost", f"{how.name} at call {call}: runs {order} are left")
            elif ended.code == 0 and order != [2, 1]:
                verdict.note("wrong", f"{how.name} at call {call}: done, and the order is {order}")
        if processes.run("queue", "add", queue, "check", "c.h5").code != 0:
            verdict.note("badly_told", f"{how.name} at call {call}: the next edit is refused")
        if left := {path.name for path in campaign.lab.iterdir()} - around:
            verdict.note("badly_told", f"left behind: {left}")
        yield verdict
    queue.unlink(missing_ok=True)
