"""The NI recorder through the driver on this computer: the real package over a library that stands in for NI's."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
LINUX_ONLY = pytest.mark.skipif(sys.platform != "linux", reason="elsewhere libraries are not found by a path variable")
STANDS_IN = pytest.mark.may_skip("a stand-in for the driver's library can be put on the loader's path on Linux alone")

SESSION = """
import ctypes, json, sys, warnings
warnings.simplefilter("error")
from drivers.daq.ni.ni_recorder import NiRecorder
from drivers.errors import InstrumentError
from drivers.protocols import RecordRequest, Take

def opened(device="Dev1", **changes):
    wiring = dict(address=None, reference_input="ai0", response_input="ai1", terminal="differential", trigger=None)
    return NiRecorder(device, **{**wiring, **changes})

def request(samples=1000, range_v=(10.0, 10.0), rate_hz=10_000.0):
    return RecordRequest(samples, rate_hz, range_v, Take(7, 1, 0))

def told(call):
    try:
        call()
    except InstrumentError as error:
        return [type(error).__name__, str(error)]

def tasks():
    return ctypes.CDLL("libnidaqmx.so").shim_tasks()

answers = {}
"""
CLOSING = """
json.dump(answers, sys.stdout)
"""


@pytest.fixture(scope="module")
def library(tmp_path_factory):
    folder = tmp_path_factory.mktemp("driver")
    source = Path(__file__).with_name("libnidaqmx.c")
    # The name within the library is what the loader goes by.
    command = ["gcc", "-shared", "-fPIC", "-Wall", "-Wextra", "-Werror", "-Wl,-soname,libnidaqmx.so"]
    subprocess.run([*command, "-o", folder / "libnidaqmx.so", source, "-lm"], check=True)
    return folder


def session(library, script, **environment):
    """Run a script in a process whose loader finds the stand-in."""
    environment = {**os.environ, "LD_LIBRARY_PATH": str(library), **environment}
    done = subprocess.run(
        [sys.executable, "-c", SESSION + script + CLOSING],
        cwd=ROOT, env=environment, capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert not done.stderr
    return json.loads(done.stdout)


@LINUX_ONLY
@STANDS_IN
def test_given_the_local_driver_then_records_are_taken_again_and_again_and_the_device_is_given_back(library):
    answers = session(
        library,
        """
recorder = opened()
answers["name"] = recorder.identify()
for record in range(3):
    recorder.start(request())
    recording = recorder.read(5.0)
answers["shape"] = recording.volts.shape
answers["peaks"] = [float(abs(row).max()) for row in recording.volts]
answers["step"] = recording.volts_per_count[0]
answers["over"] = recording.over_range
answers["tasks"] = tasks()
recorder.start(request(100_000))
answers["early"] = told(lambda: recorder.read(0.01))
recorder.abort()
recorder.start(request())
recorder.reconnect()
recorder.start(request(1))
answers["one"] = recorder.read(5.0).volts.shape
recorder.close()
answers["left"] = tasks()
""",
    )
    assert answers["name"] == (
        "NI USB-6001, serial number 01C0FFEE, Dev1 on this computer, NI-DAQmx 23.8.1, ai0 and ai1 differential"
    )
    assert answers["shape"] == [2, 1000]
    assert answers["peaks"] == pytest.approx([0.5, 2.0], abs=0.003)
    assert answers["step"] == pytest.approx(20 / 2**14 * 1.01)
    assert answers["over"] == [False, False]
    assert answers["tasks"] == 1
    assert answers["early"][0].endswith("UnfinishedError")
    assert "position 7, attempt 1, record 0: not finished after 0.01 s" in answers["early"][1]
    assert answers["one"] == [2, 1]
    assert answers["left"] == 0


@LINUX_ONLY
@STANDS_IN
def test_given_what_the_device_has_not_then_the_local_driver_is_asked_and_the_refusal_names_what_there_is(library):
    answers = session(
        library,
        """
answers["name"] = told(lambda: opened("Dev9"))
answers["terminal"] = told(lambda: opened(terminal="nrse"))
recorder = opened()
answers["range"] = told(lambda: recorder.start(request(range_v=(5.0, 10.0))))
answers["rate"] = told(lambda: recorder.start(request(rate_hz=11_000.0)))
recorder.start(request())
second = opened()
answers["busy"] = told(lambda: second.start(request()))
recorder.close()
second.close()
answers["left"] = tasks()
""",
    )
    assert "there is no device of this name (NI-DAQmx -200220); put a name" in answers["name"][1]
    assert "Dev1, Dev2" in answers["name"][1]
    assert "put differential or rse into terminal" in answers["terminal"][1]
    assert "no range of 5 V; choose 10 V" in answers["range"][1]
    assert "choose 0 to 10000 Hz" in answers["rate"][1]
    assert "another program has reserved it" in answers["busy"][1]
    assert answers["left"] == 0


@LINUX_ONLY
@STANDS_IN
@pytest.mark.parametrize(
    ("status", "error", "cause"),
    [
        ("-200284", "TransientInstrumentError", "did not come in time (NI-DAQmx -200284); 500"),
        ("-209999", "InstrumentError", "NI-DAQmx says: As ordered"),
    ],
)
def test_given_a_fault_of_the_local_driver_then_it_is_told_and_nothing_is_left(library, status, error, cause):
    answers = session(
        library,
        """
recorder = opened()
recorder.start(request())
answers["told"] = told(lambda: recorder.read(5.0))
answers["tasks"] = tasks()
recorder.close()
""",
        SHIM_READ_STATUS=status,
    )
    assert answers["told"][0] == error
    assert cause in answers["told"][1]
    assert answers["tasks"] == 0


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
IN_A_PROCESS = """
import os
from pathlib import Path
from drivers.daq.ni.recorder_process import ProcessRecorder

def in_a_process(device="Dev1", **changes):
    wiring = dict(reference_input="ai0", response_input="ai1", terminal="differential", trigger=None)
    return ProcessRecorder(device, **{**wiring, **changes})

def taken(recorder):
    recorder.start(request())
    recording = recorder.read(5.0)
    return [list(recording.volts.shape), [float(abs(row).max()) for row in recording.volts]]

unplugged = Path(os.environ["SHIM_UNPLUGGED"])
"""


@LINUX_ONLY
@STANDS_IN
def test_given_a_library_that_stays_broken_after_a_replug_then_a_fresh_process_brings_the_device_back(
    library, tmp_path
):
    answers = session(
        library,
        IN_A_PROCESS
        + """
recorder, here = in_a_process(), opened("Dev1")
answers["first"], process = taken(recorder), recorder.process_id
unplugged.touch()
answers["unplugged"] = told(lambda: taken(recorder))
answers["away"] = told(recorder.reconnect)
answers["not connected"] = told(lambda: taken(recorder))
answers["here"] = told(here.reconnect)
unplugged.unlink()
answers["here again"] = told(here.reconnect)
recorder.reconnect()
answers["again"] = taken(recorder)
answers["fresh"] = recorder.process_id != process
answers["name"] = recorder.identify()
answers["identity"] = str(recorder.identity)
answers["ranges"] = recorder.input_ranges_v
answers["input"] = recorder.read_input_v("ai2")
recorder.start(request(100_000))
recorder.abort()
answers["aborted"] = told(lambda: recorder.read(0.1))
answers["early"] = (recorder.start(request(100_000)), told(lambda: recorder.read(0.01)))[1]
recorder.close()
recorder.close()
answers["closed"] = told(lambda: recorder.start(request()))
""",
        SHIM_UNPLUGGED=str(tmp_path / "unplugged"),
    )
    shape, peaks = answers["first"]
    assert shape == [2, 1000]
    assert peaks == pytest.approx([0.5, 2.0], abs=0.003)
    assert answers["unplugged"][0] == "InstrumentLostError"
    assert "unplugged" in answers["unplugged"][1]
    assert answers["away"][0] == "InstrumentLostError"
    assert "reconnect first" in answers["not connected"][1]
    # In one and the same process it never comes back.
    assert [answers["here"][0], answers["here again"][0]] == ["InstrumentLostError", "InstrumentLostError"]
    assert answers["again"] == answers["first"]
    assert answers["fresh"]
    assert answers["name"].startswith("NI USB-6001, serial number 01C0FFEE, Dev1 on this computer")
    assert answers["identity"] == "NI USB-6001, serial number 01C0FFEE"
    assert answers["ranges"] == [10.0]
    assert abs(answers["input"]) < 1.0
    assert "no record was started" in answers["aborted"][1]
    assert answers["early"][0].endswith("UnfinishedError")
    assert "it is closed" in answers["closed"][1]


@LINUX_ONLY
@STANDS_IN
def test_given_the_process_of_the_library_is_killed_then_the_recorder_is_lost_and_comes_back(library, tmp_path):
    answers = session(
        library,
        IN_A_PROCESS
        + """
import signal
recorder = in_a_process()
recorder.start(request(100_000))
os.kill(recorder.process_id, signal.SIGKILL)
answers["killed"] = told(lambda: recorder.read(20.0))
recorder.abort()
recorder.reconnect()
answers["again"] = taken(recorder)[0]
recorder.close()
""",
        SHIM_UNPLUGGED=str(tmp_path / "unplugged"),
    )
    assert answers["killed"][0] == "InstrumentLostError"
    assert "the process that runs NI-DAQmx ended" in answers["killed"][1]
    assert answers["again"] == [2, 1000]


@LINUX_ONLY
@STANDS_IN
def test_given_a_library_that_hangs_then_reconnecting_ends_it_with_its_process(library, tmp_path):
    answers = session(
        library,
        IN_A_PROCESS
        + """
import threading
recorder, hangs = in_a_process(), Path(os.environ["SHIM_HANGS"])
process = recorder.process_id
hangs.touch()
hung = []
thread = threading.Thread(target=lambda: hung.append(told(recorder.identify)))
thread.start()
threading.Timer(0.3, hangs.unlink).start()
recorder.reconnect()
thread.join()
answers["hung"] = hung[0]
answers["again"] = taken(recorder)[0]
answers["fresh"] = recorder.process_id != process
recorder.close()
""",
        SHIM_UNPLUGGED=str(tmp_path / "unplugged"),
        SHIM_HANGS=str(tmp_path / "hangs"),
    )
    assert answers["again"] == [2, 1000]
    assert answers["fresh"]


@LINUX_ONLY
@STANDS_IN
def test_given_a_rig_file_without_an_address_then_the_library_is_loaded_in_a_process_of_its_own(library, tmp_path):
    rig_file = tmp_path / "rig.toml"
    rig_file.write_text(RIG, encoding="utf-8")
    answers = session(
        library,
        """
import os
from pathlib import Path
from wavefocus.configuration import load_rig
from wavefocus.rig.instruments import openers
recorder = openers(load_rig(Path(os.environ["RIG_FILE"]))).recorder()
answers["name"] = recorder.identify()
answers["here"] = "nidaqmx" in sys.modules
recorder.close()
""",
        RIG_FILE=str(rig_file),
    )
    assert answers["name"].startswith("NI USB-6001")
    assert not answers["here"]
