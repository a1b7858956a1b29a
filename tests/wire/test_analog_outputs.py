"""A mirror on two analog outputs of the recorder's box, and a shutter on its digital line, by the real nidaqmx package.

The shutter is open while the beam is where it was sent, closed at rest and after every failure.
"""

import math
import subprocess
import sys
from contextlib import ExitStack

import numpy as np
import pytest

from tests.lab_files import change_text, setup_of, wire_fault
from tests.system.lines import wait_until
from tests.wire.daq_bench import Tone, check_tone, take_one
from tests.wire.emulated import analog_rig
from wavefocus.acquisition.setup import silence
from wavefocus.commands.doctor import shutter_findings
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import load_rig
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.protocols import Shutter
from wavefocus.drivers.shutter import ShutteredMirror
from wavefocus.drivers.shutter.nidaqmx import NiShutterDriver
from wavefocus.drivers.timeouts import BoundedMirror, BoundedPlayer, BoundedRecorder
from wavefocus.mocks.virtual.mirror import MirrorMotion, VirtualShutter
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.wire.emulated_rig import analog_scanner
from wavefocus.mocks.wire.ni_server import NiServer
from wavefocus.rig.instruments import openers_of
from wavefocus.storage.errors import InputError

LINE = "port1/line0"
PARK_MRAD = (-190.0, -190.0)
OPENS_AT_ONCE = "opens_s = 0.0\n"


class Box:
    """An emulated box with a mirror on its outputs, and what the outputs went through."""

    def __init__(self, opened, *faults):
        self.server = NiServer(Tone(), faults=faults)
        self.server.start()
        opened.callback(self.server.stop)
        self._opened = opened
        self.motion = MirrorMotion((0.0, 0.0), 0.0, math.inf, 300.0)
        self.written = []
        scanner = analog_scanner(self.motion, ("ao0", "ao1"))

        def changed(levels):
            self.written.append((levels.get("ao0", 0.0), levels.get("ao1", 0.0)))
            scanner(levels)

        self.server.box.output_changed = changed

    def closed(self, instrument):
        self._opened.callback(instrument.close)
        return instrument

    def shutter(self, **keys):
        return self.closed(NiShutterDriver(device="Dev1", address=self.server.address, **keys).open())

    def rig(self, folder, shutter=None, mirror=""):
        return analog_rig(folder, self.server.address, shutter, mirror)

    def points_at(self, x_mrad, y_mrad):
        return self.motion.where_mrad() == pytest.approx((x_mrad, y_mrad), abs=1e-3)

    def level(self, name):
        return self.server.box.level(name)


@pytest.fixture
def box(request):
    with ExitStack() as stack:
        yield Box(stack, *getattr(request, "param", ()))


def arrives(mirror, x_mrad, y_mrad):
    mirror.move_to(x_mrad, y_mrad)
    mirror.wait_settled(1.0)


# -- mirror, shutter and recorder of one box -----------------------------------------------------------


@pytest.fixture(scope="module")
def rig(tmp_path_factory):
    """A box, and the instruments of a rig file that are on it: the mirror behind its shutter, and the recorder."""
    with ExitStack() as stack:
        box = Box(stack)
        openers = openers_of(box.rig(tmp_path_factory.mktemp("rig"), OPENS_AT_ONCE, mirror="slew_v_per_s = 200.0\n"))
        yield box, box.closed(openers.mirror()), box.closed(openers.recorder())


def test_the_mirror_follows_the_makers_scale_no_faster_than_it_may_and_ends_parked(rig):
    box, mirror, recorder = rig
    # 4 mm at a distance of 1 m: 4 mrad of the beam, 2 mrad or 0.1146 degrees of the mirror, 92 mV at 0.8 V per degree.
    mirror.move_to(4.0, -4.0)
    assert (box.level("ao0"), box.level("ao1")) == pytest.approx((0.09167, -0.09167), abs=1e-4)
    mirror.move_to(0.0, 2000 * math.radians(5.0))
    assert (box.level("ao0"), box.level("ao1")) == pytest.approx((0.0, 4.0), abs=1e-9)
    assert box.points_at(0.0, 174.533)
    check_tone(take_one(recorder))
    recorder.reconnect()  # the mirror has outputs of the same box
    check_tone(take_one(recorder))
    assert box.points_at(0.0, 174.533)
    assert "ResetDevice" not in box.server.log
    mirror.park()
    steps = np.abs(np.diff([(0.0, 0.0), *box.written], axis=0))
    assert len(steps) > 20
    assert steps.max() <= 0.2 + 1e-9
    assert box.written[-1] == pytest.approx(np.array(PARK_MRAD) * math.degrees(1e-3) / 2 * 0.8)
    assert box.points_at(*PARK_MRAD)


def test_a_shutter_then_it_is_open_only_while_the_beam_stands_where_it_was_sent(rig):
    box, mirror, _ = rig

    def is_open_after(action, *arguments):
        action(*arguments)
        return bool(box.level(LINE))

    assert not is_open_after(mirror.identify)
    assert not is_open_after(mirror.move_to, 10.0, 10.0)
    assert is_open_after(mirror.wait_settled, 1.0)
    assert is_open_after(arrives, mirror, 12.0, 10.0)
    assert not is_open_after(mirror.park)
    assert is_open_after(arrives, mirror, 10.0, 10.0)
    with pytest.raises(InstrumentError):
        mirror.move_to(5000.0, 0.0)
    assert not is_open_after(mirror.identify)
    assert is_open_after(arrives, mirror, 10.0, 10.0)
    assert not is_open_after(mirror.block)
    assert is_open_after(mirror.wait_settled, 1.0)


@pytest.mark.long
def test_box_is_unplugged_then_mirror_is_lost_and_points_again_once_it_is_back(rig):
    box, mirror, _ = rig
    arrives(mirror, 30.0, -20.0)
    box.server.box.unplug()
    assert (box.level("ao0"), box.level("ao1"), box.level(LINE)) == (0.0, 0.0, 0.0)
    for lost in (lambda: mirror.move_to(31.0, -20.0), mirror.reconnect, mirror.reconnect):
        with pytest.raises(InstrumentLostError):
            lost()
    with pytest.raises(InstrumentLostError, match="reconnect first"):
        mirror.move_to(31.0, -20.0)
    box.server.box.plug()
    mirror.reconnect()
    with pytest.raises(InstrumentError):
        mirror.wait_settled(1.0)  # it has not been sent anywhere
    arrives(mirror, 31.0, -20.0)
    assert box.points_at(31.0, -20.0)
    assert box.level(LINE) == 1.0
    mirror.close()
    assert box.points_at(*PARK_MRAD)
    assert box.level(LINE) == 0.0


@pytest.mark.parametrize(
    ("keys", "error", "words"),
    [
        ('device = "Dev1"\nvolts_per_degree = 2.0', InstrumentError, "limit_v"),
        ('device = "Dev1"\nlimit_v = 3.0', InstrumentError, "limit_v"),
        ('device = "Dev1"\nx_output = "ao7"', InstrumentError, r"has no output 'ao7'.*there is ao0, ao1"),
        ('device = "Dev1"\ny_output = "ao0"', InputError, r"mirror\.y_output"),
        ("", InputError, r"mirror\.device"),
    ],
)
def test_given_a_rig_beyond_the_outputs_then_it_is_refused(box, tmp_path, keys, error, words):
    box.rig(tmp_path)
    change_text(tmp_path / "rig.toml", 'driver = "analog"\ndevice = "Dev1"', f'driver = "analog"\n{keys}')
    with pytest.raises(error, match=words):
        openers_of(load_rig(tmp_path / "rig.toml")).mirror()
    assert box.written == []


@pytest.mark.long
def test_a_computer_on_which_programs_start_slowly_is_waited_for(box, tmp_path, monkeypatch):
    (tmp_path / "sitecustomize.py").write_text("import time\ntime.sleep(7)\n", encoding="utf-8")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    assert "ao0 and ao1" in box.closed(openers_of(box.rig(tmp_path)).mirror()).identify()


# -- the shutter ---------------------------------------------------------------------------------------


def test_a_shutter_that_opens_at_a_low_level_is_moved_on_its_own_box_alone(box):
    shutter = box.shutter(opens_when_high=False)
    assert isinstance(shutter, Shutter)
    for act, level in ((shutter.block_beam, 1.0), (shutter.open_beam, 0.0)):
        act()
        assert box.level(LINE) == level
    shutter.block_beam()
    box.server.stop()
    other = NiServer(Tone(), address=box.server.address, serial_number=0x0BADCAFE)
    other.start()
    with pytest.raises(InstrumentError, match="serial number 0BADCAFE answers instead of"):
        shutter.reconnect()
    assert "WriteDigitalLines" not in other.log
    other.stop()
    box.server.start()
    shutter.reconnect()
    shutter.block_beam()
    assert box.level(LINE) == 1.0
    shutter.close()
    with pytest.raises(InstrumentError):
        shutter.open_beam()


def test_given_another_instrument_fails_then_silence_closes_the_shutter(box):
    virtual, plain, shutter = VirtualRig(), VirtualRig(), VirtualShutter()
    shuttered = ShutteredMirror(virtual.mirror, shutter, 0.01, virtual.clock)
    for rig, mirror in ((virtual, shuttered), (plain, plain.mirror)):
        setup = setup_of(
            rig, mirror=BoundedMirror(mirror, 20.0), recorder=BoundedRecorder(rig.recorder, 20.0),
            player=BoundedPlayer(rig.player, 20.0),
        )  # fmt: skip
        for instrument in (setup.mirror, setup.recorder, setup.player):
            box.closed(instrument)
        arrives(setup.mirror, 1.0, 1.0)
        assert shutter.is_open is (mirror is shuttered)
        assert silence(setup) == []
        assert not shutter.is_open


# The third write to the line, the one that closes it, and the one after it are refused.
@pytest.mark.parametrize(
    "box", [[wire_fault("recorder", "usb_aborted", "WriteDigitalLines", at_call=3, count=2)]], indirect=True
)
def test_shutter_that_does_not_answer_then_nothing_is_measured_and_mirror_is_parked(box):
    virtual = VirtualRig()
    mirror = box.closed(ShutteredMirror(virtual.mirror, box.shutter(), 0.0, virtual.clock))
    arrives(mirror, 10.0, 10.0)
    with pytest.raises(InstrumentLostError, match="shutter"):
        mirror.park()
    virtual.mirror.wait_settled(1.0)
    assert virtual.mirror.motion.where_mrad() == virtual.mirror.motion.park_mrad  # parked all the same
    mirror.move_to(10.0, 10.0)
    with pytest.raises(InstrumentLostError, match="shutter"):
        mirror.reconnect()
    mirror.reconnect()
    assert box.level(LINE) == 0.0
    arrives(mirror, 10.0, 10.0)
    assert box.level(LINE) == 1.0


def test_given_a_shutter_then_doctor_moves_it_and_names_what_is_wrong(box, tmp_path):
    config = box.rig(tmp_path, OPENS_AT_ONCE)
    (good,) = shutter_findings(config)
    assert (good.instrument, good.verdict) == ("shutter", "ok")
    assert box.level(LINE) == 0.0
    assert box.server.log.count("WriteDigitalLines") == 3
    (bad,) = shutter_findings(box.rig(tmp_path, OPENS_AT_ONCE + 'line = "port0/line0"\n'))
    assert (bad.instrument, bad.verdict) == ("shutter", "fail")
    assert LINE in bad.remedy
    assert list(shutter_findings(RigConfig.model_validate({}))) == []


def test_a_virtual_rig_has_a_virtual_shutter_in_its_mirror_and_no_real_one(box, tmp_path):
    rig_file = tmp_path / "rig.toml"
    rig_file.write_text('[shutter]\ndriver = "virtual"\n', encoding="utf-8")
    assert "shutter" in box.closed(openers_of(load_rig(rig_file)).mirror()).identify()
    rig_file.write_text('[shutter]\ndriver = "nidaqmx"\ndevice = "Dev1"\n', encoding="utf-8")
    with pytest.raises(InputError, match=r"shutter\.driver"):
        load_rig(rig_file)


HOLD = """
import sys
from pathlib import Path
from wavefocus.configuration import load_rig
from wavefocus.rig.instruments import openers_of
mirror = openers_of(load_rig(Path(sys.argv[1]))).mirror()
mirror.move_to(10.0, 10.0)
mirror.wait_settled(1.0)
print("there", flush=True)
sys.stdin.readline()
"""


# A program that is stopped instead of killed: test_rigs_through_wires.py.
def test_given_the_program_is_killed_then_the_shutter_closes_and_the_mirror_parks(box, tmp_path):
    box.rig(tmp_path, OPENS_AT_ONCE)
    command = [sys.executable, "-c", HOLD, str(tmp_path / "rig.toml")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout.readline() == "there\n"
        assert box.level(LINE) == 1.0
        program.kill()
    wait_until(lambda: not box.level(LINE) and box.level("ao0") <= -3.0, "the shutter is closed, the mirror parked")
