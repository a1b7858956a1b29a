"""The emulated NI gRPC Device Server itself: its own process, its own rules, and what other clients ask of it."""

from __future__ import annotations

import subprocess
import sys
import threading
from contextlib import contextmanager
from pathlib import Path

import grpc
import nidaqmx
import numpy as np
import pytest
from nidaqmx.constants import READ_ALL_AVAILABLE, AcquisitionType, TerminalConfiguration
from nidaqmx.errors import DaqError, DaqReadError

from drivers.daq.ni.ni_recorder import NiRecorder
from drivers.errors import InstrumentLostError
from mocks.wire.ni.ni_server import NiServer
from tests.wire.daq_bench import Tone, ask, check_tone, daq_bench, take_one

ROOT = Path(__file__).parents[2]


@contextmanager
def client(address):
    options = [("grpc.enable_http_proxy", 0), ("grpc.max_receive_message_length", -1)]
    with grpc.insecure_channel(address, options) as channel:
        yield nidaqmx.GrpcSessionOptions(channel, "")


@contextmanager
def voltage_task(bench, mode=AcquisitionType.FINITE, samples=500, rate_hz=10_000.0):
    with client(bench.server.address) as options, nidaqmx.Task(grpc_options=options) as task:
        for name in ("ai0", "ai1"):
            task.ai_channels.add_ai_voltage_chan(
                f"Dev1/{name}", terminal_config=TerminalConfiguration.DIFF, min_val=-1.0, max_val=1.0
            )
        task.timing.cfg_samp_clk_timing(rate_hz, sample_mode=mode, samps_per_chan=samples)
        yield task


@contextmanager
def server_process():
    command = [sys.executable, "-m", "mocks.wire.ni.ni_process", "--product", "USB-6212", "--tone-v", "0.5"]
    with subprocess.Popen(command, cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process, process.stdout.readline().strip()
        finally:
            process.kill()


def opened_at(address):
    return NiRecorder(
        "Dev1", address=address, reference_input="ai0", response_input="ai1", terminal="differential", trigger=None
    )


def test_given_a_server_in_its_own_process_then_it_records_until_its_input_ends():
    with server_process() as (process, address):
        recorder = opened_at(address)
        assert "USB-6212" in recorder.identify()
        check_tone(take_one(recorder))
        recorder.close()
        process.stdin.close()
        assert process.wait() == 0


def test_given_a_server_killed_during_a_record_then_it_is_lost():
    with server_process() as (process, address):
        recorder = opened_at(address)
        recorder.start(ask(50_000))
        killer = threading.Timer(0.1, process.kill)
        killer.start()
        with pytest.raises(InstrumentLostError, match="cannot be reached, or went away during the call"):
            recorder.read(20.0)
        killer.join()
        recorder.abort()
        with pytest.raises(InstrumentLostError):
            recorder.reconnect()
        recorder.close()


def test_given_the_plain_package_then_a_task_reads_its_samples_and_names_itself():
    with daq_bench() as bench, voltage_task(bench) as task:
        volts = np.array(task.read(READ_ALL_AVAILABLE))
        assert volts.shape == (2, 500)
        assert volts.std() == pytest.approx(0.5 / np.sqrt(2), rel=0.01)
        assert task.channel_names == ["Dev1/ai0", "Dev1/ai1"]
        assert task.timing.samp_clk_rate == 10_000.0
        assert task.timing.ai_conv_rate == pytest.approx(1 / 14e-6)
        with pytest.raises(DaqError) as caught:
            task.read(10)
        assert caught.value.error_code == -200278
        task.stop()


def test_given_more_time_needed_than_allowed_then_what_there_is_comes_with_zeros_behind():
    with daq_bench() as bench, voltage_task(bench, samples=50_000) as task:
        task.start()
        reader = nidaqmx.stream_readers.AnalogMultiChannelReader(task.in_stream)
        volts = np.full((2, 50_000), np.nan)
        with pytest.raises(DaqReadError) as caught:
            reader.read_many_sample(volts, 50_000, timeout=0.2)
        count = caught.value.samps_per_chan_read
        assert caught.value.error_code == -200284
        assert 2000 <= count < 50_000
        assert volts[:, :count].std() == pytest.approx(0.5 / np.sqrt(2), rel=0.05)
        assert not volts[:, count:].any()


def test_given_a_continuous_task_that_nobody_reads_then_its_buffer_is_overwritten():
    with daq_bench(speed=100.0) as bench, voltage_task(bench, AcquisitionType.CONTINUOUS, 1000) as task:
        task.start()
        while task.in_stream.avail_samp_per_chan < 20_000:
            pass
        with pytest.raises(DaqReadError) as caught:
            task.read(100)
        assert caught.value.error_code == -200279


def test_given_a_continuous_task_then_its_events_come_every_so_many_samples():
    turns = threading.Semaphore(0)

    def told(task_handle, event_type, samples, data):
        assert samples == 200
        turns.release()
        return 0

    with daq_bench() as bench, voltage_task(bench, AcquisitionType.CONTINUOUS, 10_000) as task:
        task.register_every_n_samples_acquired_into_buffer_event(200, told)
        task.start()
        for _ in range(3):
            turns.acquire()
            assert np.array(task.read(200)).shape == (2, 200)
        task.stop()
        task.register_every_n_samples_acquired_into_buffer_event(200, None)


def test_given_a_look_up_of_devices_then_the_box_tells_what_it_is():
    with daq_bench(product="USB-6009") as bench, client(bench.server.address) as options:
        system = nidaqmx.system.System.remote(options)
        device = system.devices["Dev1"]
        assert system.devices.device_names == ["Dev1"]
        assert (device.product_type, device.serial_num) == ("USB-6009", 0x01E57A2C)
        assert device.ai_voltage_rngs[-2:] == [-20.0, 20.0]
        assert device.ai_max_multi_chan_rate == 48_000
        assert not device.ai_simultaneous_sampling_supported
        device.self_test_device()
        device.reset_device()


@pytest.mark.parametrize(
    ("settings", "code"),
    [
        ({"physical_channel": "Dev2/ai0"}, -200220),
        ({"physical_channel": "Dev1/ai99"}, -200170),
        ({"physical_channel": "Dev1/ai0", "max_val": 30.0}, -200077),
        ({"physical_channel": "Dev1/ai8", "terminal_config": TerminalConfiguration.DIFF}, -200077),
    ],
)
def test_given_a_channel_that_the_box_has_not_then_it_has_the_codes_of_the_driver(settings, code):
    with daq_bench() as bench, client(bench.server.address) as options, nidaqmx.Task(grpc_options=options) as task:
        with pytest.raises(DaqError) as caught:
            task.ai_channels.add_ai_voltage_chan(**settings)
        assert caught.value.error_code == code


@pytest.mark.parametrize(
    ("rate_hz", "samples", "code"), [(125_001, 500, -200081), (1e6, 500, -200077), (1e4, 1, -200077)]
)
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


def test_given_a_server_then_its_log_tells_calls_and_what_came_of_them():
    with daq_bench() as bench:
        recorder = bench.recorder()
        take_one(recorder)
        bench.server.unplug()
        with pytest.raises(InstrumentLostError):
            recorder.start(ask())
        started = [call.status for call in bench.server.log if call.name == "StartTask"]
        assert started == [0, -201003]
        waited = next(call for call in bench.server.log if call.name == "WaitUntilTaskDone")
        assert waited.seconds > 0
