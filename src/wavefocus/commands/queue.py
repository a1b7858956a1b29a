"""``wavefocus queue``: runs that are carried out one after the other."""

from __future__ import annotations

import json
from collections.abc import Sequence
from datetime import UTC, datetime
from pathlib import Path

from wavefocus.acquisition.run_queue import (
    EntryState,
    QueueEnded,
    QueueEntry,
    QueueRunEnded,
    QueueRunStarted,
    changed_files,
    finish_times,
    move_entry,
    queue_holder,
    read_queue,
    remove_entries,
)
from wavefocus.acquisition.wording import hours
from wavefocus.campaign.control import command_line, expected_finish
from wavefocus.commands.queue_runner import run_queue
from wavefocus.commands.queued_commands import add_command
from wavefocus.config.messages.codec import Message, to_line, to_record
from wavefocus.console import answer, print_line, say
from wavefocus.exits import Exit


def add(queue: Path, words: Sequence[str], *, as_json: bool) -> None:
    """Add a run to a queue."""
    as_json = as_json or "--json" in words
    entry = add_command(queue, words, Path.cwd())
    say(f"{queue}: run {entry.number} added: {command_line(*entry.words)}")
    if as_json:
        print_line(json.dumps({"queue": str(queue), **to_record(entry)}) + "\n")


def list_runs(queue: Path, *, as_json: bool) -> None:
    """Show the runs of a queue."""
    entries = read_queue(queue)
    finish = finish_times(entries, datetime.now(UTC), expected_finish)
    changed = {entry.number: changed_files(entry) for entry in entries if entry.to_do}
    holder = queue_holder(queue)
    if as_json:
        runs = [
            {
                **to_record(entry),
                "changed": list(changed.get(entry.number, ())),
                "finish_at": _instant(finish[entry.number]),
            }
            for entry in entries
        ]
        owner = None if holder is None else {"host": holder.host, "pid": holder.pid}
        print_line(json.dumps({"queue": str(queue), "runs": runs, "owner": owner}) + "\n")
        return
    for entry in entries:
        cut_off = entry.state is EntryState.RUNNING and holder is None
        answer(_line(entry, "cut off" if cut_off else str(entry.state), finish[entry.number]))
        if names := changed.get(entry.number):
            answer(f"{'':14}changed since it was added: {', '.join(names)}")
        if entry.state in (EntryState.FAILED, EntryState.STOPPED):
            answer(f"{'':14}exit code {entry.code}: {entry.said}")
    if not entries:
        answer("no runs")
    if holder is not None:
        answer(f"carried out by process {holder.pid} on {holder.host}")


def _line(entry: QueueEntry, state: str, finish: datetime | None) -> str:
    when = "" if finish is None else f", {'until' if entry.to_do else 'ended'} {finish:%a %d %b %H:%M}"
    expected = f", takes {hours(entry.expected_s)}" if entry.to_do and entry.expected_s is not None else ""
    return f"{entry.number:>4} {state:<8} {command_line(*entry.words)}{expected}{when}"


def _instant(at: datetime | None) -> str | None:
    return None if at is None else at.isoformat(timespec="seconds")


def move(queue: Path, number: int, place: int, *, as_json: bool) -> None:
    """Move a run to another place."""
    move_entry(queue, number, place)
    _answer_order(queue, as_json=as_json)


def remove(queue: Path, numbers: Sequence[int], *, as_json: bool) -> None:
    """Remove runs."""
    remove_entries(queue, numbers)
    _answer_order(queue, as_json=as_json)


def _answer_order(queue: Path, *, as_json: bool) -> None:
    waiting = [entry.number for entry in read_queue(queue) if entry.state is EntryState.WAITING]
    say(f"{queue}: runs that wait, in order: {', '.join(map(str, waiting)) or 'none'}")
    if as_json:
        print_line(json.dumps({"queue": str(queue), "waiting": waiting}) + "\n")


def run(queue: Path, *, as_json: bool) -> Exit:
    """Carry out the runs that wait."""

    def publish(message: Message) -> None:
        if as_json:
            print_line(to_line(message))
        else:
            say(_sentence(message))

    return run_queue(queue, publish)


def _sentence(message: Message) -> str:
    match message:
        case QueueRunStarted(number=number, words=words):
            return f"run {number}: {command_line(*words)}"
        case QueueRunEnded(number=number, state=state, code=code):
            return f"run {number}: {state}, exit code {code}"
        case QueueEnded(done=done, failed=failed, stopped=stopped, waiting=waiting):
            return f"queue: {done} done, {failed} failed, {stopped} stopped, {waiting} waiting"
    return to_line(message)
