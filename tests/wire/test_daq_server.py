"""The emulated NI gRPC Device Server itself: its rules, and what other clients ask of it."""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path

import grpc
import nidaqmx
import numpy as np
import pytest
from nidaqmx.constants import TerminalConfiguration
from nidaqmx.errors import DaqError, DaqReadError
from nidaqmx.stream_readers import AnalogMultiChannelReader

from tests.wire.daq_bench import Tone, daq_bench
from wavefocus.mocks.wire.ni_server import NiServer

ROOT = Path(__file__).parents[2]


@contextmanager
def client(address):
    options = [("grpc.enable_http_proxy", 0), ("grpc.max_receive_message_length", -1)]
    with grpc.insecure_channel(address, options) as channel:
        yield nidaqmx.GrpcSessionOptions(channel, "")


@contextmanager
def voltage_task(bench, samples=500):
    with client(bench.server.address) as options, nidaqmx.Task(grpc_options=options) as task:
        for name in ("ai0", "ai1"):
            task.ai_channels.add_ai_voltage_chan(
                f"Dev1/{name}", terminal_config=TerminalConfiguration.DIFF, min_val=-1.0, max_val=1.0
            )
        task.timing.cfg_samp_clk_timing(10_000.0, samps_per_chan=samples)
        yield task


def test_more_time_needed_than_allowed_then_what_there_is_comes_with_zeros_behind():
    with daq_bench() as bench, voltage_task(bench, samples=50_000) as task:
        task.start()
        reader = AnalogMultiChannelReader(task.in_stream)
        reader.verify_array_shape = False
        volts = np.full((2, 50_000), np.nan)
        with pytest.raises(DaqReadError) as caught:
            reader.read_many_sample(volts, 50_000, timeout=0.2)
        count = caught.value.samps_per_chan_read
        assert caught.value.error_code == -200284
        assert 2000 <= count < 50_000
        assert volts[:, :count].std() == pytest.approx(0.5 / np.sqrt(2), rel=0.05)
        assert not volts[:, count:].any()


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({"physical_channel": "Dev1/ai99"}, -200170),
        ({"physical_channel": "Dev1/ai8", "terminal_config": TerminalConfiguration.DIFF}, -200077),
    ],
)
def test_given_a_channel_that_the_box_has_not_then_it_has_the_codes_of_the_driver(settings, code):
    with daq_bench() as bench, client(bench.server.address) as options, nidaqmx.Task(grpc_options=options) as task:
        with pytest.raises(DaqError) as caught:
            task.ai_channels.add_ai_voltage_chan(**settings)
        assert caught.value.error_code == code


@pytest.mark.parametrize(("rate_hz", "samples", "code"), [(125_001, 500, -200081), (1e4, 1, -200077)])
def test_given_timing_that_the_box_cannot_do_then_it_has_the_codes_of_the_driver(rate_hz, samples, code):
    with daq_bench() as bench, voltage_task(bench) as task:
        with pytest.raises(DaqError) as caught:
            task.timing.cfg_samp_clk_timing(rate_hz, samps_per_chan=samples)
        assert caught.value.error_code == code


def test_given_a_call_or_a_property_that_is_not_here_then_it_says_so():
    with daq_bench() as bench, voltage_task(bench) as task:
        with pytest.raises(nidaqmx.errors.RpcError, match="UNIMPLEMENTED"):
            task.save("later")
        with pytest.raises(DaqError, match="-200452"):
            _ = task.timing.delay_from_samp_clk_delay


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
