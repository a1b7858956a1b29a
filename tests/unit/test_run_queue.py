"""The queue file: order, edits, finish times, changed files, wrong content."""

from __future__ import annotations

import json
import subprocess
import sys
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from wavefocus.acquisition.run_queue import (
    EntryState,
    QueueEntry,
    add_entry,
    changed_files,
    edited_queue,
    file_digests,
    finish_times,
    move_entry,
    read_queue,
    remove_entries,
)
from wavefocus.commands.queue_runner import was_killed
from wavefocus.storage.claims import claim_holder, claimed
from wavefocus.storage.errors import BankBusyError, InputError

NOON = datetime(2026, 3, 1, 12, tzinfo=UTC)


def entry(number: int, expected_s: float | None = 60.0, state: EntryState = EntryState.WAITING) -> QueueEntry:
    started = NOON - timedelta(seconds=30) if state is EntryState.RUNNING else None
    ended = NOON - timedelta(hours=1) if state in (EntryState.DONE, EntryState.FAILED) else None
    return QueueEntry(number, ("check", "a.h5"), "/", {}, NOON, "a.h5", expected_s, state, None, "", started, ended)


def unknown(bank: Path) -> datetime | None:
    return None


def add(queue: Path, count: int) -> None:
    for _ in range(count):
        add_entry(queue, ["check", "a.h5"], queue.parent)


def numbers(queue: Path) -> list[int]:
    return [entry.number for entry in read_queue(queue)]


@settings(max_examples=25, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(moves=st.lists(st.tuples(st.integers(1, 5), st.integers(1, 5)), max_size=4))
def test_moves_then_order_the_runs_as_a_list_would_be(tmp_path: Path, moves: list[tuple[int, int]]) -> None:
    queue = tmp_path / "night.json"
    queue.unlink(missing_ok=True)
    add(queue, 5)
    expected = [1, 2, 3, 4, 5]
    for number, place in moves:
        move_entry(queue, number, place)
        expected.remove(number)
        expected.insert(place - 1, number)
    assert numbers(queue) == expected


def test_given_runs_that_have_ended_then_places_count_those_that_wait_and_a_moved_one_waits_again(
    tmp_path: Path,
) -> None:
    queue = tmp_path / "night.json"
    add(queue, 4)
    with edited_queue(queue) as entries:
        entries[0] = replace(entries[0], state=EntryState.FAILED, code=3, said="gone", ended_at=NOON)
        entries[1] = replace(entries[1], state=EntryState.DONE, code=0, ended_at=NOON)
    move_entry(queue, 4, 1)
    assert numbers(queue) == [1, 2, 4, 3]
    move_entry(queue, 1, 2)
    assert numbers(queue) == [2, 4, 1, 3]
    again = read_queue(queue)[2]
    assert (again.state, again.code, again.said, again.ended_at) == (EntryState.WAITING, None, "", None)
    remove_entries(queue, [2, 3])
    assert numbers(queue) == [4, 1]
    with pytest.raises(InputError):
        remove_entries(queue, [4, 7])
    assert numbers(queue) == [4, 1]
    add(queue, 1)
    assert numbers(queue) == [4, 1, 5]


def test_finish_times_then_add_up_from_the_run_that_is_under_way() -> None:
    entries = [
        entry(1, state=EntryState.DONE),
        entry(2, state=EntryState.RUNNING),
        entry(3),
        entry(4, 7200.0),
        entry(5, None),
        entry(6),
    ]
    found = finish_times(entries, NOON, unknown)
    assert found[1] == NOON - timedelta(hours=1)
    assert found[2] == NOON + timedelta(seconds=30)
    assert found[3] == NOON + timedelta(seconds=90)
    assert found[4] == NOON + timedelta(seconds=90, hours=2)
    assert found[5] is None
    assert found[6] is None
    # Its heartbeat knows better; a run that takes longer than expected ends now at the earliest.
    assert finish_times(entries, NOON, lambda bank: NOON + timedelta(minutes=5))[3] == NOON + timedelta(minutes=6)
    late = finish_times(entries, NOON + timedelta(minutes=10), unknown)
    assert late[3] == NOON + timedelta(minutes=11)


def test_given_a_file_that_changes_or_goes_then_the_entry_names_it(tmp_path: Path) -> None:
    run_file, scene = tmp_path / "run.toml", tmp_path / "scene.toml"
    run_file.write_text("a = 1\n")
    scene.write_text("b = 1\n")
    added = replace(entry(1), files=file_digests([run_file, scene]))
    assert changed_files(added) == ()
    run_file.write_text("a = 2\n")
    assert changed_files(added) == (str(run_file),)
    scene.unlink()
    assert changed_files(added) == (str(run_file), str(scene))


@pytest.mark.parametrize(
    "change",
    [
        {"format": "wavefocus-bank"},
        {"format_version": 2},
        {"runs": {}},
        {"runs": [1]},
        {"runs": [{"number": 1}]},
        {"number": 2.5},
        {"words": "check"},
        {"state": "asleep"},
        {"added_at": "2026-03-01T12:00:00"},
        {"files": ["a"]},
    ],
)
def test_given_wrong_content_then_it_is_refused_by_key_and_stays(tmp_path: Path, change: dict[str, object]) -> None:
    queue = tmp_path / "night.json"
    add(queue, 2)
    content = json.loads(queue.read_text())
    key = next(iter(change))
    (content if key in content else content["runs"][1]).update(change)
    queue.write_text(json.dumps(content))
    before = queue.read_bytes()
    with pytest.raises(InputError, match=key):
        read_queue(queue)
    with pytest.raises(InputError):
        add(queue, 1)
    assert queue.read_bytes() == before


def test_given_a_name_that_another_process_holds_then_it_is_busy_until_that_process_is_gone(tmp_path: Path) -> None:
    name = f"rig {tmp_path}"
    hold = "import sys; from wavefocus.storage.claims import claimed\n"
    hold += f"with claimed({name!r}): print('held', flush=True); sys.stdin.read()"
    with subprocess.Popen([sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        assert holder.stdout.readline().strip() == b"held"
        with pytest.raises(BankBusyError, match=str(holder.pid)), claimed(name):
            pass
        owner = claim_holder(name)
        assert owner is not None
        assert owner.pid == holder.pid
        holder.kill()
    assert claim_holder(name) is None
    with claimed(name):
        pass


@pytest.mark.parametrize(
    ("code", "killed"),
    [
        (-9, True),
        (-11, True),
        (0xC0000005, True),
        (0xC000013A, False),
        (0, False),
        (1, False),
        (75, False),
        (130, False),
    ],
)
def test_given_an_exit_code_then_a_signal_or_an_error_of_windows_is_a_kill(code: int, killed: bool) -> None:
    assert was_killed(code) is killed
