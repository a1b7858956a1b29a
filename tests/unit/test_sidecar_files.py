"""Files beside a bank: never written through links or over files of somebody else; pipes are passed over or refused."""

import json
import os

import pytest

from tests.lab_files import write_foreign
from wavefocus.__main__ import run
from wavefocus.campaign.control import heartbeat_path, orders_path, read_heartbeat, take_order
from wavefocus.campaign.sidecar_files import (
    EventLog,
    VerifyLog,
    drift_path,
    last_events,
    log_path,
    read_drift,
    unvouched_rows,
    write_whole,
)
from wavefocus.config.messages.campaign import Drift, Fault, PositionStarted, SessionEnded, SessionStarted, State
from wavefocus.input_files import input_files
from wavefocus.rendering.verify.record import read_record
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.owner import owner_path, remove_owner, write_owner

pytestmark = [
    pytest.mark.may_skip("symbolic links and named pipes are POSIX"),
    pytest.mark.skipif(os.name == "nt", reason="symbolic links and named pipes are POSIX"),
]
PRECIOUS = b"precious\n"


@pytest.fixture
def victim(tmp_path):
    (tmp_path / "victim").write_bytes(PRECIOUS)
    return tmp_path / "victim"


def test_given_a_link_or_a_file_of_another_then_no_log_is_written_there(victim):
    bank, of_verify = victim.with_name("plate.h5"), victim.with_name("verify.events.jsonl")
    names = [log_path(bank), drift_path(bank)]
    for make in (lambda name: name.symlink_to(victim), lambda name: name.write_bytes(PRECIOUS), os.mkfifo):
        for name in names:
            name.unlink(missing_ok=True)
            make(name)
            with EventLog(name, Drift) as written:
                written(Drift(0, 0.0, 0.1, 0.0, 1.0, "steady", "run", "", ()))
        assert all(name.read_bytes() == PRECIOUS for name in [victim, *names] if name.is_file())
    of_verify.symlink_to(victim)
    with VerifyLog(of_verify) as log:
        log.done(0, "done")
    assert victim.read_bytes() == PRECIOUS


def test_given_a_link_or_a_file_of_another_the_owner_is_named_beside_the_bank_alone(victim):
    bank = victim.with_name("plate.h5")
    owner_path(bank).symlink_to(victim)
    write_owner(bank)
    assert json.loads(owner_path(bank).read_text())["pid"] == os.getpid()
    assert victim.read_bytes() == PRECIOUS
    remove_owner(bank)
    assert not os.path.lexists(owner_path(bank))
    owner_path(bank).write_bytes(PRECIOUS)
    write_owner(bank)
    remove_owner(bank)
    assert owner_path(bank).read_bytes() == PRECIOUS


@pytest.mark.parametrize("by_many", [True, False])
def test_given_links_and_files_of_another_then_small_files_are_written_beside_them(victim, by_many):
    path = victim.with_name("plate.h5.heartbeat")
    of_killed_writer = path.with_name(f".{path.name}.0123456789abcdef.new")
    of_killed_writer.write_bytes(b"{")
    for name in (path.with_name(f"{path.name}.new"), path.with_name(f"{path.name}.{os.getpid()}.new"), path):
        name.symlink_to(victim)
    write_whole(path, {"a": 1}, by_many=by_many)
    assert json.loads(path.read_text()) == {"a": 1}
    assert of_killed_writer.exists() is by_many  # one of many may be alive
    assert path.with_name(f"{path.name}.new").is_symlink()
    assert victim.read_bytes() == PRECIOUS
    path.write_bytes(PRECIOUS)
    with pytest.raises(FileExistsError):
        write_whole(path, {"a": 2}, by_many=by_many)
    assert path.read_bytes() == PRECIOUS


def test_sector_of_garbage_after_power_cut_then_owner_s_name_is_written_and_removed(tmp_path):
    bank = tmp_path / "plate.h5"
    owner_path(bank).write_bytes(b"\xff\xa5" * 256)
    write_owner(bank)
    assert json.loads(owner_path(bank).read_text())["pid"] == os.getpid()
    owner_path(bank).write_bytes(b"\xff\xa5" * 200)
    remove_owner(bank)
    assert not owner_path(bank).exists()
    owner_path(bank).write_bytes(b"\xff\xa5" * 257)  # more than a power cut leaves
    remove_owner(bank)
    assert owner_path(bank).exists()


def test_log_of_another_bank_of_this_name_then_none_of_its_rows_is_unvouched(tmp_path):
    bank = tmp_path / "plate.h5"
    with EventLog(log_path(bank)) as log:
        for positions, done, row in ((20, 0, 19), (20, 20, 3), (8, 6, 7)):
            log(SessionStarted(0.0, bank.name, positions, 3, done, positions - done, 1.0, ()))
            log(PositionStarted(0.0, row, 1, 0.0, 0.0))
            if row == 3:
                log(Drift(0.0, 0, 0.1, 0.0, 1.0, "stop", "repeat", "", (5,)))
        assert unvouched_rows(bank, 8) == (7,)
        for fault in (False, True):  # the repeat was not asked for, or could not be measured
            log(SessionStarted(0.0, bank.name, 8, 3, 6, 2, 1.0, ()))
            log(PositionStarted(0.0, 4, 1, 0.0, 0.0))
            log(Drift(0.0, 0, 0.9, 0.0, 1.0, "stop", "run", "", ()))
            if fault:
                log(Fault(0.0, "recorder", "reading", "an overrun", "", 0, 2, retried=False))
            log(SessionEnded(0.0, State.FINISHED, 8, 8, {}))
            assert unvouched_rows(bank, 8) == ((4,) if fault else ())


@pytest.mark.parametrize("torn", [b'{"at": "2026-11-30T08:5', b"\0" * 700])
def test_log_torn_by_power_cut_then_next_event_of_each_writer_has_its_own_line(tmp_path, torn):
    log, events = log_path(bank := tmp_path / "plate.h5"), [PositionStarted(0.0, row, 1, 0.0, 0.0) for row in range(3)]
    with EventLog(log) as first:
        first(events[0])
    log.write_bytes(log.read_bytes() + torn)
    with EventLog(log) as one, EventLog(log) as other:
        assert log.read_bytes().endswith(torn)  # until one of them writes
        one(events[1])
        other(events[2])
    assert [logged.event for logged in last_events(bank)] == events[::-1]


@pytest.mark.parametrize("pairs", [1, 256])
def test_log_that_is_sector_of_garbage_after_power_cut_then_each_session_is_logged(tmp_path, pairs):
    log_path(bank := tmp_path / "plate.h5").write_bytes(b"\xff\xa5" * pairs)
    for row in range(12):
        with EventLog(log_path(bank)) as log:
            log(PositionStarted(0.0, row, 1, 0.0, 0.0))
    assert [logged.event.position for logged in last_events(bank)] == list(range(11, -1, -1))


@pytest.mark.parametrize(
    ("name", "read", "nothing"),
    [
        (heartbeat_path, read_heartbeat, None),
        (orders_path, take_order, None),
        (drift_path, read_drift, []),
        (log_path, lambda bank: list(last_events(bank)), []),
    ],
)
def test_given_a_pipe_in_place_of_a_file_beside_a_bank_then_it_holds_nothing(tmp_path, name, read, nothing):
    bank = tmp_path / "plate.h5"
    os.mkfifo(name(bank))
    assert read(bank) == nothing


def test_given_pipes_as_inputs_then_they_are_refused_and_none_is_waited_for(tmp_path):
    pipe = tmp_path / "pipe.toml"
    os.mkfifo(pipe)
    assert input_files(pipe) == [pipe]
    with pytest.raises(InputError):
        read_record(pipe)
    for command in (
        ["plan", str(pipe)], ["doctor", str(pipe)], ["render", str(pipe), "--bank", str(pipe), "--out", "x.h5"],
        ["status", str(pipe)], ["check", str(pipe)], ["import", str(pipe), "--bank", str(tmp_path / "new.h5")],
        ["trials", str(pipe), "--bank", str(pipe), "--rig", str(pipe), "--participant", "p", "--out", str(tmp_path)],
    ):  # fmt: skip
        assert run(command) == 2
    bank = write_foreign(tmp_path / "plate.h5")
    for path in (owner_path(bank), heartbeat_path(bank)):
        os.mkfifo(path)
    assert run(["status", str(bank)]) == 0


def test_given_a_deeply_nested_line_of_drift_then_the_others_are_read(tmp_path):
    bank = tmp_path / "plate.h5"
    drift_path(bank).write_text("[" * 100_000 + "\n" + '{"a":' * 100_000 + "\n")
    assert read_drift(bank) == []
