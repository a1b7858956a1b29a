"""Faults of every kind lose nothing: a few in each change, by the thousand in the nightly ``make soak``."""

import random
import sys

import pytest

from tests.system.crash import cuts, kills, other_faults
from tests.system.crash.campaign import Campaign

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD and /proc are Linux's"),
    pytest.mark.may_skip("what is loaded before the program sees the calls of Linux"),
]
# Of each kind: how many in each change, in the soak, and there with recordings kept.
KINDS = {
    "killed at a random moment": (kills.at_random, 0, 480, 50),
    "killed before or within each call of a capture": (kills.at_calls, 2, 300, 100),
    "killed again while resume repairs": (kills.in_repair, 1, 360, 0),
    "killed while a position is replaced": (kills.in_remeasure, 1, 96, 50),
    "power cut in a capture": (cuts.in_capture, 2, 2640, 150),
    "power cut while resume repairs": (cuts.in_repair, 0, 880, 0),
    "power cut while a position is replaced": (cuts.in_remeasure, 1, 880, 50),
    "disk full from any call on": (other_faults.full_disk, 1, 150, 0),
    "any call fails once": (other_faults.failing_disk, 1, 150, 0),
    "disk dead from any call on": (other_faults.dead_disk, 0, 150, 0),
    "flipped byte": (other_faults.flipped_bytes, 1, 600, 0),
    "second process, or as the first is killed": (other_faults.second_process, 0, 100, 0),
}
SOAK = [(name, False) for name in KINDS] + [(name, True) for name, (*_, raw) in KINDS.items() if raw]


def tried(campaign, name, count):
    """What is wrong after so many faults of a kind; prints its row of the page's table."""
    faults, wrong = 0, list[str]()
    found = KINDS[name][0](campaign, random.Random(name), count)
    while faults < count and (one := next(found, None)):
        faults, wrong = faults + one[0], wrong + one[1]
    found.close()
    sys.stdout.write(f"| {name} | {faults:,} | {len(wrong)} |\n")
    assert faults > 0.9 * count
    return [f"{name}: {note}" for note in wrong]


def test_kills_cuts_full_disks_and_flipped_bytes_lose_nothing(tmp_path):
    with Campaign(tmp_path) as campaign:
        assert not [note for name, (_, few, *_) in KINDS.items() if few for note in tried(campaign, name, few)]


@pytest.mark.nightly
@pytest.mark.timeout(7200)
@pytest.mark.parametrize(("name", "keep_raw"), SOAK)
def test_faults_by_the_hundred_lose_nothing(tmp_path, name, keep_raw):
    with Campaign(tmp_path, keep_raw=keep_raw) as campaign:
        assert not tried(campaign, name, KINDS[name][2 + keep_raw])
