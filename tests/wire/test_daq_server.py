"""The emulated NI gRPC Device Server itself: its rules, and what other clients ask of it."""

from contextlib import contextmanager

import grpc
import nidaqmx
import numpy as np
import pytest

from tests.wire.daq_bench import Tone, daq_bench
from wavefocus.mocks.wire.ni_server import NiServer


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
