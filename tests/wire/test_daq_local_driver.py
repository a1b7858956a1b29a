"""The NI recorder through the driver on this computer: the real package over a library that stands in for NI's."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = [
    pytest.mark.may_skip("a stand-in for the driver's library can be put on the loader's path on Linux alone"),
    pytest.mark.skipif(sys.platform != "linux", reason="elsewhere libraries are not found by a path variable"),
]

SESSION = """
import ctypes, os, signal, sys, threading, warnings
from pathlib import Path
import pytest
warnings.simplefilter("error")
from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder
from wavefocus.drivers.daq.ni.ni_process import ProcessRecorder
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.protocols import RecordRequest, RecordLabel

WIRING = dict(reference_input="ai0", response_input="ai1", terminal="differential", trigger=None)

def opened():
    return NiRecorder("Dev1", address=None, **WIRING)

def in_a_process():
    return ProcessRecorder("Dev1", **WIRING)

def request(samples=1000):
    return RecordRequest(samples, 10_000.0, (10.0, 10.0), RecordLabel(7, 1, 0))

def taken(recorder, samples=1000):
    recorder.start(request(samples))
    return recorder.read(5.0)

def check_record(recorder):
    recording = taken(recorder)
    assert recording.volts.shape == (2, 1000)
    assert [abs(row).max() for row in recording.volts] == pytest.approx([0.5, 2.0], abs=0.003)
    assert recording.volts_per_count[0] == pytest.approx(20 / 2**14 * 1.01)
    assert recording.over_range == (False, False)

def tasks():
    return ctypes.CDLL("libnidaqmx.so").shim_tasks()

unplugged, hangs = (Path(os.environ[name]) for name in ("SHIM_UNPLUGGED", "SHIM_HANGS"))
"""


RIG = """
[mirror]
driver = "generic"
port = "/nowhere"
[recorder]
driver = "nidaqmx"
device = "Dev1"
[player]
driver = "sounddevice"
device = "none"
"""


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """Runs a script, whose assertions are the test's, in a process whose loader finds the stand-in."""
    folder = tmp_path_factory.mktemp("driver")
    # The name within the library is what the loader goes by.
    command = ["gcc", "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror", "-Wl,-soname,libnidaqmx.so"]
    source = Path(__file__).with_name("libnidaqmx.c")
    subprocess.run([*command, "-o", folder / "libnidaqmx.so", source, "-lm"], check=True)
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    shim = {"SHIM_UNPLUGGED": str(folder / "unplugged"), "SHIM_HANGS": str(folder / "hangs")}
    environment = {**os.environ, "LD_LIBRARY_PATH": str(folder), "RIG_FILE": str(folder / "rig.toml"), **shim}

    def run(script):
        done = subprocess.run(
            [sys.executable, "-c", SESSION + script],
            cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert not done.stderr

    return run


def test_the_local_driver_takes_records_tells_its_faults_and_gives_the_device_back(session):
    session(r"""
recorder = opened()
assert recorder.identify() == (
    "NI USB-6001, serial number 01C0FFEE, Dev1 on this computer, NI-DAQmx 23.8.1, ai0 and ai1 differential"
)
for record in range(3):
    check_record(recorder)
assert tasks() == 1
recorder.start(request(100_000))
with pytest.raises(TransientInstrumentError, match="position 7, attempt 1, record 0: not finished after 0.01 s"):
    recorder.read(0.01)
second = opened()
with pytest.raises(InstrumentError, match="another program has reserved it"):
    second.start(request())
second.close()
recorder.abort()
recorder.start(request())
recorder.reconnect()
assert taken(recorder, 1).volts.shape == (2, 1)
recorder.close()
assert tasks() == 0
for status, error, cause in (
    ("-200284", TransientInstrumentError, r"did not come in time \(NI-DAQmx -200284\); 500"),
    ("-209999", InstrumentError, "NI-DAQmx says: As ordered"),
):
    os.environ["SHIM_READ_STATUS"] = status
    recorder = opened()
    with pytest.raises(error, match=cause):
        taken(recorder)
    assert tasks() == 0
    recorder.close()
""")


def test_a_library_broken_killed_or_hanging_works_again_in_a_fresh_process(session):
    session("""
# Of a rig file without an address.
from wavefocus.configuration import load_rig
from wavefocus.rig.instruments import openers_of
recorder = openers_of(load_rig(Path(os.environ["RIG_FILE"]))).recorder()
assert recorder.identify().startswith("NI USB-6001")
assert "nidaqmx" not in sys.modules
recorder.close()

recorder, here = in_a_process(), opened()
process = recorder.process_id
check_record(recorder)
unplugged.touch()
with pytest.raises(InstrumentLostError, match="unplugged"):
    taken(recorder)
with pytest.raises(InstrumentLostError):
    recorder.reconnect()
with pytest.raises(InstrumentLostError, match="reconnect first"):
    taken(recorder)
# In one and the same process it never comes back.
with pytest.raises(InstrumentLostError):
    here.reconnect()
unplugged.unlink()
with pytest.raises(InstrumentLostError):
    here.reconnect()
recorder.reconnect()
check_record(recorder)
assert recorder.process_id != process
assert recorder.identify().startswith("NI USB-6001, serial number 01C0FFEE, Dev1 on this computer")
assert str(recorder.identity) == "NI USB-6001, serial number 01C0FFEE"
assert recorder.input_ranges_v == (10.0,)
assert abs(recorder.read_input_v("ai2")) < 1.0
recorder.start(request(100_000))
recorder.abort()
with pytest.raises(InstrumentError, match="no record was started"):
    recorder.read(0.1)
recorder.start(request(100_000))
with pytest.raises(TransientInstrumentError, match="not finished"):
    recorder.read(0.01)
recorder.abort()

recorder.start(request(100_000))
os.kill(recorder.process_id, signal.SIGKILL)
with pytest.raises(InstrumentLostError, match="the process that runs NI-DAQmx ended"):
    recorder.read(20.0)
recorder.abort()
recorder.reconnect()
check_record(recorder)

process = recorder.process_id
hangs.touch()

def ask():
    try:
        recorder.identify()
    except InstrumentError:
        pass

thread = threading.Thread(target=ask)
thread.start()
threading.Timer(0.3, hangs.unlink).start()
recorder.reconnect()
thread.join()
check_record(recorder)
assert recorder.process_id != process
recorder.close()
recorder.close()
with pytest.raises(InstrumentError, match="it is closed"):
    recorder.start(request())
""")
