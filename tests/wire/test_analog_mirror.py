"""A mirror on two analog outputs of the recorder's box, through the real nidaqmx package."""

import math
from contextlib import ExitStack

import numpy as np
import pytest

from tests.wire.analog_bench import analog_rig
from tests.wire.daq_bench import Tone, check_tone, take_one
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.mirror.analog import AnalogMirrorDriver
from wavefocus.drivers.protocols import WallClock
from wavefocus.drivers.registry import MirrorSettings
from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.emulated_rig import analog_scanner
from wavefocus.mocks.wire.ni_server import NiServer
from wavefocus.rig.instruments import openers_of
from wavefocus.storage.errors import InputError

PARK_MRAD = (-190.0, -190.0)


class Scanner:
    """An emulated box with a mirror on its outputs, and what the outputs went through."""

    def __init__(self, opened, product="USB-6211"):
        self.server = NiServer(Tone(), product)
        self.server.start()
        opened.callback(self.server.stop)
        self._opened = opened
        self.motion = MirrorMotion((0.0, 0.0), 0.0, math.inf, 300.0)
        self.written: list[tuple[float, float]] = []
        scanner = analog_scanner(self.motion, ("ao0", "ao1"))

        def changed(levels):
            self.written.append((levels.get("ao0", 0.0), levels.get("ao1", 0.0)))
            scanner(levels)

        self.server.box.output_changed = changed

    def mirror(self, *, settle_s=0.0, limit_mrad=200.0, park_mrad=PARK_MRAD, **keys):
        driver = AnalogMirrorDriver(device="Dev1", address=self.server.address, **keys)
        settings = MirrorSettings(settle_s=settle_s, limit_mrad=limit_mrad, park_mrad=park_mrad, clock=WallClock())
        mirror = driver.open(settings)
        self._opened.callback(mirror.close)
        return mirror

    @property
    def volts(self):
        return self.server.box.level("ao0"), self.server.box.level("ao1")

    def resets(self):
        return self.server.log.count("ResetDevice")


@pytest.fixture
def scanner():
    with ExitStack() as opened:
        yield Scanner(opened)


def test_given_an_angle_then_the_voltage_is_that_of_the_makers_scale(scanner):
    mirror = scanner.mirror()
    # 4 mm at a distance of 1 m: 4 mrad of the beam, 2 mrad or 0.1146 degrees of the mirror, 92 mV at 0.8 V per degree.
    mirror.move_to(4.0, -4.0)
    assert scanner.volts == pytest.approx((0.09167, -0.09167), abs=1e-4)
    mirror.move_to(0.0, 2000 * math.radians(5.0))
    assert scanner.volts == pytest.approx((0.0, 4.0), abs=1e-9)
    assert scanner.motion.where_mrad() == pytest.approx((0.0, 174.533), abs=1e-3)


def test_given_a_far_move_then_no_step_is_larger_than_the_slew_rate_allows(scanner):
    mirror = scanner.mirror(slew_v_per_s=200.0)
    mirror.move_to(150.0, 20.0)
    mirror.park()
    steps = np.abs(np.diff([(0.0, 0.0), *scanner.written], axis=0))
    assert len(steps) > 20
    assert steps.max() <= 0.2 + 1e-9
    assert scanner.written[-1] == pytest.approx(np.array(PARK_MRAD) * math.degrees(1e-3) / 2 * 0.8)


def test_given_a_mirror_is_closed_then_the_outputs_are_left_at_the_parking_voltage(scanner):
    mirror = scanner.mirror()
    mirror.move_to(10.0, 10.0)
    mirror.close()
    assert scanner.motion.where_mrad() == pytest.approx(PARK_MRAD)


@pytest.mark.parametrize(
    ("settings", "word"),
    [
        ({"volts_per_degree": 2.0, "limit_mrad": 200.0}, "limit_v"),
        ({"limit_v": 3.0, "limit_mrad": 200.0}, "limit_v"),
        ({"x_output": "ao7"}, "ao7"),
    ],
)
def test_given_a_rig_beyond_the_outputs_then_it_is_refused(scanner, settings, word):
    with pytest.raises(InstrumentError, match=word):
        scanner.mirror(**settings)
    assert scanner.written == []


def test_an_output_that_another_task_has_then_it_is_refused_and_the_other_goes_on(scanner):
    first = scanner.mirror()
    first.move_to(1.0, 1.0)
    with pytest.raises(InstrumentError, match="-50103") as refused:
        scanner.mirror()
    assert not isinstance(refused.value, InstrumentLostError)
    first.move_to(2.0, 2.0)
    assert scanner.motion.where_mrad() == pytest.approx((2.0, 2.0))


def test_given_a_box_without_outputs_then_it_says_so():
    with ExitStack() as opened, pytest.raises(InstrumentError, match="no output"):
        Scanner(opened, "USB-6356").mirror()


def rig(tmp_path, scanner):
    return analog_rig(tmp_path, scanner.server.address)


def test_given_the_recorder_is_connected_again_then_the_mirror_stays_where_it_is(scanner, tmp_path):
    openers = openers_of(rig(tmp_path, scanner))
    with ExitStack() as opened:
        mirror, recorder = openers.mirror(), openers.recorder()
        opened.callback(mirror.close)
        opened.callback(recorder.close)
        mirror.move_to(30.0, -20.0)
        check_tone(take_one(recorder))
        recorder.reconnect()
        check_tone(take_one(recorder))
        assert scanner.motion.where_mrad() == pytest.approx((30.0, -20.0))
        assert scanner.resets() == 0


def test_box_is_unplugged_then_mirror_is_lost_and_points_again_once_it_is_back(scanner):
    mirror = scanner.mirror()
    mirror.move_to(30.0, -20.0)
    scanner.server.box.unplug()
    assert scanner.volts == (0.0, 0.0)
    with pytest.raises(InstrumentLostError):
        mirror.move_to(31.0, -20.0)
    with pytest.raises(InstrumentLostError):
        mirror.reconnect()
    scanner.server.box.plug()
    mirror.reconnect()
    with pytest.raises(InstrumentError):
        mirror.wait_settled(1.0)  # it has not been sent anywhere
    mirror.move_to(31.0, -20.0)
    mirror.wait_settled(1.0)
    assert scanner.motion.where_mrad() == pytest.approx((31.0, -20.0))


@pytest.mark.parametrize(
    "change", [("limit_mrad = 200.0", 'limit_mrad = 200.0\ny_output = "ao0"'), ('device = "Dev1"\n', "")]
)
def test_given_wrong_keys_then_the_rig_file_is_refused(scanner, tmp_path, change):
    rig(tmp_path, scanner)
    text = (tmp_path / "rig.toml").read_text().replace(*change, 1)
    (tmp_path / "rig.toml").write_text(text)
    from wavefocus.configuration import load_rig

    with pytest.raises(InputError, match="mirror"):
        load_rig(tmp_path / "rig.toml")
