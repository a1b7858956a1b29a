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
from drivers.daq.ni_recorder import NiRecorder
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
        ("-200279", "TransientInstrumentError", "overwritten"),
        (
            "-200284",
            "TransientInstrumentError",
            "samples are missing: they did not come in time (NI-DAQmx -200284); 500",
        ),
        ("-201003", "InstrumentLostError", "unplugged"),
        ("-50405", "InstrumentLostError", "USB transfer was aborted"),
        ("200005", "TransientInstrumentError", "NI-DAQmx warns"),
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
