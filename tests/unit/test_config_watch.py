"""What a rig file may say of watched conditions, and a run file of drift."""

import math
from pathlib import Path

import pytest

from wavefocus.acquisition.setup import Watch
from wavefocus.config.rig import RigConfig, default_rig
from wavefocus.configuration import load_rig
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.setup import band_of, open_rig, room_c


def _rig(tmp_path: Path, text: str) -> RigConfig:
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    return load_rig(tmp_path / "rig.toml")


def watch_of(rig: RigConfig) -> Watch:
    return open_rig(rig, openers_of(rig)).watch


def test_given_one_limit_then_the_inner_threshold_lies_a_tenth_inside(tmp_path):
    rig = _rig(tmp_path, "[watch.reference]\nleaves_below = -3\nleaves_above = 2.0\nsettle_s = 5")
    band = band_of(rig.watch.reference, "reference level", "dB") if rig.watch.reference else None
    assert band is not None
    assert (band.leaves_below, band.returns_above) == (-3.0, pytest.approx(-2.7))
    assert (band.leaves_above, band.returns_below) == (2.0, pytest.approx(1.8))
    assert band.settle_s == 5.0


def test_given_no_lower_limit_then_any_low_value_is_well(tmp_path):
    rig = _rig(tmp_path, "[watch.noise]\nleaves_above = 0.01")
    watch = watch_of(rig)
    assert (watch.bands["noise"].leaves_below, watch.bands["noise"].returns_above) == (-math.inf, -math.inf)
    assert watch.bands["noise"].is_back(0.0)


def test_given_sensors_of_the_virtual_rig_then_they_are_asked_for_what_is_watched(tmp_path):
    rig = _rig(tmp_path, "[watch.room]\nleaves_below = 18\n[watch.light]\nleaves_below = 0.2")
    watch = watch_of(rig)
    assert {name: sensor() for name, sensor in watch.sensors.items()} == {"room": 21.0, "light": 1.0}
    assert watch_of(default_rig()).sensors == {}


def test_given_a_transmitter_then_its_volts_become_degrees(tmp_path):
    class Box:
        def read_input_v(self, name: str) -> float:
            return {"ai3": 0.25}[name]

    rig = _rig(tmp_path, '[watch.room]\nleaves_below = 18\ninput = "ai3"\ncelsius_per_v = 80.0\ncelsius_at_0_v = 1.5')
    assert rig.watch.room is not None
    assert room_c(Box(), rig.watch.room) == 21.5
