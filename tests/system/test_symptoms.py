"""A rig or a bank that is not as it was, verified: the symptom is named, and a sound one names none."""

import tomllib

import numpy as np
import pytest

from tests.lab_files import RUN, write_positions
from wavefocus.__main__ import run
from wavefocus.campaign.blueprint import bank_configuration, blueprint_of
from wavefocus.config.loading import validated
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import with_rig
from wavefocus.drives import render
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.verify.extra_measurements import measure_sentinel
from wavefocus.rendering.verify.results import sentence
from wavefocus.rendering.verify.scan import ScanPlan, scan
from wavefocus.rendering.verify.verdict import Verification, compare
from wavefocus.rig.setup import open_setup
from wavefocus.storage.bank.reading import Bank, open_bank

ACTUATOR_MM = [[110.0, 5.0], [10.0, 60.0], [-100.0, 20.0], [-15.0, -62.0]]
AXIS_MM = [-8.0, -4.0, 0.0, 4.0, 8.0]
RIG = f'[rig]\nname = "four coils"\n\n[actuators]\nposition_mm = {ACTUATOR_MM}\n'
SLOWER_WHEN_COLD = RUN + "speed_per_k = 0.02\n"
SCENE = """
[scene]
name = "stroke"

[[source]]
speed_mm_s = 100.0
step_mm = 4.0
path = { kind = "line", start_mm = [-4, 0], end_mm = [4, 0] }
signal = { kind = "noise", band_hz = [50, 450], duration_s = 0.03, seed = 1 }
emission = "per_point"

[output]
limit_v = 1.0
"""


@pytest.fixture(scope="module")
def measured_lab(tmp_path_factory):
    """A folder with a bank of 25 positions and 4 actuators, measured on a sound rig."""
    lab = tmp_path_factory.mktemp("sound")
    for name, text in (("rig.toml", RIG), ("run.toml", SLOWER_WHEN_COLD), ("scene.toml", SCENE)):
        (lab / name).write_text(text, encoding="utf-8")
    write_positions(lab, [(x, y) for y in AXIS_MM for x in AXIS_MM])
    assert run(["capture", str(lab / "run.toml"), "--bank", str(lab / "plate.h5")]) == 0
    return lab


def verified(bank: Bank, emulation: str, rows: list[int] | None = None, *, again: bool = True) -> Verification:
    """A scan of the lab's scene, on its rig with such an emulation, against the prediction from a bank."""
    configuration = bank_configuration(bank)
    rig = validated(RigConfig, tomllib.loads(f"{RIG}\n[emulation]\n{emulation}\n"), "rig.toml")
    scene_file = bank.path.parent / "scene.toml"
    drive = render(scene_file, bank)
    prediction = predict(drive, bank, rows, dtype=np.float32)
    plan = blueprint_of(with_rig(configuration, rig, "rig.toml")).plan
    with open_setup(rig, configuration.run) as setup:
        sentinel = measure_sentinel(plan, setup, bank) if again else None
        measured = scan(ScanPlan(tuple(prediction.position_index.tolist())), setup, drive, bank)
    return compare(prediction, measured, drive, bank, sentinel=sentinel)


@pytest.fixture(scope="module")
def sound(measured_lab):
    """The bank, open."""
    with open_bank(measured_lab / "plate.h5") as bank:
        yield bank


@pytest.mark.parametrize(
    ("emulation", "code", "actuators", "value"),
    [
        ("dead_actuators = [1]", "silent", (1,), None),
        ("room_c = 22", "speed", (), 2.0),
        ("mirror_map = [[1e-3, 0, 4e-3], [0, 1e-3, 0], [0, 0, 1]]", "mirror", (), (4.0, 0.0, 0.0)),
    ],
    ids=["silent", "faster", "mirror"],
)
def test_given_a_changed_rig_then_its_symptom_is_named(sound, emulation, code, actuators, value):
    found = verified(sound, emulation)
    (symptom,) = found.symptoms
    assert (symptom.code, symptom.actuators) == (code, actuators)
    assert value is None or symptom.value == pytest.approx(value, rel=0.1, abs=0.1)
    assert not found.passed
    assert symptom.certain
    assert 0.95 <= symptom.explained <= 1.0
    assert found.summary.startswith(sentence(symptom))


@pytest.mark.parametrize(("rows", "again"), [(None, True), ([0, 4, 12, 13, 20], True), ([6, 7, 11, 12], False)])
def test_given_a_sound_rig_then_no_symptom_is_named_and_the_sentinel_is_steady(sound, rows, again):
    found = verified(sound, "", rows, again=again)
    assert found.passed
    assert found.symptoms == ()
    if again:
        assert found.drift is not None
        assert (found.drift.verdict, found.drift.speed_percent) == ("steady", None)
        assert all(abs(one.level_db) < 0.05 and abs(one.delay_us) < 5.0 for one in found.actuators)
    else:
        assert found.drift is None


def test_given_a_rig_that_drifted_then_the_sentinel_says_in_what(sound):
    louder = verified(sound, "output_gains_db = [1, 1, 1, 1]", [12]).drift
    assert (louder.verdict, louder.speed_percent) == ("warn", None)
    assert louder.level_db == pytest.approx(1.0, abs=0.05)
    faster = verified(sound, "room_c = 22", [12]).drift
    assert faster.speed_percent == pytest.approx(2.0, abs=0.2)
