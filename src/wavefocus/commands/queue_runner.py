"""Carries out a queue: each run is the ordinary command in a process of its own, one after the other."""

from __future__ import annotations

import math
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import IO

from msgspec.structs import replace

from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.acquisition.run_queue import (
    EntryState,
    QueueEnded,
    QueueEntry,
    QueueRunEnded,
    QueueRunStarted,
    changed_files,
    edited_queue,
    queue_claim,
    read_queue,
)
from wavefocus.commands.queued_commands import instrument_names
from wavefocus.config.messages.codec import Message
from wavefocus.console import say
from wavefocus.ending import stop_on_signals
from wavefocus.exits import WATCHED_VARIABLE, Exit, sentence
from wavefocus.rig.awake import kept_awake
from wavefocus.storage.claims import claimed
from wavefocus.storage.errors import BankBusyError, InputError

MAX_KILLS = 100
"""A run that something outside killed is begun again so many times in a row; it goes on where it was."""
KILLED_PAUSE_S = 1.0
RETURN_WAIT_S = 600.0
"""Longest wait for instruments that are away after a kill or a reboot: a run that begins does not wait by itself."""
_RETURN_PAUSE_S = 5.0
BUSY_WAIT_S = 600.0
"""Longest wait for a bank that another process owns, such as a run whose queue was killed and that ends by itself."""
_BUSY_PAUSE_S = 2.0
_LOOKS_EVERY_S = 0.1
# Outputs are muted and the mirror is parked well within it.
_END_WAIT_S = 120.0
_MAX_SAID = 400
# What Windows ends a process with that does not handle Ctrl-C: somebody wanted it.
CONTROL_C_EXIT = 0xC000013A


def run_queue(path: Path, publish: Callable[[Message], object]) -> Exit:
    """Carry out the entries of a queue that wait; one that was cut off goes on first.

    A run that fails does not end the queue. Entries may be added, moved and removed meanwhile.

    publish: Receives `QueueRunStarted`, `QueueRunEnded` and `QueueEnded`.

    Returns DONE, or NOT_GOOD_ENOUGH where a run of this call did not end well. Raises BankBusyError: another queue, or
    another process that carries out this one, holds the rig. KeyboardInterrupt: stopped by the user; the run that was
    stopped waits again.
    """
    read_queue(path)  # a wrong file name is refused before anything is held
    if path.is_symlink():
        raise InputError(f"{path} is a symbolic link to {path.readlink()}; name the file itself")
    if not os.access(path.absolute().parent, os.W_OK):
        raise InputError(f"{path}: its folder is write-protected; the state of the runs could not be kept")
    with claimed(queue_claim(path)), ExitStack() as instruments, kept_awake(f"carrying out {path.name}"):
        return _QueueRunner(path, publish, instruments).run()


class _QueueRunner:
    def __init__(self, path: Path, publish: Callable[[Message], object], instruments: ExitStack) -> None:
        self._path, self._publish, self._instruments = path, publish, instruments
        self._held: set[str] = set()
        self._unsaved: dict[int, QueueEntry] = {}
        self._stop = StopRequest()

    def run(self) -> Exit:
        for entry in self._entries():
            if entry.to_do:
                self._hold_instruments(entry)
        ended: list[QueueEntry] = []
        with stop_on_signals(self._stop):
            while not self._stop.requested and (next_entry := self._next()) is not None:
                if (result := self._carry_out(next_entry)) is not None:
                    ended.append(result)
        states = [entry.state for entry in ended]
        waiting = sum(entry.to_do for entry in self._entries())
        done, failed, stopped = map(states.count, (EntryState.DONE, EntryState.FAILED, EntryState.STOPPED))
        self._publish(QueueEnded(done, failed, stopped, waiting))
        if self._unsaved:
            raise InputError(f"{self._path}: the disk did not take the last changes; runs may be carried out again")
        if self._stop.requested:
            raise KeyboardInterrupt
        return Exit.DONE if all(state is EntryState.DONE for state in states) else Exit.NOT_GOOD_ENOUGH

    def _entries(self) -> list[QueueEntry]:
        return [self._unsaved.get(entry.number, entry) for entry in read_queue(self._path)]

    def _next(self) -> QueueEntry | None:
        to_do = [entry for entry in self._entries() if entry.to_do]
        cut_off = [entry for entry in to_do if entry.state is EntryState.RUNNING]
        return next(iter(cut_off or to_do), None)

    def _hold_instruments(self, entry: QueueEntry) -> None:
        for name in instrument_names(entry):
            if name not in self._held:
                self._instruments.enter_context(claimed(name))
                self._held.add(name)

    def _carry_out(self, entry: QueueEntry) -> QueueEntry | None:
        """Carry out an entry; returns it as it ended, None where it was stopped and waits again."""
        changed = changed_files(entry)
        if changed:
            say(f"run {entry.number}: changed since it was added: {', '.join(changed)}")
        begun = replace(entry, state=EntryState.RUNNING, started_at=datetime.now(UTC), ended_at=None)
        self._save(begun)
        self._publish(QueueRunStarted(entry.number, entry.words, changed))
        try:
            self._hold_instruments(entry)
            code, said = self._run_until_over(begun, cut_off=entry.state is EntryState.RUNNING)
        except BankBusyError as busy:  # instruments of a run that was added after the queue began
            code, said = int(Exit.BANK_BUSY), str(busy)
            say(f"run {entry.number}: {said}")
        except KeyboardInterrupt:
            self._stop.finish_position()
            code, said = int(Exit.STOPPED), ""
        if self._stop.requested and code == Exit.STOPPED:
            self._save(entry.waiting())
            return None
        state = {0: EntryState.DONE, int(Exit.STOPPED): EntryState.STOPPED}.get(code, EntryState.FAILED)
        over = replace(begun, state=state, code=code, said=said[:_MAX_SAID], ended_at=datetime.now(UTC))
        self._save(over)
        self._publish(QueueRunEnded(entry.number, state, code, over.said))
        return over

    def _run_until_over(self, entry: QueueEntry, *, cut_off: bool) -> tuple[int, str]:
        """Run the command, again where it was killed or its bank is busy; exit code and last line.

        cut_off: Whether an earlier queue had begun it, as before a reboot: instruments may be away as after a kill.
        """
        kills, busy_since_s = 0, time.monotonic()
        killed_at_s = time.monotonic() if cut_off else -math.inf
        while True:
            code, said = self._run_command(entry)
            if self._stop.requested:
                return code, said
            if was_killed(code) and kills < MAX_KILLS:
                kills += 1
                by = f"by signal {-code}" if code < 0 else f"by the system, code {code:#x}"
                say(f"run {entry.number}: killed {by}; it goes on")
                killed_at_s = time.monotonic()
                self._pause(KILLED_PAUSE_S)
            elif code == Exit.INSTRUMENT_FAILED and time.monotonic() - killed_at_s < RETURN_WAIT_S:
                say(f"run {entry.number}: an instrument was not there after the interruption; it is tried again")
                self._pause(_RETURN_PAUSE_S)
            elif code == Exit.BANK_BUSY and time.monotonic() - busy_since_s < BUSY_WAIT_S:
                self._pause(_BUSY_PAUSE_S)
            else:
                return code, said

    def _pause(self, seconds: float) -> None:
        until_s = time.monotonic() + seconds
        while not self._stop.requested and time.monotonic() < until_s:
            time.sleep(_LOOKS_EVERY_S)

    def _run_command(self, entry: QueueEntry) -> tuple[int, str]:
        try:
            process = _start(entry)
        except OSError as failure:
            say(f"run {entry.number}: {sentence(failure)}")
            return int(Exit.WRONG_INPUT), sentence(failure)
        said: list[str] = [""]
        assert process.stdout is not None
        reader = threading.Thread(target=_relay, args=(process.stdout, entry.number, said), daemon=True)
        reader.start()
        try:
            while process.poll() is None:
                if self._stop.requested:
                    _close_input(process)
                time.sleep(_LOOKS_EVERY_S)
        except KeyboardInterrupt:
            _end(process)
            raise
        finally:
            _close_input(process)
            reader.join(_LOOKS_EVERY_S * 10)  # what it started may hold its output open
        return process.returncode, said[0]

    def _save(self, entry: QueueEntry) -> None:
        """Write an entry; what the disk does not take is kept for the next time."""
        self._unsaved[entry.number] = entry
        try:
            with edited_queue(self._path) as entries:
                entries[:] = [self._unsaved.get(other.number, other) for other in entries]
        except (InputError, OSError, BankBusyError) as failure:
            say(f"{sentence(failure)}; the queue goes on, and it is written again after this run")
        else:
            self._unsaved.clear()


def was_killed(code: int) -> bool:
    """Whether something outside ended a process: a signal, or on Windows an NTSTATUS error such as 0xC0000005."""
    return code < 0 or (code >= 0xC0000000 and code != CONTROL_C_EXIT)


def _start(entry: QueueEntry) -> subprocess.Popen[bytes]:
    """Start the command of an entry, out of reach of Ctrl-C; it ends by itself when this process is gone."""
    new_group = getattr(subprocess, "CREATE_NEW_PROCESS_GROUP", 0)
    return subprocess.Popen(
        [sys.executable, "-m", "wavefocus", *entry.words],
        cwd=entry.folder,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        env={**os.environ, WATCHED_VARIABLE: "1", "PYTHONIOENCODING": "utf-8"},
        start_new_session=os.name == "posix",
        creationflags=new_group,
    )


def _relay(output: IO[bytes], number: int, said: list[str]) -> None:
    """Show what a run writes, and keep its last line."""
    with output:
        for line in output:
            text = line.decode("utf-8", "replace").strip()
            if text:
                said[0] = text.removeprefix("wavefocus: ")
                say(f"run {number}: {said[0]}")


def _close_input(process: subprocess.Popen[bytes]) -> None:
    if process.stdin is not None and not process.stdin.closed:
        with suppress(OSError):
            process.stdin.close()


def _end(process: subprocess.Popen[bytes]) -> None:
    """End a run at once: it mutes its outputs and parks its mirror first."""
    at_once = signal.SIGTERM if os.name == "posix" else getattr(signal, "CTRL_BREAK_EVENT", signal.SIGTERM)
    with suppress(OSError):
        process.send_signal(at_once)
    try:
        process.wait(_END_WAIT_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
