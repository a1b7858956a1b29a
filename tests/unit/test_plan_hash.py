"""The hash of a plan: equal to that of banks that are there, and closed to keys that nobody has thought of."""

import json
from pathlib import Path
from typing import Annotated

import numpy as np
import pytest

import wavefocus as wf
from wavefocus.campaign.blueprint import blueprint_of
from wavefocus.config.fields import FREE, KEPT, Positive
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig, Sweep
from wavefocus.configuration import plan_sha256
from wavefocus.storage.bank.writer import create_bank

GOLDEN = json.loads((Path(__file__).parent / "golden" / "plan_hashes.json").read_text(encoding="utf-8"))
POSITION_MM = np.array(GOLDEN["position_mm"])


@pytest.mark.parametrize("case", GOLDEN["cases"], ids=lambda case: case["name"])
def test_a_plan_of_an_earlier_version_then_its_hash_is_the_one_that_its_bank_holds(case):
    rig = RigConfig.model_validate(case["rig"], context=KEPT)
    run = RunConfig.model_validate(case["run"], context=KEPT)
    assert plan_sha256(rig, run, POSITION_MM) == case["plan_sha256"]


def test_a_new_key_then_it_counts_unless_it_is_marked_and_old_banks_keep_their_hash():
    class LaterSweep(Sweep):
        fade_s: Positive = 0.01
        comment: Annotated[str, FREE] = ""

    class LaterRun(RunConfig):
        sweep: Sweep = LaterSweep()
        burst: LaterSweep = LaterSweep()

    def hashed(**tables):
        return plan_sha256(RigConfig.model_validate({}), LaterRun(**tables), POSITION_MM)

    before = GOLDEN["cases"][0]["plan_sha256"]
    assert hashed(sweep=LaterSweep(fade_s=0.02)) != before
    assert hashed(sweep=LaterSweep(comment="tried")) == hashed()
    # A table that is new as a whole counts as well.
    assert hashed(burst=LaterSweep(fade_s=0.02)) != hashed()


def test_keys_that_differ_from_those_of_a_bank_are_named_with_both_values(tmp_path):
    begun, other = (wf.virtual_rig(actuators=2, run={"sweep": {"stop_hz": stop_hz}}) for stop_hz in (500.0, 400.0))
    create_bank(tmp_path / "bank.h5", blueprint_of(begun.configuration).bank_header())
    with pytest.raises(wf.InputError, match=r"another plan.*sweep\.stop_hz \(500\.0, not 400\.0\)"):
        other.measure(tmp_path / "bank.h5")
