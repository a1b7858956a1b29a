"""The NI recorder without faults: its packages, records through the real nidaqmx package over gRPC, whole counts."""

import sys
from concurrent.futures import ThreadPoolExecutor
from ctypes.util import find_library
from pathlib import Path

import grpc
import nidaqmx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.system.lines import python, wait_until
from tests.wire.daq_bench import TAKE, Tone, ask, check_tone, daq_bench, take_one
from tests.wire.emulated import rig_text
from wavefocus.configuration import load_rig
from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder
from wavefocus.drivers.daq.ni.ni_task import count_scale
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.mocks.wire.ni_products import PRODUCTS, Product
from wavefocus.mocks.wire.ni_server import NiServer
from wavefocus.rig.setup import with_stated_delay
from wavefocus.storage.bank.layout import BankHeader

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
    done = python("-c", OPENING, cwd=ROOT)
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


@pytest.fixture
def bench():
    with daq_bench() as bench:
        yield bench


def test_a_device_then_it_tells_product_serial_number_driver_address_and_inputs(bench):
    recorder = bench.recorder()
    name = recorder.identify()
    assert recorder.identity == DeviceIdentity("NI", "USB-6211", "01E57A2C")
    for part in ("USB-6211", "01E57A2C", "NI-DAQmx 24.5.0", bench.server.address, "Dev1", "ai0 and ai1 differential"):
        assert part in name


@pytest.mark.parametrize("product", PRODUCTS.values(), ids=lambda product: product.name)
def test_each_product_then_its_fastest_rate_and_all_its_ranges_record_whole_counts(product):
    with daq_bench(Tone(noise_v=0.01), product.name, speed=50.0) as bench:
        for terminal in product.terminals:
            recorder = bench.recorder(terminal=terminal)
            for range_v in product.ranges_v if terminal == product.terminals[0] else product.ranges_v[-1:]:
                limits_v = (range_v, product.ranges_v[-1])
                recording = take_one(recorder, 300, product.fastest_hz(2), limits_v)
                for volts, step_v, limit_v in zip(recording.volts, recording.volts_per_count, limits_v, strict=True):
                    counts = volts.astype(np.float64) / step_v
                    assert np.abs(counts - np.rint(counts)).max() < 0.01
                    assert np.abs(volts).max() <= limit_v * (1 + 1e-6)
                    nominal_v = 2 * limit_v / 2**16
                    assert step_v == pytest.approx(nominal_v * (1 + product.spare_codes), rel=1e-3)
                assert recording.over_range[0] == (range_v < 0.5)
            recorder.close()


@pytest.mark.parametrize(
    ("product", "terminal", "wrong", "refusal"),
    [
        ("USB-6211", "rse", {"rate_hz": 125_001}, "Maximum Value: 125000 .*sample_rate_hz of .capture"),
        ("USB-6356", "differential", {"rate_hz": 1.26e6}, "Maximum Value: 1.25e.06 .*sample_rate_hz of .capture"),
        ("USB-6211", "differential", {"rate_hz": 99_900.0}, "no sample rate of 99900 Hz; .* 100000 Hz"),
        ("USB-6211", "differential", {"range_v": (2.0, 10.0)}, "ai0 has no range of 2 V .*choose 5 V"),
    ],
)
def test_a_record_that_the_product_cannot_make_then_the_refusal_names_what_it_can(product, terminal, wrong, refusal):
    with daq_bench(product=product) as bench:
        recorder = bench.recorder(terminal=terminal)
        with pytest.raises(InstrumentError, match=refusal):
            recorder.start(ask(**({"range_v": (10.0, 10.0)} | wrong)))
        # 20 MHz / 2857 is 50 ppm off 7 kHz: the clocks of two devices differ by as much.
        check_tone(take_one(recorder, rate_hz=7000.0, range_v=(10.0, 10.0)))


def test_given_wiring_that_the_device_has_not_then_opening_names_what_it_has(bench):
    for changes, told in (
        ({"device": "Dev7"}, "opening: there is no device.*; .*Dev1"),
        ({"reference_input": "ai16"}, "no input 'ai16'.*; .*ai0, ai1, .*ai14 or ai15 into reference_input"),
        ({"terminal": "pseudodifferential"}, "cannot be a pseudodifferential.*; .*differential, rse or nrse"),
        ({"response_input": "ai9"}, "ai9 of USB-6211 cannot be a differential.*; .*rse or nrse into terminal"),
        ({"trigger": "PFI4"}, "no digital input 'PFI4'.*; .*PFI0, PFI1, PFI2 or PFI3 into trigger"),
    ):
        with pytest.raises(InstrumentError, match=told) as caught:
            bench.recorder(**changes)
        assert type(caught.value) is InstrumentError


@pytest.mark.parametrize(
    ("product", "rate_hz", "wiring", "delay_s"),
    [
        ("USB-6211", 10_000.0, {}, 14e-6),
        ("USB-6211", 100_000.0, {}, 5e-6),
        ("USB-6356", 10_000.0, {}, 0.0),
        ("USB-6211", 10_000.0, {"terminal": "nrse", "reference_input": "ai15", "response_input": "ai8"}, 14e-6),
    ],
)
def test_product_then_its_own_conversion_clock_says_how_late_response_is_sampled(product, rate_hz, wiring, delay_s):
    tone = Tone()
    with daq_bench(tone, product=product) as bench:
        recorder = bench.recorder(**wiring)
        assert recorder.sampling_delay_s(rate_hz) == pytest.approx(delay_s, abs=1e-9)
        # As the record then has it; the question has left nothing behind.
        take_one(recorder, 10, rate_hz, (10.0, 10.0))
        inputs = (wiring.get("reference_input", "ai0"), wiring.get("response_input", "ai1"))
        assert tone.asked == [(inputs, pytest.approx(delay_s, abs=1e-9))]
        assert recorder.sampling_delay_s(rate_hz) == pytest.approx(delay_s, abs=1e-9)


def test_given_a_new_bank_then_it_notes_the_delay_that_the_recorder_states(bench, tmp_path):
    rig_file, places = tmp_path / "rig.toml", (np.zeros((2, 2)), np.zeros((1, 2)))
    for stated_s, delay_s in (("5e-6", pytest.approx(14e-6, abs=1e-9)), ("1.41e-5", 14.1e-6)):  # wrong, and close
        text = rig_text(tmp_path, bench.server.address)
        rig_file.write_text(text.replace("delay_s = 1.4e-5", f"delay_s = {stated_s}"), encoding="utf-8")
        rig = load_rig(rig_file)
        header = BankHeader(10_000.0, 8, (20.0, 500.0), *places, rig.model_dump_json(), "{}", "0" * 64, "")
        assert with_stated_delay(header, rig).inter_channel_delay_s == delay_s


def test_a_record_starts_at_its_edge_and_another_thread_ends_the_wait_for_it(bench):
    recorder = bench.recorder(trigger="PFI0")
    recorder.start(ask())
    with pytest.raises(TransientInstrumentError, match=r"not finished.*rising edge reaches PFI0"):
        recorder.read(0.05)
    bench.server.box.edge("PFI1")
    with pytest.raises(TransientInstrumentError, match="not finished"):
        recorder.read(0.1)
    for way_out in (recorder.abort, recorder.close):
        bench.server.box.edge("PFI0")
        check_tone(recorder.read(10.0))
        recorder.start(ask())  # whose edge does not come
        with ThreadPoolExecutor(1) as thread:
            reading = thread.submit(recorder.read, 600.0)
            wait_until(lambda: "WaitUntilTaskDone" in bench.server.under_way, "the recorder waits")
            way_out()
            with pytest.raises(InstrumentError, match=rf"{TAKE}.*aborted"):
                reading.result()
        if way_out == recorder.abort:
            recorder.start(ask())


def test_another_input_then_its_volts_are_read_between_two_records_and_records_go_on():
    class Steady:
        def record(self, start_ns, samples, rate_hz, inputs, channel_delay_s):
            return np.array([[{"ai2": 0.213}.get(name, 0.0)] * samples for name in inputs])

    with daq_bench(Steady()) as bench:
        recorder = bench.recorder()
        assert take_one(recorder, 500).volts.shape == (2, 500)
        assert recorder.read_input_v("ai2") == pytest.approx(0.213, abs=1e-3)
        assert take_one(recorder, 500).volts.shape == (2, 500)
        recorder.start(ask(5000))
        with pytest.raises(InstrumentError, match="a record is under way"):
            recorder.read_input_v("ai2")
        recorder.abort()
        with pytest.raises(InstrumentError):
            recorder.read_input_v("ai99")


def test_a_module_of_5_v_with_rates_of_its_own_then_its_other_inputs_are_read_too(monkeypatch):
    # NI 9234: a converter for each input, 51.2 kS/s divided by a whole number.
    module = Product("NI 9234", 4, ("differential",), (5.0,), 51.2e3, 51.2e3, (), 0, (), simultaneous=True)
    monkeypatch.setitem(PRODUCTS, module.name, module)
    with daq_bench(product=module.name) as bench:
        recorder = bench.recorder()
        check_tone(take_one(recorder, rate_hz=10_240.0, range_v=(5.0, 5.0)))
        assert abs(recorder.read_input_v("ai2")) < 0.6
        with pytest.raises(InstrumentError, match=r"no sample rate of 10000 Hz; choose the nearest one .* 10240 Hz"):
            recorder.start(ask(range_v=(5.0, 5.0)))


def test_ranges_of_a_differential_input_alone_then_a_single_ended_one_has_them_not(monkeypatch):
    box = Product("USB-6009", 8, ("differential", "rse"), (5.0, 10.0, 20.0), 48e3, 24e6, ("PFI0",), 2, ())
    monkeypatch.setitem(PRODUCTS, box.name, box)
    with daq_bench(product=box.name) as bench:
        for terminal, ranges_v in (("differential", box.ranges_v), ("rse", box.ranges_v[:-1])):
            recorder = bench.recorder(terminal=terminal)
            assert recorder.input_ranges_v == ranges_v
            assert recorder.sampling_delay_s(5000.0) > 0
            check_tone(take_one(recorder, rate_hz=5000.0, range_v=ranges_v[-2:]))
            assert abs(recorder.read_input_v("ai2")) < 0.6
            recorder.close()


def test_one_server_at_an_address_serves_programs_of_nidaqmx_too(bench):
    with pytest.raises(RuntimeError, match=bench.server.address):
        NiServer(Tone(), address=bench.server.address).start()
    options = [("grpc.enable_http_proxy", 0), ("grpc.max_receive_message_length", -1)]
    with grpc.insecure_channel(bench.server.address, options) as channel:
        session = nidaqmx.GrpcSessionOptions(channel, "")
        assert nidaqmx.system.System(session).devices["Dev1"].is_simulated is False
        with nidaqmx.Task(grpc_options=session) as task:
            task.ai_channels.add_ai_voltage_chan("Dev1/ai0, Dev1/ai1, Dev1/ai3")
            task.timing.cfg_samp_clk_timing(10_000.0, samps_per_chan=10)
            assert task.timing.ai_conv_rate == pytest.approx(1 / 14e-6)
            assert task.channel_names == ["Dev1/ai0", "Dev1/ai1", "Dev1/ai3"]
            assert np.array(task.read(number_of_samples_per_channel=10)).shape == (3, 10)


# -- counts of a converter -----------------------------------------------------------------------------


@given(
    range_v=st.sampled_from([0.2, 1.0, 1.25, 5.0, 10.0, 20.0]),
    bits=st.sampled_from([12, 13, 14, 16]),
    offset=st.floats(-20, 20),  # in steps
    gain=st.floats(0.97, 1.06),  # step over its nominal value
    shift=st.integers(0, 4),  # bits by which codes are shifted in their word
    seed=st.integers(0, 2**32 - 1),
)
def test_a_calibrated_converter_then_its_codes_come_back_as_counts_without_noise(
    range_v, bits, offset, gain, shift, seed
):
    step_v = 2 * range_v / 2**bits * gain
    codes = np.random.default_rng(seed).integers(-(2 ** (bits - 2)), 2 ** (bits - 2), 1000)
    coefficients = [offset * step_v, step_v / 2**shift, 0.0, 0.0]
    volts = coefficients[0] + coefficients[1] * (codes * 2**shift)
    scale = count_scale(range_v, bits, coefficients)
    assert scale.step_v == pytest.approx(step_v, rel=1e-12)
    out = np.empty(volts.shape, dtype=np.float32)
    assert not scale.quantise(volts.copy(), out)
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
