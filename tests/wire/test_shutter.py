"""A shutter on a digital line: open while the beam is where it was sent, closed at rest and after every failure."""

import subprocess
import sys
from contextlib import ExitStack

import pytest

from tests.wire.analog_bench import analog_rig
from tests.wire.audio_bench import wait_until
from tests.wire.daq_bench import Tone
from wavefocus.acquisition.setup import silence
from wavefocus.commands.doctor import shutter_findings
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import load_rig
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.protocols import Instruments, Shutter
from wavefocus.drivers.registry import SHUTTERS
from wavefocus.drivers.shutter import ShutteredMirror
from wavefocus.drivers.shutter.nidaqmx import NiShutterDriver
from wavefocus.drivers.timeouts import BoundedMirror, bounded
from wavefocus.mocks.virtual.mirror import VirtualShutter
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.wire import WireFault
from wavefocus.mocks.wire.ni_server import NiServer
from wavefocus.rig.instruments import openers_of
from wavefocus.storage.errors import InputError

LINE = "port1/line0"


@pytest.fixture
def opened():
    with ExitStack() as stack:
        yield stack


def server(opened, *faults):
    one = NiServer(Tone(), "USB-6211", faults=faults)
    one.start()
    opened.callback(one.stop)
    return one


def rig(folder, address, **keys):
    """A rig with an analog mirror and a shutter on one box."""
    analog_rig(folder, address)
    lines = "".join(f"{key} = {str(value).lower()}\n" for key, value in keys.items())
    table = f'\n[shutter]\ndriver = "nidaqmx"\ndevice = "Dev1"\naddress = "{address}"\nopens_s = 0.0\n{lines}'
    with (folder / "rig.toml").open("a", encoding="utf-8") as file:
        file.write(table)
    return load_rig(folder / "rig.toml")


def mirror_of(opened, config):
    mirror = BoundedMirror(openers_of(config).mirror(), 20.0)
    opened.callback(mirror.close)
    return mirror


@pytest.mark.parametrize("opens_when_high", [True, False])
def test_a_shutter_then_it_is_open_only_while_the_beam_stands_where_it_was_sent(opened, tmp_path, opens_when_high):
    daq = server(opened)

    def is_open():
        return bool(daq.box.level(LINE)) is opens_when_high

    mirror = mirror_of(opened, rig(tmp_path, daq.address, opens_when_high=opens_when_high))
    assert not is_open()
    mirror.move_to(10.0, 10.0)
    assert not is_open()
    mirror.wait_settled(1.0)
    assert is_open()
    mirror.move_to(12.0, 10.0)
    mirror.wait_settled(1.0)
    assert is_open()
    mirror.park()
    assert not is_open()
    mirror.move_to(10.0, 10.0)
    mirror.wait_settled(1.0)
    with pytest.raises(InstrumentError):
        mirror.move_to(5000.0, 0.0)
    assert not is_open()
    mirror.move_to(10.0, 10.0)
    mirror.wait_settled(1.0)
    mirror.block()
    assert not is_open()
    mirror.wait_settled(1.0)
    assert is_open()
    mirror.close()
    assert not is_open()


def bounded_until_closed(opened, instruments):
    one = bounded(instruments, 20.0)
    for instrument in (one.mirror, one.recorder, one.player):
        opened.callback(instrument.close)
    return one


def test_given_another_instrument_fails_then_silence_closes_the_shutter(opened):
    virtual, shutter = VirtualRig().instruments, VirtualShutter()
    mirror = ShutteredMirror(virtual.mirror, shutter, 0.01, virtual.clock)
    instruments = bounded_until_closed(opened, Instruments(mirror, virtual.recorder, virtual.player, virtual.clock))
    instruments.mirror.move_to(1.0, 1.0)
    instruments.mirror.wait_settled(1.0)
    assert shutter.is_open
    assert silence(instruments) == []
    assert not shutter.is_open
    plain = bounded_until_closed(opened, VirtualRig().instruments)
    assert silence(plain) == []


def test_shutter_that_does_not_answer_then_nothing_is_measured_and_mirror_is_parked(opened, tmp_path):
    # The third write to the line, the one that closes it, and all after it are refused.
    daq = server(opened, WireFault("recorder", "usb_aborted", "WriteDigitalLines", at_call=3, count=3))
    mirror = mirror_of(opened, rig(tmp_path, daq.address))
    mirror.move_to(10.0, 10.0)
    mirror.wait_settled(1.0)
    with pytest.raises(InstrumentLostError, match="shutter"):
        mirror.park()
    assert daq.box.level("ao0") < -3.0  # parked all the same
    mirror.move_to(10.0, 10.0)
    with pytest.raises(InstrumentLostError, match="shutter") as lost:
        mirror.reconnect()
    assert lost.value.role == "mirror"
    with pytest.raises(InstrumentLostError):
        mirror.reconnect()
    mirror.reconnect()
    assert daq.box.level(LINE) == 0.0
    mirror.move_to(10.0, 10.0)
    mirror.wait_settled(1.0)
    assert daq.box.level(LINE) == 1.0


def test_given_a_shutter_then_doctor_moves_it_and_names_what_is_wrong(opened, tmp_path):
    daq = server(opened)
    config = rig(tmp_path, daq.address)
    (good,) = shutter_findings(config)
    assert (good.instrument, good.verdict) == ("shutter", "ok")
    assert daq.box.level(LINE) == 0.0
    assert daq.log.count("WriteDigitalLines") == 3
    daq.box.unplug()
    (bad,) = shutter_findings(config)
    assert (bad.instrument, bad.verdict) == ("shutter", "fail")
    (taken,) = shutter_findings(rig(tmp_path, server(opened).address, line="'port0/line0'"))
    assert taken.verdict == "fail"
    assert LINE in taken.remedy
    assert list(shutter_findings(RigConfig.model_validate({}))) == []


def test_given_a_line_that_is_wired_to_something_else_then_it_is_an_error(opened):
    daq = server(opened)
    first = NiShutterDriver(device="Dev1", address=daq.address).open()
    opened.callback(first.close)
    first.open_beam()
    with pytest.raises(InstrumentError, match="-50103"):
        NiShutterDriver(device="Dev1", address=daq.address).open()
    assert isinstance(first, Shutter)
    assert set(SHUTTERS.all()) == {"nidaqmx"}
    first.close()
    with pytest.raises(InstrumentError):
        first.open_beam()


def test_another_box_under_same_name_then_shutter_is_not_moved_until_its_own_is_back(opened):
    daq = server(opened)
    shutter = NiShutterDriver(device="Dev1", address=daq.address).open()
    opened.callback(shutter.close)
    shutter.open_beam()
    daq.stop()
    other = NiServer(Tone(), "USB-6211", address=daq.address, serial_number=0x0BADCAFE)
    other.start()
    with pytest.raises(InstrumentError, match="serial number 0BADCAFE answers instead of"):
        shutter.reconnect()
    with pytest.raises(InstrumentLostError, match="reconnect first"):
        shutter.open_beam()
    assert "WriteDigitalLines" not in other.log
    other.stop()
    daq.start()
    shutter.reconnect()
    shutter.block_beam()
    assert daq.box.level(LINE) == 0.0


def test_given_a_real_shutter_in_a_virtual_rig_then_the_rig_file_is_refused(tmp_path):
    rig_file = tmp_path / "rig.toml"
    rig_file.write_text('[shutter]\ndriver = "nidaqmx"\ndevice = "Dev1"\n')
    with pytest.raises(InputError, match=r"shutter\.driver"):
        load_rig(rig_file)
    rig_file.write_text('[shutter]\ndriver = "virtual"\n')
    openers = openers_of(load_rig(rig_file))
    mirror = openers.mirror()
    assert "shutter" in mirror.identify()
    mirror.close()


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


# A program that is stopped instead of killed: tests/wire/test_campaign_analog.py.
def test_given_the_program_is_killed_then_the_shutter_closes_and_the_mirror_parks(opened, tmp_path):
    daq = server(opened)
    rig(tmp_path, daq.address)
    command = [sys.executable, "-c", HOLD, str(tmp_path / "rig.toml")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as program:
        assert program.stdout is not None
        assert program.stdout.readline() == "there\n"
        assert daq.box.level(LINE) == 1.0
        program.kill()
    wait_until(
        lambda: not daq.box.level(LINE) and daq.box.level("ao0") <= -3.0, "the shutter is closed, the mirror parked"
    )
