"""What is not installed is a sentence of its own, and costs nothing until a recorder is opened."""

import subprocess
import sys
from ctypes.util import find_library
from pathlib import Path

import pytest

from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder
from wavefocus.drivers.errors import InstrumentError

ROOT = Path(__file__).parents[2]
# A process of its own, in which the import of some packages fails as if they were not installed.
OPENING = """
import sys
for name in {missing!r}:
    sys.modules[name] = None
from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder
from wavefocus.drivers.errors import MissingPackageError
assert not any(name in sys.modules for name in {unneeded!r}), "imported before it is needed"
try:
    NiRecorder("Dev1", address={address!r}, reference_input="ai0", response_input="ai1", terminal="rse", trigger=None)
except MissingPackageError as error:
    print(error.instrument, error.operation, error.cause, error.remedy, sep="|")
"""


def opened_without(missing, address):
    unneeded = [name for name in ("nidaqmx", "grpc", "google.protobuf") if name not in missing]
    script = OPENING.format(missing=missing, address=address, unneeded=unneeded)
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return done.stdout.strip().split("|")


@pytest.mark.parametrize(
    ("missing", "address", "cause", "package"),
    [
        ("nidaqmx", None, "the Python package nidaqmx is missing", "nidaqmx"),
        ("nidaqmx", "localhost:31763", "the Python package nidaqmx is missing", "wavefocus[remote]"),
        ("grpc", "localhost:31763", "what the nidaqmx package needs for an address is missing", "wavefocus[remote]"),
    ],
)
def test_given_a_package_that_is_not_installed_then_opening_says_how_to_install_it(missing, address, cause, package):
    instrument, operation, told, remedy = opened_without([missing], address)
    assert (instrument, operation) == (f"recorder Dev1{f' at {address}' if address else ''}", "opening")
    assert cause in told
    assert remedy == f'install it: pip install "{package}"'


@pytest.mark.may_skip("NI-DAQmx is on this computer")
@pytest.mark.skipif(sys.platform == "win32" or find_library("nidaqmx") is not None, reason="NI-DAQmx may be here")
def test_no_driver_on_this_computer_then_it_names_driver_and_way_over_network():
    with pytest.raises(InstrumentError, match="the NI-DAQmx driver is not on this computer") as caught:
        NiRecorder("Dev1", address=None, reference_input="ai0", response_input="ai1", terminal="rse", trigger=None)
    assert caught.value.instrument == "recorder Dev1"
    assert "install NI-DAQmx from ni.com, or give address of [recorder]" in caught.value.remedy
