"""The NI recorder's surroundings: packages, the emulated server, counts of converters."""

import subprocess
import sys
from contextlib import contextmanager
from ctypes.util import find_library
from pathlib import Path

import grpc
import nidaqmx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.wire.daq_bench import Tone, daq_bench
from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder
from wavefocus.drivers.daq.ni.ni_task import count_scale
from wavefocus.drivers.errors import InstrumentError
from wavefocus.mocks.wire.ni_server import NiServer

ROOT = Path(__file__).parents[2]
# In a process of its own, in which the import of some packages fails as if they were not installed.
OPENING = """
import sys
from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder
from wavefocus.drivers.errors import MissingPackageError
def opened_without(missing, address):
    unneeded = {"nidaqmx", "grpc", "google.protobuf"} - {missing}
    assert not unneeded & set(sys.modules), "imported before it is needed"
    sys.modules[missing] = None
    try:
        NiRecorder("Dev1", address=address, reference_input="ai0", response_input="ai1", terminal="rse", trigger=None)
    except MissingPackageError as error:
        print(error.instrument, error.operation, error.cause.partition(" (")[0], error.remedy, sep="|")
    del sys.modules[missing]
opened_without("nidaqmx", None)
opened_without("nidaqmx", "localhost:31763")
opened_without("grpc", "localhost:31763")
"""


def test_given_a_package_that_is_not_installed_then_opening_says_how_to_install_it():
    done = subprocess.run([sys.executable, "-c", OPENING], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    local, remote = "recorder Dev1|opening|", "recorder Dev1 at localhost:31763|opening|"
    assert done.stdout.splitlines() == [
        f'{local}the Python package nidaqmx is missing|install it: pip install "nidaqmx"',
        f'{remote}the Python package nidaqmx is missing|install it: pip install "wavefocus[remote]"',
        f'{remote}what the nidaqmx package needs for an address is missing|install it: pip install "wavefocus[remote]"',
    ]


@pytest.mark.may_skip("NI-DAQmx is on this computer")
@pytest.mark.skipif(sys.platform == "win32" or find_library("nidaqmx") is not None, reason="NI-DAQmx may be here")
def test_no_driver_on_this_computer_then_it_names_driver_and_way_over_network():
    with pytest.raises(InstrumentError, match="the NI-DAQmx driver is not on this computer") as caught:
        NiRecorder("Dev1", address=None, reference_input="ai0", response_input="ai1", terminal="rse", trigger=None)
    assert caught.value.instrument == "recorder Dev1"
    assert "install NI-DAQmx from ni.com, or give address of [recorder]" in caught.value.remedy


@contextmanager
def client(address):
    options = [("grpc.enable_http_proxy", 0), ("grpc.max_receive_message_length", -1)]
    with grpc.insecure_channel(address, options) as channel:
        yield nidaqmx.GrpcSessionOptions(channel, "")


def test_given_a_port_that_is_taken_then_a_second_server_does_not_start():
    with daq_bench() as bench:
        second = NiServer(Tone(), address=bench.server.address)
        with pytest.raises(RuntimeError, match=bench.server.address):
            second.start()


def test_given_a_program_of_nidaqmx_then_it_runs():
    with daq_bench() as bench, client(bench.server.address) as options:
        assert nidaqmx.system.System(options).devices["Dev1"].is_simulated is False
        with nidaqmx.Task(grpc_options=options) as task:
            task.ai_channels.add_ai_voltage_chan("Dev1/ai0, Dev1/ai1, Dev1/ai3")
            task.timing.cfg_samp_clk_timing(10_000.0, samps_per_chan=10)
            assert task.timing.ai_conv_rate == pytest.approx(1 / 14e-6)
            assert task.channel_names == ["Dev1/ai0", "Dev1/ai1", "Dev1/ai3"]
            assert np.array(task.read(number_of_samples_per_channel=10)).shape == (3, 10)


ranges_v = st.sampled_from([0.2, 1.0, 1.25, 5.0, 10.0, 20.0])
calibrations = st.tuples(
    st.sampled_from([12, 13, 14, 16]),
    st.floats(-20, 20),  # offset in steps
    st.floats(0.97, 1.06),  # step over its nominal value
    st.integers(0, 4),  # bits by which codes are shifted in their word
)


def quantised(scale, volts):
    out = np.empty(volts.shape, dtype=np.float32)
    return scale.quantise(volts.copy(), out), out


@given(ranges_v, calibrations, st.integers(0, 2**32 - 1))
def test_a_calibrated_converter_then_its_codes_come_back_as_counts_without_noise(range_v, calibration, seed):
    bits, offset, gain, shift = calibration
    step_v = 2 * range_v / 2**bits * gain
    codes = np.random.default_rng(seed).integers(-(2 ** (bits - 2)), 2 ** (bits - 2), 1000)
    coefficients = [offset * step_v, step_v / 2**shift, 0.0, 0.0]
    volts = coefficients[0] + coefficients[1] * (codes * 2**shift)
    scale = count_scale(range_v, bits, coefficients)
    assert scale.step_v == pytest.approx(step_v, rel=1e-12)
    over_range, out = quantised(scale, volts)
    assert not over_range
    counts = np.rint(out.astype(np.float64) / scale.step_v)
    difference = counts - codes
    # The same everywhere, but where the offset is half a step and rounding decides.
    assert difference.max() - difference.min() <= (1 if abs(offset % 1 - 0.5) < 1e-6 else 0)
    assert np.abs(out - volts).max() <= 0.51 * scale.step_v


@pytest.mark.parametrize(
    "coefficients", [None, [], [0.0], [0.0, 0.0], [0.0, -1e-3], [0.0, 5.0], [0.0, 4.2e-4, 0.0]], ids=str
)
def test_given_no_sensible_calibration_then_the_step_is_the_nominal_one(coefficients):
    scale = count_scale(10.0, 16, coefficients)
    assert scale.step_v == 10.0 / 32768
    assert (scale.lowest, scale.highest) == (-32768, 32767)
