"""Faults of every kind lose nothing: a few in each change, by the thousand in the nightly ``make soak``."""

import random
import sys
from errno import EIO, ENOSPC
from functools import partial
from math import ceil

import pytest

from tests.system.crash import cuts, kills, other_faults
from tests.system.crash.campaign import Campaign
from tests.system.crash.power_cuts import Share
from tests.system.crash.processes import How
from tests.system.lines import of_linux

pytestmark = of_linux("what is loaded before the program sees the calls of Linux")
# Faults of one test of the soak, so that workers end at about the same time.
AT_ONCE = 240
# Of each kind: how many in each change, in the soak, and there with recordings kept.
KINDS = {
    "killed at a random moment": (kills.at_random, 0, 480, 50),
    "killed before or within each call of a capture": (kills.at_calls, 2, 300, 100),
    "killed again while resume repairs": (kills.in_repair, 1, 360, 0),
    "killed while a position is replaced": (kills.in_remeasure, 1, 96, 50),
    "power cut in a capture": (cuts.in_capture, 2, 2640, 150),
    "power cut while resume repairs": (cuts.in_repair, 0, 880, 0),
    "power cut while a position is replaced": (cuts.in_remeasure, 1, 880, 50),
    "disk full from any call on": (partial(other_faults.failing_disk, How.FAIL_ON, ENOSPC), 1, 150, 0),
    "any call fails once": (partial(other_faults.failing_disk, How.FAIL_ONCE, EIO), 1, 150, 0),
    "disk dead from any call on": (partial(other_faults.failing_disk, How.FAIL_ON, EIO), 0, 150, 0),
    "flipped byte": (other_faults.flipped_bytes, 1, 600, 0),
    "second process, or as the first is killed": (other_faults.second_process, 0, 100, 0),
}
SOAK = [
    pytest.param(keep_raw, name, counts[keep_raw], part, id=f"{name}{', recordings kept' * keep_raw}, {part + 1}")
    for keep_raw in (False, True)
    for name, (_, _, *counts) in KINDS.items()
    for part in range(ceil(counts[keep_raw] / AT_ONCE))
]


@pytest.fixture(scope="module")
def campaign(request, tmp_path_factory):
    """The campaign that all faults happen to; it keeps its recordings where that is asked for."""
    with Campaign(tmp_path_factory.mktemp("soak"), keep_raw=getattr(request, "param", False)) as one:
        yield one


def tried(campaign, name, count, part=0):
    """What is wrong after a part of so many faults of a kind; prints its row for the page's table."""
    share = Share(count, part, ceil(count / AT_ONCE))
    wanted = len(range(count)[part :: share.parts])
    faults, wrong = 0, list[str]()
    found = KINDS[name][0](campaign, random.Random(f"{name} {part}"), share)
    while faults < wanted and (one := next(found, None)):
        faults, wrong = faults + one[0], wrong + one[1]
    found.close()
    sys.stdout.write(f"| {name} | {faults:,} | {len(wrong)} |\n")
    assert faults > 0.9 * wanted
    return [f"{name}: {note}" for note in wrong]


def test_kills_cuts_full_disks_and_flipped_bytes_lose_nothing(campaign):
    assert not [note for name, (_, few, *_) in KINDS.items() if few for note in tried(campaign, name, few)]


@pytest.mark.nightly
@pytest.mark.timeout(3600)
@pytest.mark.parametrize(("campaign", "name", "count", "part"), SOAK, indirect=["campaign"])
def test_faults_by_the_hundred_lose_nothing(campaign, name, count, part):
    assert not tried(campaign, name, count, part)
