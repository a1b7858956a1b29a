"""``wavefocus doctor --record``: every exchange with the instruments is in the file."""

import json
from contextlib import suppress
from pathlib import Path

import pytest

from tests.lab_files import wire_fault
from tests.wire.daq_bench import daq_bench, take_one
from tests.wire.serial_bench import LOCAL, mirror_bench
from wavefocus.__main__ import run
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.exchange_record import ExchangeRecord, noting_calls, recording


def exchanges(record):
    """What a record holds, its head first."""
    return [json.loads(line) for line in record.read_text(encoding="utf-8").splitlines()]


def test_given_garbled_and_lost_answers_then_the_record_has_each_byte_as_it_came(tmp_path):
    faults = [wire_fault("mirror", kind, "move", at_call=at) for kind, at in (("garbled", 1), ("truncated", 3))]
    with mirror_bench("asi-tiger", LOCAL, tmp_path, *faults) as bench, recording(tmp_path / "r.jsonl", {}):
        mirror = bench.mirror(answer_s=0.1)
        for x_mrad in (10.0, 20.0):
            try:
                mirror.move_to(x_mrad, 0.0)
            except InstrumentError:
                continue
        mirror.close()
    lines = exchanges(tmp_path / "r.jsonl")
    received = "".join(line.get("received", "") for line in lines)
    assert "\xba" in received  # ":" with its top bit set
    assert [line["at_s"] for line in lines[1:]] == sorted(line["at_s"] for line in lines[1:])
    assert any("closed" in line for line in lines)


# What every instrument of a rig was asked is in the test of the doctor in test_rigs_through_wires.py.
def test_given_no_folder_for_the_record_then_exit_2_before_any_instrument_is_opened(tmp_path):
    assert run(["init", str(tmp_path / "lab")]) == 0
    assert run(["doctor", str(tmp_path / "lab" / "rig.toml"), "--record", str(tmp_path / "none" / "r.jsonl")]) == 2


def test_given_a_recorder_that_fails_then_the_record_has_nis_own_error(tmp_path):
    with daq_bench(faults=(wire_fault("recorder", "overwritten", "ReadAnalogF64", at_call=1),)) as bench:
        with recording(tmp_path / "r.jsonl", {}):
            recorder = noting_calls(bench.recorder(), "recorder")
            with pytest.raises(InstrumentError):
                take_one(recorder)
        recorder.abort()  # noted no more
    _, *lines = exchanges(tmp_path / "r.jsonl")
    assert [line.get("called") for line in lines] == ["start", None, "read", None]
    assert "-222" in lines[-1]["because"] or "-200" in lines[-1]["because"]


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="Linux")
def test_given_a_full_disk_then_no_instrument_fails_and_the_record_says_so():
    with Path("/dev/full").open("w", encoding="utf-8") as full:
        record = ExchangeRecord(full, {})
        record.note("mirror", sent="/")
        assert "No space left" in record.failure
        with suppress(OSError):
            full.close()
