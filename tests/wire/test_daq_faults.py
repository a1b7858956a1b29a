"""Every row of the fault table: what arrives over the wire becomes a sentence, and the next record is good."""

import re
import time
from pathlib import Path

import grpc
import numpy as np
import pytest
from nidaqmx.error_codes import DAQmxErrors
from nidaqmx.errors import DaqError, DaqWarning, RpcError

from tests.wire.daq_bench import RANGE_V, TAKE, Tone, ask, check_tone, daq_bench, take_one
from wavefocus.drivers.daq.ni import MEANINGS, explain
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError, UnknownFaultError
from wavefocus.mocks.wire import WireFault
from wavefocus.mocks.wire.ni_server import NiServer

# No test waits long for an answer that does not come.
ANSWER_S = 0.5
PASSING, LOST, FOR_GOOD = TransientInstrumentError, InstrumentLostError, InstrumentError
UNKNOWN = UnknownFaultError


def fault(kind, operation, at_call=2, **more):
    return (WireFault("recorder", kind, operation, at_call=at_call, **more),)


def until_reconnected(recorder):
    """Try until the device is back, as the engine does; bounded by the test's timeout."""
    while True:
        try:
            return recorder.reconnect()
        except InstrumentLostError:
            time.sleep(0.02)


@pytest.mark.parametrize(
    ("kind", "operation", "error", "cause"),
    [
        ("overwritten", "ReadAnalogF64", PASSING, "overwritten before they could be read .NI-DAQmx -200279"),
        ("read_timeout", "ReadAnalogF64", PASSING, "samples are missing.*-200284.; 250 came"),
        ("short_read", "ReadAnalogF64", PASSING, "only 250 of 500 came"),
        ("warning", "ReadAnalogF64", PASSING, "NI-DAQmx warns.*ADC_OVERLOADED"),
        ("wait_timeout", "WaitUntilTaskDone", PASSING, "not finished after 1 s"),
        ("unplugged", "StartTask", LOST, "cannot be accessed: unplugged.*-201003"),
        ("unplugged", "ReadAnalogF64", LOST, "cannot be accessed: unplugged.*-201003"),
        ("in_use", "StartTask", LOST, "reserved, .*-50103"),
        ("unknown_code", "ReadAnalogF64", UNKNOWN, "NI-DAQmx says: .*-229771"),
        ("unknown_code", "StartTask", UNKNOWN, "NI-DAQmx says: .*-229771"),
        ("silent", "StartTask", LOST, "does not answer .StartTask got no answer within 0.5 s"),
        ("server_dead", "WaitUntilTaskDone", LOST, "cannot be reached, or went away"),
    ],
    ids=lambda value: value if isinstance(value, str) and " " not in value else "",
)
def test_given_a_fault_in_the_second_record_then_it_is_told_and_the_third_is_good(kind, operation, error, cause):
    seconds = 0.2 if kind in ("unplugged", "server_dead") else 0.0
    with daq_bench(faults=fault(kind, operation, seconds=seconds)) as bench:
        recorder = bench.recorder(answer_s=ANSWER_S)
        check_tone(take_one(recorder))
        with pytest.raises(InstrumentError, match=cause) as caught:
            take_one(recorder, timeout_s=1.0)
        assert isinstance(caught.value, error)
        assert caught.value.instrument == f"recorder Dev1 at {bench.server.address}"
        assert str(TAKE) in caught.value.operation
        assert caught.value.remedy
        recorder.abort()
        if issubclass(error, LOST):
            until_reconnected(recorder)
        check_tone(take_one(recorder))
        recorder.close()
        # Nothing is left of what failed: the next program can have the device.
        check_tone(take_one(bench.recorder()))


@pytest.mark.parametrize(
    ("code", "known", "owned", "error", "cause"),
    [
        (-88705, False, False, LOST, "not present .NI-DAQmx -88705"),
        (-50405, False, False, LOST, "USB transfer was aborted .NI-DAQmx -50405"),
        (-200220, True, False, LOST, "not there any more .NI-DAQmx -200220"),
        (-200220, False, False, FOR_GOOD, "no device of this name"),
        (-50103, True, True, LOST, "reserved"),
        (-50103, True, False, FOR_GOOD, "another program has reserved it"),
        (-200022, True, False, FOR_GOOD, "another program has reserved it"),
        (-229771, True, True, UNKNOWN, "NI-DAQmx says"),
        (-229771, True, False, FOR_GOOD, "NI-DAQmx says"),
        (-229771, False, False, FOR_GOOD, "NI-DAQmx says"),
    ],
)
def test_given_a_code_of_the_driver_then_it_has_its_meaning(code, known, owned, error, cause):
    explained = explain(DaqError("", code), "recorder Dev1", "opening", known=known, owned=owned)
    assert type(explained) is error
    assert re.search(cause, explained.cause)
    assert explained.remedy


def test_given_the_names_of_codes_then_each_is_in_nis_own_list_and_stands_once():
    names = [name for words in MEANINGS.values() for name in words.split()]
    assert set(names) <= set(DAQmxErrors.__members__)
    assert len(set(names)) == len(names)


def test_given_any_code_in_mid_campaign_then_it_is_tried_again_at_least_once():
    kinds = {
        type(explain(DaqError("", code.value), "recorder Dev1", "recording", known=True, owned=True))
        for code in DAQmxErrors
    }
    assert kinds == {PASSING, LOST, UNKNOWN}


@pytest.mark.parametrize("known", [True, False])
def test_what_no_code_explains_is_tried_again_on_a_device_that_has_recorded(known):
    rpc = RpcError(grpc.StatusCode.DATA_LOSS, "data loss")
    for failure in (rpc, ValueError("Cannot invoke RPC on closed channel!"), DaqWarning("", 200015)):
        explained = explain(failure, "recorder Dev1", "recording", known=known, owned=known)
        assert type(explained) is (UNKNOWN if known else FOR_GOOD)


@pytest.mark.parametrize(
    ("kind", "operation", "error"),
    [
        ("wrong_name", "GetDeviceAttributeString", FOR_GOOD),
        ("silent", "GetSystemInfoAttributeUInt32", LOST),
        ("server_dead", "GetSystemInfoAttributeUInt32", LOST),
        ("usb_aborted", "CreateTask", LOST),
        ("warning", "CreateAIVoltageChan", FOR_GOOD),
        ("in_use", "TaskControl", FOR_GOOD),
    ],
)
def test_a_fault_while_the_device_opens_or_makes_a_task_leaves_nothing_behind(kind, operation, error):
    with daq_bench(faults=fault(kind, operation, at_call=1)) as bench:
        with pytest.raises(InstrumentError) as caught:
            take_one(bench.recorder(answer_s=ANSWER_S))
        assert type(caught.value) is error
        assert caught.value.remedy
        if kind != "server_dead":
            check_tone(take_one(bench.recorder()))


def test_given_an_overloaded_input_then_the_flag_of_that_channel_is_up():
    with daq_bench(faults=fault("over_range", "ReadAnalogF64", at_call=1)) as bench:
        recorder = bench.recorder()
        recording = take_one(recorder)
        assert recording.over_range == (False, True)
        assert abs(recording.volts[1]).max() <= RANGE_V[1] * (1 + 1e-6)
        check_tone(take_one(recorder))


def test_device_that_stays_away_then_reconnecting_says_so_each_time_until_it_is_back():
    with daq_bench() as bench:
        recorder = bench.recorder()
        take_one(recorder)
        bench.server.box.unplug()
        bench.server.box.plug()
        with pytest.raises(LOST):  # the task of before is not trusted
            recorder.start(ask())
        recorder.reconnect()
        assert bench.calls("ResetDevice") == 1
        check_tone(take_one(recorder))
        bench.server.box.unplug()
        with pytest.raises(LOST, match="unplugged"):
            recorder.start(ask())
        for _ in range(2):
            with pytest.raises(LOST, match="opening: it cannot be accessed: unplugged"):
                recorder.reconnect()
        with pytest.raises(LOST, match="it is not connected; reconnect first"):
            recorder.start(ask())
        recorder.abort()
        bench.server.box.plug()
        recorder.reconnect()
        check_tone(take_one(recorder))


def test_given_another_device_under_the_same_name_then_reconnecting_refuses_it():
    with daq_bench() as bench:
        recorder = bench.recorder()
        check_tone(take_one(recorder))
        bench.server.stop()
        other = NiServer(Tone(), address=bench.server.address, serial_number=0x0BADCAFE)
        other.start()
        try:
            with pytest.raises(InstrumentError, match="USB-6211, serial number 0BADCAFE answers instead"):
                recorder.reconnect()
            assert "ResetDevice" not in other.log
        finally:
            other.stop()
        bench.server.start()
        recorder.reconnect()
        check_tone(take_one(recorder))


def test_given_a_server_that_was_restarted_then_reconnecting_goes_on():
    with daq_bench() as bench:
        recorder = bench.recorder()
        check_tone(take_one(recorder))
        bench.server.stop()
        for refused in (lambda: recorder.start(ask()), recorder.reconnect, recorder.reconnect, bench.recorder):
            with pytest.raises(LOST, match=r"cannot be reached.*start ni_grpc_device_server") as caught:
                refused()
            assert caught.value.instrument == f"recorder Dev1 at {bench.server.address}"
            assert '"address": "[::]"' in caught.value.remedy
        bench.server.start()
        recorder.reconnect()
        check_tone(take_one(recorder))


def test_given_a_silent_server_then_clearing_up_waits_for_no_second_deadline():
    with daq_bench(faults=fault("silent", "StartTask", count=1000)) as bench:
        recorder = bench.recorder(answer_s=ANSWER_S)
        check_tone(take_one(recorder))
        with pytest.raises(LOST, match="does not answer"):
            take_one(recorder)
        silent = len(bench.server.log) + len(bench.server.under_way)
        recorder.abort()
        recorder.close()
        assert len(bench.server.log) + len(bench.server.under_way) == silent


@pytest.mark.parametrize("wiring", [{}, {"resets": False, "task_name": "wavefocus_here"}], ids=["reset", "by name"])
def test_given_what_a_dead_session_left_reserved_then_reconnecting_takes_it_back(wiring):
    # The server stays silent while the first recorder clears up, so that its task stays there, committed.
    silence = fault("silent", "StopTask", at_call=2)
    with daq_bench(faults=silence) as bench:
        recorder = bench.recorder(answer_s=ANSWER_S, **wiring)
        check_tone(take_one(recorder))
        with pytest.raises(LOST, match="does not answer"):
            take_one(recorder)
        with pytest.raises(InstrumentError, match="another program has reserved it"):
            bench.recorder().start(ask())
        recorder.reconnect()
        check_tone(take_one(recorder))
        assert bench.calls("ResetDevice") == (not wiring)


def test_what_a_killed_process_left_reserved_goes_to_the_next_recorder():
    with daq_bench() as bench:
        left = bench.recorder(task_name="wavefocus_here")  # never closed, as by a process that was killed
        check_tone(take_one(left))
        left.start(ask())
        with pytest.raises(InstrumentError, match="another program has reserved it"):
            bench.recorder(task_name="wavefocus_elsewhere").start(ask())
        after = bench.recorder(task_name="wavefocus_here")
        for _ in range(2):
            check_tone(take_one(after))
        assert np.isfinite(after.read_input_v("ai2"))
        check_tone(take_one(after))
        assert bench.calls("ResetDevice") == 0


def test_given_a_failure_when_clearing_up_then_the_first_error_carries_it_as_a_note():
    faults = (*fault("overwritten", "ReadAnalogF64", at_call=1), *fault("usb_aborted", "ClearTask", at_call=1))
    with daq_bench(faults=faults) as bench:
        recorder = bench.recorder()
        with pytest.raises(PASSING, match="overwritten") as caught:
            take_one(recorder)
        assert any("could not be cleared" in note and "-50405" in note for note in caught.value.__notes__)


@pytest.mark.parametrize(("operation", "kind"), [("StopTask", "silent"), ("ClearTask", "server_dead")])
def test_given_a_fault_on_the_way_out_then_closing_is_harmless(operation, kind):
    with daq_bench(faults=fault(kind, operation, at_call=1)) as bench:
        recorder = bench.recorder(answer_s=ANSWER_S)
        recorder.start(ask())
        recorder.abort()
        recorder.close()
        recorder.close()


def test_records_back_to_back_then_a_late_answer_within_its_deadline_is_no_fault():
    with daq_bench(faults=fault("silent", "ReadAnalogF64", seconds=0.2)) as bench:
        recorder = bench.recorder(answer_s=30.0)
        for _ in range(3):
            check_tone(take_one(recorder))


@pytest.mark.parametrize("kind", ["exhausted", "internal"])
def test_server_that_refuses_a_call_for_now_then_attempt_fails_and_next_one_works(kind):
    with daq_bench(faults=fault(kind, "StartTask", at_call=1)) as bench:
        recorder = bench.recorder()
        with pytest.raises(TransientInstrumentError, match="could not serve the call this time"):
            recorder.start(ask())
        # What may have been carried out is not ordered twice.
        assert bench.calls("StartTask") == 1
        check_tone(take_one(recorder))


TLS = Path(__file__).with_name("tls")
ROOT = (TLS / "root.pem", None, None)
BOTH = (TLS / "root.pem", TLS / "client.pem", TLS / "client.key")


def server_credentials(*, mutual):
    pair = ((TLS / "server.key").read_bytes(), (TLS / "server.pem").read_bytes())
    return grpc.ssl_server_credentials([pair], (TLS / "root.pem").read_bytes() if mutual else None, mutual)


@pytest.mark.parametrize(("mutual", "files"), [(False, ROOT), (True, BOTH)])
def test_given_a_server_with_a_certificate_then_records_come_over_tls(mutual, files):
    with daq_bench(credentials=server_credentials(mutual=mutual)) as bench:
        recorder = bench.recorder(tls=files)
        check_tone(take_one(recorder))
        recorder.reconnect()
        check_tone(take_one(recorder))


@pytest.mark.parametrize(("mutual", "files"), [(False, None), (True, ROOT)], ids=str)
def test_given_the_wrong_certificates_or_none_then_the_server_cannot_be_reached(mutual, files):
    with (
        daq_bench(credentials=server_credentials(mutual=mutual)) as bench,
        pytest.raises(InstrumentLostError, match=r"cannot be reached.*tls_root of \[recorder\]"),
    ):
        bench.recorder(tls=files, answer_s=5.0)


def test_given_a_certificate_file_that_is_not_there_then_its_key_is_named(tmp_path):
    with daq_bench() as bench, pytest.raises(InstrumentError, match=r"cannot be read.*correct tls_root"):
        bench.recorder(tls=(tmp_path / "gone.pem", None, None))
