"""Ending a command early: by a signal, by a file, or by the end of standard input; the one module about signals."""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.drivers.errors import InstrumentError

TERMINAL_GONE = "stopped because its terminal was closed"


@dataclass(frozen=True, slots=True)
class EndingSignals:
    """Numbers of signals that end a command; POSIX and Windows do not have the same ones.

    `finish` and `terminal_gone` finish the position first, `finish` once more ends at once. SIGBREAK is what Windows
    sends for Ctrl-Break and, with seconds to live, when the console window is closed; SIGQUIT is a terminal's key.
    """

    finish: tuple[int, ...]
    terminal_gone: tuple[int, ...]
    at_once: tuple[int, ...]

    @classmethod
    def here(cls, source: object = signal) -> EndingSignals:
        """The signals that a module such as `signal` has."""

        def those_of(*names: str) -> tuple[int, ...]:
            return tuple(int(getattr(source, name)) for name in names if hasattr(source, name))

        return cls(those_of("SIGINT"), those_of("SIGHUP"), those_of("SIGTERM", "SIGBREAK", "SIGQUIT"))

    @property
    def all(self) -> tuple[int, ...]:
        """Every one of them."""
        return (*self.finish, *self.terminal_gone, *self.at_once)

    @contextmanager
    def caught_by(self, receive: Callable[[int, FrameType | None], None]) -> Iterator[None]:
        """Handle the signals in a block, but those that are ignored, as under nohup; in the main thread."""
        caught = [one for one in self.all if signal.getsignal(one) is not signal.SIG_IGN or one in self.finish]
        former = {number: signal.signal(number, receive) for number in caught}
        try:
            yield
        finally:
            for number, disposition in former.items():
                signal.signal(number, disposition)


@contextmanager
def stop_on_signals(stop: StopRequest) -> Iterator[None]:
    """Ctrl-C asks `stop` to finish the position, a second one raises KeyboardInterrupt at once.

    A terminal that goes away (SIGHUP) finishes the position too. SIGTERM, and a console window that is closed on
    Windows, raise KeyboardInterrupt at once: their sender does not wait for a record. Signals after that are
    ignored while the engine puts the instruments to rest. Must be entered in the main thread.
    """
    signals, at_once = EndingSignals.here(), False

    def receive(number: int, frame: FrameType | None) -> None:
        nonlocal at_once
        if at_once:
            return
        if number in signals.terminal_gone:
            stop.finish_position(TERMINAL_GONE)
            return
        if number in signals.finish and not stop.requested:
            stop.finish_position()
            return
        at_once = True
        stop.finish_position()
        raise KeyboardInterrupt

    with signals.caught_by(receive):
        yield


@contextmanager
def ending_at_once() -> Iterator[None]:
    """Let every signal that ends a program mute the outputs first; a second one does not disturb that.

    One that is lost in a finaliser or a callback, which cannot raise, is repeated (`wavefocus.__main__`).
    """
    begun, former = False, sys.unraisablehook

    def receive(number: int, frame: FrameType | None) -> None:
        nonlocal begun
        if not begun:
            begun = True
            raise KeyboardInterrupt

    def lost(unraisable: sys.UnraisableHookArgs) -> None:
        nonlocal begun
        begun = begun and not isinstance(unraisable.exc_value, KeyboardInterrupt)
        former(unraisable)

    in_main = threading.current_thread() is threading.main_thread()
    with EndingSignals.here().caught_by(receive) if in_main else nullcontext():
        sys.unraisablehook = lost
        try:
            yield
        except InstrumentError as failure:
            if begun:
                raise KeyboardInterrupt from failure
            raise
        finally:
            sys.unraisablehook = former


def interrupt() -> None:
    """Ctrl-C for the main thread; on POSIX a real signal, which also ends what it waits for."""
    if sys.platform == "win32":
        _thread.interrupt_main()
    else:
        signal.pthread_kill(threading.main_thread().ident or 0, signal.SIGINT)


@contextmanager
def _ended_by(happens: Callable[[threading.Event], bool], name: str, *, join: bool) -> Iterator[None]:
    """End the block with KeyboardInterrupt once a thread's function returns True; the event it gets says to give up."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    over = threading.Event()

    def watch() -> None:
        if happens(over) and not over.is_set():
            interrupt()

    watcher = threading.Thread(target=watch, name=name, daemon=True)
    watcher.start()
    try:
        yield
    finally:
        over.set()
        if join:
            watcher.join()


def ended_by_file(path: Path) -> AbstractContextManager[None]:
    """End the block with KeyboardInterrupt, as Ctrl-C does, once a file appears; the file is removed.

    A file of that name that is there before is no order and is removed first. Must be entered in the main thread to
    have an effect, and inside what turns signals into KeyboardInterrupt.
    """
    path.unlink(missing_ok=True)

    def appears(over: threading.Event) -> bool:
        while not over.wait(0.1):
            if path.exists():
                with suppress(OSError):
                    path.unlink()
                return True
        return False

    return _ended_by(appears, "order to end", join=True)


def ended_by_input() -> AbstractContextManager[None]:
    """End the block with KeyboardInterrupt, as Ctrl-C does, when standard input ends; its content is ignored.

    Must be entered as `ended_by_file`.
    """
    if sys.stdin is None:
        return nullcontext()
    source = sys.stdin.fileno()

    def ends(_over: threading.Event) -> bool:
        # Not through sys.stdin: a thread that waits in its lock would not let the interpreter end.
        with suppress(OSError):  # it cannot be read any more: closed as well
            while os.read(source, 4096):
                pass
        return True

    return _ended_by(ends, "end of input", join=False)
