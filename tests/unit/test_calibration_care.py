"""When a calibration is warned of: too old, or made on another device."""

from __future__ import annotations

from datetime import timedelta

import pytest

from tests.unit.test_config_calibration import AT, measured
from wavefocus.calibration_care import calibration_warnings, device_itself
from wavefocus.config.rig import RigConfig, default_rig

NAMES = {"mirror": "m", "recorder": "r", "player": "p"}


def calibrated(**care: object) -> RigConfig:
    actuators = {"position_mm": [[0, 0], [10, 0]]}
    care = {"file": "cal.toml", "measured": measured().model_dump(), **care}
    return RigConfig.model_validate({"actuators": actuators, "calibration": care})


def test_given_no_calibration_then_there_is_nothing_to_warn_of() -> None:
    assert calibration_warnings(default_rig(), NAMES) == []


def test_given_a_fresh_calibration_of_the_same_devices_then_there_is_nothing_to_warn_of() -> None:
    assert calibration_warnings(calibrated(), NAMES, AT + timedelta(days=89)) == []


def test_given_an_old_one_then_every_part_is_warned_of_with_what_to_do() -> None:
    told = calibration_warnings(calibrated(stale_after_days=10.0), NAMES, AT + timedelta(days=30))
    assert told[0] == "cal.toml: inputs measured 30 days ago, trusted for 10; run wavefocus calibrate --only inputs"
    assert len(told) == 4


def test_given_another_device_then_the_parts_made_with_it_are_warned_of() -> None:
    told = calibration_warnings(calibrated(), {**NAMES, "player": "other"}, AT)
    assert [line.split()[1] for line in told] == ["outputs", "actuators"]
    assert "made" not in told[0]
    assert "measured on another device (p); this is other; run wavefocus calibrate --only outputs" in told[0]


def test_given_a_device_that_did_not_answer_then_it_is_left_to_others() -> None:
    assert calibration_warnings(calibrated(), {"mirror": "m"}, AT) == []


@pytest.mark.parametrize(
    ("then", "now", "same"),
    [
        (
            "player system, JACK Audio Connection Kit, 21 of 24 channels at 48000 Hz, latency 85 ms, full scale 5 V, "
            "PortAudio V19.6.0",
            "player system, JACK Audio Connection Kit, 21 of 24 channels at 48000 Hz, latency 171 ms, "
            "full scale 4.48 V, PortAudio V19.7.0",
            True,
        ),
        ("player system, JACK", "player Fireface, ASIO", False),
        (
            "mirror (asi-tiger at /dev/ttyUSB0): TIGER SCAN_XY, within +-250 mrad",
            "mirror (asi-tiger at COM7): TIGER SCAN_XY, within +-200 mrad",
            True,
        ),
        (
            "mirror (asi-tiger at socket://localhost:4001): TIGER A, within +-250 mrad",
            "mirror (asi-tiger at socket://localhost:4002): TIGER B, within +-250 mrad",
            False,
        ),
        ("recorder Dev1: USB-6211, serial number 01A2B3C4", "recorder Dev1: USB-6211, serial number 01A2B3C5", False),
        (
            "virtual player, 21 channels, full scale 5 V, 16 bit",
            "virtual player, 22 channels, full scale 4 V, 16 bit",
            True,
        ),
    ],
)
def test_given_two_names_then_settings_and_the_way_to_a_device_do_not_make_it_another(
    then: str, now: str, same: bool
) -> None:
    assert (device_itself(then) == device_itself(now)) is same
