"""The NI recorder through the driver on this computer: the real package over a library that stands in for NI's."""

import os
import subprocess
from pathlib import Path

import pytest

from tests.lab_files import ABSENT_RIG, change_text
from tests.system.lines import of_linux, python

ROOT = Path(__file__).parents[2]
pytestmark = [
    *of_linux("a stand-in for the driver's library can be put on the loader's path on Linux alone"),
    pytest.mark.long,
]

SESSION = r"""
import os, signal, sys, threading, warnings
from pathlib import Path
import pytest
warnings.simplefilter("error")
from wavefocus.configuration import load_rig
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.protocols import RecordRequest, RecordLabel
from wavefocus.rig.instruments import openers_of

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

unplugged, hangs = (Path(os.environ[name]) for name in ("SHIM_UNPLUGGED", "SHIM_HANGS"))

# By a rig file without an address, in a process of its own.
recorder = openers_of(load_rig(Path(os.environ["RIG_FILE"]))).recorder()
assert "nidaqmx" not in sys.modules
assert recorder.identify() == (
    "NI USB-6001, serial number 01C0FFEE, Dev1 on this computer, NI-DAQmx 23.8.1, ai0 and ai1 differential"
)
assert str(recorder.identity) == "NI USB-6001, serial number 01C0FFEE"
assert recorder.input_ranges_v == (10.0,)
for record in range(3):
    check_record(recorder)
assert abs(recorder.read_input_v("ai2")) < 1.0
recorder.start(request(100_000))
with pytest.raises(TransientInstrumentError, match="position 7, attempt 1, record 0: not finished after 0.01 s"):
    recorder.read(0.01)
recorder.abort()
assert taken(recorder, 1).volts.shape == (2, 1)

process = recorder.process_id
unplugged.touch()
with pytest.raises(InstrumentLostError, match="unplugged"):
    taken(recorder)
with pytest.raises(InstrumentLostError):
    recorder.reconnect()
with pytest.raises(InstrumentLostError, match="reconnect first"):
    taken(recorder)
unplugged.unlink()
recorder.reconnect()
check_record(recorder)
assert recorder.process_id != process

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
"""


def test_the_local_driver_takes_records_and_works_again_after_each_fault(tmp_path):
    """`SESSION`, whose assertions are the test's, runs in a process whose loader finds the stand-in."""
    # The name within the library is what the loader goes by.
    command = ["gcc", "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror", "-Wl,-soname,libnidaqmx.so"]
    source = Path(__file__).with_name("libnidaqmx.c")
    subprocess.run([*command, "-o", tmp_path / "libnidaqmx.so", source, "-lm"], check=True)
    (tmp_path / "rig.toml").write_text(ABSENT_RIG.format(folder=tmp_path), encoding="utf-8")
    change_text(tmp_path / "rig.toml", 'address = "localhost:1"\n', "")
    names = {"LD_LIBRARY_PATH": "", "RIG_FILE": "rig.toml", "SHIM_UNPLUGGED": "unplugged", "SHIM_HANGS": "hangs"}
    environment = os.environ | {name: str(tmp_path / file) for name, file in names.items()}
    done = python("-c", SESSION, env=environment, cwd=ROOT)
    assert done.returncode == 0, done.stderr
    assert not done.stderr
