"""When a calibration is warned of: too old, or made on another device."""

from dataclasses import replace
from datetime import timedelta

import pytest

from tests.unit.test_config_calibration import AT, measured
from wavefocus.config.rig import RigConfig
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.rig.calibration_validity import calibrated_elsewhere, calibration_warnings

THERE = {role: DeviceIdentity("", role[0]) for role in ("mirror", "recorder", "player")}


def calibrated(**care: object) -> RigConfig:
    actuators = {"position_mm": [[0, 0], [10, 0]]}
    care = {"file": "cal.toml", "measured": measured().model_dump(), **care}
    return RigConfig.model_validate({"actuators": actuators, "calibration": care})


def test_a_fresh_calibration_of_the_same_devices_then_there_is_nothing_to_warn_of():
    assert calibration_warnings(calibrated(), THERE, AT + timedelta(days=89)) == []


def test_given_an_old_one_then_every_part_is_warned_of_with_what_to_do():
    told = calibration_warnings(calibrated(stale_after_days=10.0), THERE, AT + timedelta(days=30))
    assert told[0].reason == "cal.toml: inputs measured 30 days ago, trusted for 10"
    assert told[0].remedy == "run wavefocus calibrate --only inputs"
    assert len(told) == 4


def test_given_another_device_then_the_parts_made_with_it_are_warned_of():
    told = calibration_warnings(calibrated(), {**THERE, "player": DeviceIdentity("", "other")}, AT)
    assert [one.part for one in told] == ["outputs", "actuators"]
    assert "measured on another device (p); this is other" in told[0].reason


def test_given_a_device_that_did_not_answer_then_it_is_left_to_others():
    assert calibration_warnings(calibrated(), {"mirror": THERE["mirror"]}, AT) == []


@pytest.mark.parametrize("field", ["maker", "product", "serial"])
def test_given_any_field_of_an_identity_that_differs_then_it_is_another_device(field):
    other = replace(THERE["recorder"], **{field: "x"})
    assert list(calibrated_elsewhere(calibrated(), {**THERE, "recorder": other})) == ["inputs"]


def test_a_device_named_only_in_words_is_not_compared_and_that_is_said():
    older = measured().model_dump()
    del older["inputs"]["identity"]
    rig = calibrated(measured=older)
    there = {**THERE, "recorder": DeviceIdentity("", "other")}
    assert calibrated_elsewhere(rig, there) == {}
    (told,) = calibration_warnings(rig, there, AT)
    assert "inputs not comparable: the file names its device only in words" in told.reason


def test_an_interface_that_windows_counts_anew_then_the_calibration_still_holds():
    player = DeviceIdentity("", "Speakers (2- Scarlett 18i20 USB)")
    rig = calibrated()
    record = rig.calibration.measured
    outputs = record.outputs.model_copy(update={"identity": player})
    section = rig.calibration.model_copy(update={"measured": record.model_copy(update={"outputs": outputs})})
    rig = rig.model_copy(update={"calibration": section})
    moved = DeviceIdentity("", "Speakers (3- Scarlett 18i20 USB)")
    other = DeviceIdentity("", "Speakers (3- Scarlett 18i8 USB)")
    assert "outputs" not in calibrated_elsewhere(rig, {"player": moved})
    assert "outputs" in calibrated_elsewhere(rig, {"player": other})
