"""Kills: at random moments, and at every call that changes a file, also while a crash is being repaired."""

import itertools
import time
from pathlib import Path

from tests.system.crash.campaign import acknowledged, require_well_told
from tests.system.crash.power_cuts import evenly
from tests.system.crash.processes import How, Order

# Of a resume's calls these are repair; then it measures as any capture does.
REPAIR_CALLS, SECONDS = 14, 5


def at_random(campaign, chance, count):
    """Kill a capture at any moment; one in three resumes is killed as well."""
    campaign.clear()
    start_s = time.monotonic()
    campaign.processes.run(*campaign.capture)
    longest_s = time.monotonic() - start_s
    while True:
        campaign.clear()
        ended = campaign.interrupted(campaign.capture, lifetime_s=chance.uniform(0, longest_s))
        killed, promised = int(ended.killed), acknowledged(ended.out)
        if ended.killed and campaign.bank.exists() and chance.random() < 1 / 3:
            again = campaign.interrupted(campaign.resume, lifetime_s=chance.uniform(0, longest_s))
            killed, promised = killed + again.killed, promised | acknowledged(again.out)
        if killed:
            yield judged(campaign, ended, promised, killed)


def at_calls(campaign, chance, count):
    """Kill a capture before and within each of its calls, from the bank's creation on."""
    campaign.clear()
    calls = campaign.processes.run(*campaign.capture).calls or 0
    for order in evenly(_orders(calls, chance), 2 * calls, count):
        campaign.clear()
        ended = campaign.interrupted(campaign.capture, order)
        yield judged(campaign, ended, acknowledged(ended.out), int(ended.killed))


def in_repair(campaign, chance, count):
    """Kill a capture at some call and then, at each of the first calls of the resume, that too."""
    campaign.clear()
    calls = campaign.processes.run(*campaign.capture).calls or 0
    while True:
        first = chance.randrange(calls // 4, calls + 1)
        campaign.clear()
        ended = campaign.interrupted(campaign.capture, Order(How.KILL_WITHIN, first, _part(chance)))
        left = {str(path): path.read_bytes() for path in campaign.lying_there() if path.is_file()}
        if not campaign.bank.exists() or not ended.killed:
            continue
        for second in chance.sample(range(1, REPAIR_CALLS + 1), SECONDS):
            campaign.clear()
            for name, content in left.items():
                Path(name).parent.mkdir(exist_ok=True)
                Path(name).write_bytes(content)
            how = chance.choice((How.KILL_BEFORE, How.KILL_WITHIN))
            again = campaign.interrupted(campaign.resume, Order(how, second, _part(chance)))
            yield judged(campaign, again, acknowledged(ended.out) | acknowledged(again.out), int(again.killed))


def in_remeasure(campaign, chance, count):
    """Kill the replacement of a position, before and within each call."""
    campaign.restore(campaign.captured)
    calls = campaign.processes.run(*campaign.remeasure).calls or 0
    everything = set(range(len(campaign.rows)))
    for order in evenly(_orders(calls, chance), 2 * calls, count):
        campaign.restore(campaign.captured)
        ended = campaign.interrupted(campaign.remeasure, order)
        yield judged(campaign, ended, everything, int(ended.killed), remeasure=True)


def judged(campaign, ended, promised, faults, *, remeasure=False):
    """Look at what a fault left, go on to the end and look again."""
    verdict = campaign.judge(promised)
    verdict.faults = faults
    require_well_told(verdict, ended, {0})
    campaign.finish(verdict, remeasure=remeasure)
    return verdict


def _orders(calls, chance):
    for call, how in itertools.product(range(1, calls + 1), (How.KILL_BEFORE, How.KILL_WITHIN)):
        yield Order(how, call, _part(chance))


def _part(chance):
    return chance.choice((0, 1, 512, 1000, 4096, 4608, 100_000))
