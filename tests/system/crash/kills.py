"""Kills: at random moments, and at every call that changes a file, also while a crash is being repaired."""

import itertools
import time

from tests.system.crash.campaign import acknowledged, badly_told
from tests.system.crash.processes import How, Order

# Of a resume's calls these are repair; then it measures as any capture does.
REPAIR_CALLS, SECONDS = 14, 5


def at_random(campaign, chance, share):
    """Kill a capture at any moment; one in three resumes is killed as well."""
    campaign.clear()
    start_s = time.monotonic()
    campaign.processes.run(*campaign.capture)
    longest_s = time.monotonic() - start_s
    while True:
        campaign.clear()
        ended = campaign.processes.run_for(chance.uniform(0, longest_s), *campaign.capture)
        killed, promised = int(ended.killed), acknowledged(ended.out)
        if ended.killed and campaign.bank.exists() and chance.random() < 1 / 3:
            again = campaign.processes.run_for(chance.uniform(0, longest_s), *campaign.resume)
            killed, promised = killed + again.killed, promised | acknowledged(again.out)
        if killed:
            yield killed, badly_told(ended, {0}) + campaign.outcome(promised)


def at_calls(campaign, chance, share):
    """Kill a capture before and within each of its calls, from the bank's creation on."""
    yield from _at_each_call(campaign, campaign.capture, campaign.calls, {}, set(), chance, share)


def in_remeasure(campaign, chance, share):
    """Kill the replacement of a position, before and within each call."""
    everything = set(range(len(campaign.rows)))
    of_all = campaign.remeasure_calls, campaign.captured, everything
    yield from _at_each_call(campaign, campaign.remeasure, *of_all, chance, share)


def _at_each_call(campaign, command, calls, before, promised, chance, share):
    places = itertools.product(range(1, calls + 1), (How.KILL_BEFORE, How.KILL_WITHIN))
    for call, how in share.of(places, 2 * calls):
        campaign.put(before)
        ended = campaign.processes.run(*command, order=Order(how, call, _part(chance)))
        notes = campaign.outcome(promised | acknowledged(ended.out), remeasure=bool(before))
        yield int(ended.killed), badly_told(ended, {0}) + notes


def in_repair(campaign, chance, share):
    """Kill a capture at some call and then, at each of the first calls of the resume, that too."""
    calls = campaign.calls
    while True:
        first = Order(How.KILL_WITHIN, chance.randrange(calls // 4, calls + 1), _part(chance))
        campaign.clear()
        ended = campaign.processes.run(*campaign.capture, order=first)
        left = {str(path): path.read_bytes() for path in campaign.lying_there() if path.is_file()}
        if not campaign.bank.exists() or not ended.killed:
            continue
        for second in chance.sample(range(1, REPAIR_CALLS + 1), SECONDS):
            campaign.put(left)
            how = chance.choice((How.KILL_BEFORE, How.KILL_WITHIN))
            again = campaign.processes.run(*campaign.resume, order=Order(how, second, _part(chance)))
            notes = campaign.outcome(acknowledged(ended.out) | acknowledged(again.out))
            yield int(again.killed), badly_told(again, {0}) + notes


def _part(chance):
    return chance.choice((0, 1, 512, 1000, 4096, 4608, 100_000))
