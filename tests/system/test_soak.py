"""A few faults of every class that ``make soak`` tries by the thousand, in the same way."""

import random
import sys

import pytest

from tests.system.crash import cuts, kills, other_faults
from tests.system.crash.campaign import Campaign
from tests.system.crash.soak import Trials

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD and /proc are Linux's"),
    pytest.mark.may_skip("what is loaded before the program sees the calls of Linux"),
]


@pytest.fixture
def campaign(tmp_path):
    one = Campaign(tmp_path)
    yield one
    one.close()


def test_kills_cuts_full_disks_and_flipped_bytes_lose_nothing(campaign):
    classes: list[tuple[Trials, int]] = [
        (kills.at_calls, 2),
        (kills.in_repair, 1),
        (kills.in_remeasure, 1),
        (cuts.in_capture, 2),
        (cuts.in_remeasure, 1),
        (other_faults.full_disk, 1),
        (other_faults.failing_disk, 1),
        (other_faults.flipped_bytes, 1),
    ]
    for trials, count in classes:
        faults = 0
        for verdict in trials(campaign, random.Random(1), count):
            assert verdict.notes == [], trials
            faults += verdict.faults
            if faults >= count:
                break
        assert faults >= count, trials
