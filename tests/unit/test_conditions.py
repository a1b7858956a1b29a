"""Values of watched conditions, and their bands."""

import math

import numpy as np
import pytest

from tests.lab_files import setup_of
from wavefocus.acquisition.attempt import Play
from wavefocus.acquisition.engine.recovery import Conditions
from wavefocus.acquisition.setup import AllowedRange, Watch
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.config.rig import default_rig
from wavefocus.configuration import load_rig
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Recording
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.rig.instruments import openers_of
from wavefocus.rig.setup import band_of, open_rig, room_c

RATE_HZ = 10_000.0
EXCITATION = PlayedExcitation(RATE_HZ, 20.0, 500.0, 1.0, 0.2, 1.0, 1)
SIGNAL_V = EXCITATION.signal_v()
PLAY = Play(0, {0: SIGNAL_V, 20: SIGNAL_V})


class Thermometer:
    def __init__(self, value):
        self.value = value

    def read(self):
        if self.value is None:
            raise InstrumentError("thermometer", "reading", "it is silent", "look after it")
        return self.value


def _conditions(sensor=None, **bands):
    setup = setup_of(VirtualRig(), reference_gain=0.5)
    watch = Watch(bands, {} if sensor is None else {"room": sensor.read})
    return Conditions(watch, setup, EXCITATION)


def _recording(reference_gain, noise_v):
    generator = np.random.default_rng(1)
    volts = np.zeros((2, len(SIGNAL_V) + 1200), np.float32)
    volts[0, 300 : 300 + len(SIGNAL_V)] = reference_gain * SIGNAL_V
    volts[1, 300 : 300 + len(SIGNAL_V)] = 3.0 * SIGNAL_V
    volts[1] += noise_v * generator.standard_normal(volts.shape[1], dtype=np.float32)
    return Recording(volts, (1e-4, 1e-4), (False, False))


@pytest.mark.parametrize(("gain", "level_db"), [(0.5, 0.0), (0.25, -6.02), (1.0, 6.02), (0.0, -np.inf)])
def test_a_record_then_the_reference_level_is_told_against_what_the_drive_makes(gain, level_db):
    conditions = _conditions(reference=AllowedRange("reference level", "dB"))
    found_db = conditions.values([PLAY], [_recording(gain, 0.0)])["reference"]
    assert found_db == pytest.approx(level_db, abs=0.01) if gain else found_db < -100.0


@pytest.mark.parametrize("noises_v", [[1e-3], [0.05], [1.0], [1e-3] * 4 + [1.0]])
def test_given_noise_under_a_loud_response_then_its_rms_in_most_records_is_found(noises_v):
    conditions = _conditions(noise=AllowedRange("noise", "V"))
    recordings = [_recording(0.5, noise_v) for noise_v in noises_v]
    found_v = conditions.values([PLAY] * len(recordings), recordings)["noise"]
    assert found_v == pytest.approx(noises_v[0], rel=0.1)


def test_given_a_band_then_it_is_left_on_one_threshold_and_entered_on_another():
    band = AllowedRange("room temperature", "degrees C", 18.0, 26.0, 19.0, 25.0)
    assert band.left(17.9) == "room temperature 17.9 degrees C is below 18 degrees C"
    assert band.left(26.5) == "room temperature 26.5 degrees C is above 26 degrees C"
    assert band.left(18.5) == ""
    assert not band.is_back(18.5)
    assert band.is_back(19.0)
    assert not band.is_back(25.5)


def test_given_a_sensor_that_fails_then_its_value_is_unknown_and_the_failure_is_kept():
    sensor = Thermometer(None)
    conditions = _conditions(sensor, room=AllowedRange("room temperature", "degrees C", leaves_below=18.0))
    assert conditions.values([], []) == {}
    assert "silent" in str(conditions.silent_sensors["room"])
    sensor.value = 15.0
    values = conditions.values([], [])
    assert conditions.silent_sensors == {}
    assert "below 18" in conditions.left(values)


def _rig(tmp_path, text):
    (tmp_path / "rig.toml").write_text(text, encoding="utf-8")
    return load_rig(tmp_path / "rig.toml")


def watch_of(rig):
    return open_rig(rig, openers_of(rig)).watch


def test_given_one_limit_then_the_inner_threshold_lies_a_tenth_inside(tmp_path):
    rig = _rig(tmp_path, "[watch.reference]\nleaves_below = -3\nleaves_above = 2.0\nsettle_s = 5")
    assert rig.watch.reference is not None
    band = band_of(rig.watch.reference, "reference level", "dB")
    assert (band.leaves_below, band.returns_above) == (-3.0, pytest.approx(-2.7))
    assert (band.leaves_above, band.returns_below) == (2.0, pytest.approx(1.8))
    assert band.settle_s == 5.0
    # Without a lower limit any low value is well.
    noise = watch_of(_rig(tmp_path, "[watch.noise]\nleaves_above = 0.01")).bands["noise"]
    assert (noise.leaves_below, noise.returns_above) == (-math.inf, -math.inf)
    assert noise.is_back(0.0)


def test_given_sensors_of_the_virtual_rig_then_they_are_asked_for_what_is_watched(tmp_path):
    rig = _rig(tmp_path, "[watch.room]\nleaves_below = 18\n[watch.light]\nleaves_below = 0.2")
    watch = watch_of(rig)
    assert {name: sensor() for name, sensor in watch.sensors.items()} == {"room": 21.0, "light": 1.0}
    assert watch_of(default_rig()).sensors == {}


def test_given_a_transmitter_then_its_volts_become_degrees(tmp_path):
    class Box:
        def read_input_v(self, name):
            return {"ai3": 0.25}[name]

    rig = _rig(tmp_path, '[watch.room]\nleaves_below = 18\ninput = "ai3"\ncelsius_per_v = 80.0\ncelsius_at_0_v = 1.5')
    assert rig.watch.room is not None
    assert room_c(Box(), rig.watch.room) == 21.5
