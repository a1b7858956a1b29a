"""Power cuts in a capture, in the repair of a crash and in the replacement of a position."""

import numpy as np

from tests.system.crash.campaign import acknowledged
from tests.system.crash.power_cuts import Disk, Kind, Share, images, read_log
from tests.system.crash.processes import How, Order

# Random subsets of what was not synced, for each call: as few as give the cuts that are wanted.
SUBSETS = (0, 8, 16, 32, 64, 128)
FEW = 10
# Cuts of each of many repairs.
PER_STATE = 40


def in_capture(campaign, chance, share):
    """Cut the power in a capture, from the making of the bank on."""
    campaign.clear()
    yield from _cut(campaign, campaign.capture, chance, set(), share)


def in_repair(campaign, chance, share):
    """Cut the power in a resume, after a kill within any commit."""
    calls = campaign.calls
    while True:
        campaign.clear()
        order = Order(How.KILL_WITHIN, chance.randrange(calls // 4, calls), chance.choice((512, 1000, 4608)))
        ended = campaign.processes.run(*campaign.capture, order=order)
        if campaign.bank.exists():
            yield from _cut(campaign, campaign.resume, chance, acknowledged(ended.out), Share(PER_STATE))


def in_remeasure(campaign, chance, share):
    """Cut the power while a position is replaced."""
    campaign.put(campaign.captured)
    everything = set(range(len(campaign.rows)))
    yield from _cut(campaign, campaign.remeasure, chance, everything, share, remeasure=True)


def _cut(campaign, command, chance, promised, share, *, remeasure=False):
    log_path = campaign.folder / "calls.log"
    before = {path: path.read_bytes() if path.is_file() else None for path in campaign.lying_there()}
    inodes = {path: path.stat().st_ino for path in before}
    ended = campaign.processes.run(*command, log=log_path)
    assert ended.code == 0, ended.err
    log = read_log(log_path)
    # After how many calls which positions were told to be in; the log of events says so before anyone else.
    told = [
        (step, acknowledged(call.data.decode()))
        for step, call in enumerate(log, 1)
        if call.kind is Kind.WRITE and call.path.endswith(".events.jsonl")
    ]
    seed = chance.randrange(1 << 30)
    # Until the bank has its name there is nothing in it to lose: torn writes alone are tried.
    named = next((step for step, call in enumerate(log) if call.kind is Kind.LINK), 0)

    def found(subsets, some=None):
        return images(Disk(before, inodes), log, np.random.default_rng(seed), subsets, named, some)

    chosen = found(0, share.count)
    if share.count > FEW:  # evenly among those that differ
        for subsets in SUBSETS:
            total = sum(1 for _ in found(subsets))
            if total >= share.count:
                break
        chosen = share.of(found(subsets), total)
    for image in chosen:
        campaign.put(image.files, image.folders)
        so_far = promised.union(*(positions for step, positions in told if step <= image.step))
        yield 1, campaign.outcome(so_far, remeasure=remeasure)
