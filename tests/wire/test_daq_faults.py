"""Every row of the fault table: what arrives over the wire becomes a sentence, and the next record is good."""

import re
import time
from pathlib import Path

import grpc
import numpy as np
import pytest
from nidaqmx.error_codes import DAQmxErrors
from nidaqmx.errors import DaqError, DaqWarning, RpcError

from tests.lab_files import wire_fault
from tests.wire.daq_bench import RANGE_V, TAKE, Tone, ask, check_tone, daq_bench, take_one
from wavefocus.drivers.daq.ni import MEANINGS, explain
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError, UnknownFaultError
from wavefocus.mocks.wire.ni_server import NiServer

# Only where an answer does not come: as long as a busy machine may take for one that does.
ANSWER_S = 2.0
PASSING, LOST, FOR_GOOD = TransientInstrumentError, InstrumentLostError, InstrumentError
UNKNOWN = UnknownFaultError


def fault(kind, operation, at_call=2, **more):
    return (wire_fault("recorder", kind, operation, at_call=at_call, **more),)


def until_reconnected(recorder):
    """Try until the device is back, as the engine does; bounded by the test's timeout."""
    while True:
        try:
            return recorder.reconnect()
        except InstrumentLostError:
            time.sleep(0.1)


REFUSED = "could not serve the call this time"


@pytest.mark.parametrize(
    ("kind", "operation", "at_call", "error", "cause"),
    [
        ("overwritten", "ReadAnalogF64", 2, PASSING, "overwritten before they could be read .NI-DAQmx -200279"),
        ("read_timeout", "ReadAnalogF64", 2, PASSING, "samples are missing.*-200284.; 250 came"),
        ("short_read", "ReadAnalogF64", 2, PASSING, "only 250 of 500 came"),
        ("warning", "ReadAnalogF64", 2, PASSING, "NI-DAQmx warns.*ADC_OVERLOADED"),
        ("wait_timeout", "WaitUntilTaskDone", 2, PASSING, "not finished after 1 s"),
        ("unplugged", "StartTask", 2, LOST, "cannot be accessed: unplugged.*-201003"),
        ("unplugged", "ReadAnalogF64", 2, LOST, "cannot be accessed: unplugged.*-201003"),
        ("in_use", "StartTask", 2, LOST, "reserved, .*-50103"),
        ("unknown_code", "ReadAnalogF64", 2, UNKNOWN, "NI-DAQmx says: .*-229771"),
        ("server_dead", "WaitUntilTaskDone", 2, LOST, "cannot be reached, or went away"),
        ("exhausted", "StartTask", 2, PASSING, REFUSED),
        # While the device opens or makes a task.
        ("wrong_name", "GetDeviceAttributeString", 1, FOR_GOOD, "no device of this name"),
        ("silent", "GetSystemInfoAttributeUInt32", 1, LOST, "does not answer"),
        ("server_dead", "GetSystemInfoAttributeUInt32", 1, LOST, "cannot be reached"),
        ("usb_aborted", "CreateTask", 1, LOST, "USB transfer was aborted"),
        ("warning", "CreateAIVoltageChan", 1, FOR_GOOD, "NI-DAQmx warns"),
        ("in_use", "TaskControl", 1, FOR_GOOD, "another program has reserved it"),
    ],
    ids=lambda value: value if isinstance(value, str) and " " not in value else "",
)
def test_a_fault_in_the_first_or_second_record_is_told_and_the_next_is_good(kind, operation, at_call, error, cause):
    seconds = 0.2 if at_call == 2 and kind in ("unplugged", "server_dead") else 0.0
    with daq_bench(faults=fault(kind, operation, at_call, seconds=seconds)) as bench:
        recorder = None
        if at_call == 2:
            recorder = bench.recorder()
            check_tone(take_one(recorder))
        with pytest.raises(InstrumentError, match=cause) as caught:
            take_one(recorder or bench.recorder(answer_s=ANSWER_S), timeout_s=1.0)
        assert isinstance(caught.value, error)
        assert error is not FOR_GOOD or type(caught.value) is FOR_GOOD
        assert caught.value.instrument == f"recorder Dev1 at {bench.server.address}"
        assert caught.value.remedy
        if recorder is not None:
            assert str(TAKE) in caught.value.operation
            if cause == REFUSED:  # what may have been carried out is not ordered twice
                assert bench.calls("StartTask") == 2
            recorder.abort()
            if issubclass(error, LOST):
                until_reconnected(recorder)
            check_tone(take_one(recorder))
            recorder.close()
        # Nothing is left of what failed: the next program can have the device.
        if seconds or kind != "server_dead":
            check_tone(take_one(bench.recorder()))


@pytest.mark.parametrize(
    ("code", "known", "owned", "error", "cause"),
    [
        (-88705, False, False, LOST, "not present .NI-DAQmx -88705"),
        (-50400, True, False, LOST, "USB transfer was aborted .NI-DAQmx -50400"),
        (-201190, False, False, LOST, "cannot be accessed: unplugged"),
        (-201252, False, False, LOST, "network connection to it is lost"),
        (-200361, False, False, PASSING, "overwritten before they could be read .NI-DAQmx -200361"),
        (-200220, True, False, LOST, "not there any more .NI-DAQmx -200220"),
        (-200220, False, False, FOR_GOOD, "no device of this name"),
        (-200022, True, False, FOR_GOOD, "another program has reserved it"),
        (-229771, True, False, FOR_GOOD, "NI-DAQmx says"),
        (-229771, False, False, FOR_GOOD, "NI-DAQmx says"),
    ],
)
def test_given_a_code_of_the_driver_then_it_has_its_meaning(code, known, owned, error, cause):
    explained = explain(DaqError("", code), "recorder Dev1", "opening", known=known, owned=owned)
    assert type(explained) is error
    assert re.search(cause, explained.cause)
    assert explained.remedy


def test_any_code_and_no_code_at_all_are_tried_again_on_a_device_that_has_recorded():
    assert {name for words in MEANINGS.values() for name in words.split()} <= set(DAQmxErrors.__members__)
    found = [explain(DaqError("", code.value), "recorder Dev1", "recording", known=True, owned=True)
             for code in DAQmxErrors]  # fmt: skip
    assert {type(one) for one in found} == {PASSING, LOST, UNKNOWN}
    internal = explain(RpcError(grpc.StatusCode.INTERNAL, ""), "recorder Dev1", "recording", known=True, owned=True)
    assert type(internal) is PASSING
    rpc = RpcError(grpc.StatusCode.DATA_LOSS, "data loss")
    gone = explain(RpcError(grpc.StatusCode.UNAVAILABLE, ""), "mirror Dev1", "opening", role="mirror")
    assert "the recorder needs tls_root, and no mirror or shutter can be on it" in gone.remedy
    for failure in (rpc, ValueError("Cannot invoke RPC on closed channel!"), DaqWarning("", 200015)):
        for known in (True, False):
            explained = explain(failure, "recorder Dev1", "recording", known=known, owned=known)
            assert type(explained) is (UNKNOWN if known else FOR_GOOD)


@pytest.mark.parametrize(("kind", "more"), [("over_range", {"at_call": 1}), ("silent", {"seconds": 0.2})])
def test_an_overload_or_a_late_answer_within_its_deadline_is_no_fault(kind, more):
    with daq_bench(faults=fault(kind, "ReadAnalogF64", **more)) as bench:
        recorder = bench.recorder()
        first = take_one(recorder)
        assert first.over_range == (False, kind == "over_range")
        assert abs(first.volts[1]).max() <= RANGE_V[1] * (1 + 1e-6)
        for _ in range(2):
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


def test_a_stopped_server_is_named_and_reconnecting_takes_the_same_device_alone():
    with daq_bench() as bench:
        recorder = bench.recorder()
        check_tone(take_one(recorder))
        bench.server.stop()
        for refused in (lambda: recorder.start(ask()), recorder.reconnect, recorder.reconnect, bench.recorder):
            with pytest.raises(LOST, match=r"cannot be reached.*start ni_grpc_device_server") as caught:
                refused()
            assert caught.value.instrument == f"recorder Dev1 at {bench.server.address}"
            assert '"address": "[::]"' in caught.value.remedy
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


@pytest.mark.parametrize("wiring", [{}, {"resets": False, "task_name": "wavefocus_here"}], ids=["reset", "by name"])
def test_a_silent_server_costs_one_deadline_and_what_it_keeps_reserved_is_taken_back(wiring):
    # Silent while the recorder clears up, so that its task stays there, committed.
    with daq_bench(faults=fault("silent", "StopTask")) as bench:
        recorder = bench.recorder(answer_s=ANSWER_S, **wiring)
        check_tone(take_one(recorder))
        cleared = bench.calls("ClearTask")
        if wiring:
            recorder.start(ask())
            recorder.abort()
        else:
            with pytest.raises(LOST, match=r"does not answer .StopTask got no answer within 2 s"):
                take_one(recorder)
        assert bench.calls("ClearTask") == cleared
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
        with pytest.raises(InstrumentError, match=r"another program has reserved it.*close that program") as caught:
            bench.recorder(task_name="wavefocus_elsewhere").start(ask())
        assert type(caught.value) is InstrumentError
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


def test_given_a_server_that_dies_on_the_way_out_then_closing_is_harmless():
    with daq_bench(faults=fault("server_dead", "ClearTask", at_call=1)) as bench:
        recorder = bench.recorder()
        recorder.start(ask())
        for way_out in (recorder.abort, recorder.close, recorder.close):
            way_out()


TLS = Path(__file__).with_name("tls")
ROOT = (TLS / "root.pem", None, None)
BOTH = (TLS / "root.pem", TLS / "client.pem", TLS / "client.key")


def server_credentials(*, mutual):
    pair = ((TLS / "server.key").read_bytes(), (TLS / "server.pem").read_bytes())
    return grpc.ssl_server_credentials([pair], (TLS / "root.pem").read_bytes() if mutual else None, mutual)


def test_records_come_over_tls_with_the_right_certificates_else_the_key_is_named(tmp_path):
    for mutual, right, wrong in ((False, ROOT, None), (True, BOTH, ROOT)):
        with daq_bench(credentials=server_credentials(mutual=mutual)) as bench:
            recorder = bench.recorder(tls=right)
            check_tone(take_one(recorder))
            recorder.reconnect()
            check_tone(take_one(recorder))
            with pytest.raises(InstrumentLostError, match=r"cannot be reached.*needs tls_root"):
                bench.recorder(tls=wrong, answer_s=5.0)
            with pytest.raises(InstrumentError, match=r"cannot be read.*correct tls_root"):
                bench.recorder(tls=(tmp_path / "gone.pem", None, None))
