"""The process before and after a command: Ctrl-C, standard streams, warnings. Imports nothing slow."""

from __future__ import annotations

import os
import signal
import sys

# Signals that `_interrupt` has received; a broken import may fail in other words than KeyboardInterrupt.
interrupts: list[int] = []


def end_at_interrupt(code: int | None = None) -> None:
    """End the process at once at Ctrl-C: only modules are loaded so far, or the command is over."""

    def end(number: int, frame: object) -> None:
        if code is None:
            os.write(2, b"wavefocus: stopped by the user\n")
        os._exit(130 if code is None else code)

    if signal.getsignal(signal.SIGINT) in (signal.default_int_handler, _interrupt):  # it may be ignored
        signal.signal(signal.SIGINT, end)


def raise_at_interrupt() -> None:
    """Raise KeyboardInterrupt at Ctrl-C, also where Python would only print it."""
    if signal.getsignal(signal.SIGINT) in (signal.SIG_IGN, signal.SIG_DFL):
        return
    signal.signal(signal.SIGINT, _interrupt)
    former = sys.unraisablehook

    def again(unraisable: sys.UnraisableHookArgs) -> None:
        if not isinstance(unraisable.exc_value, KeyboardInterrupt):
            former(unraisable)
            return
        # It landed in a finaliser, which may not raise: once more, when that is over.
        import _thread
        import threading

        timer = threading.Timer(0.05, _thread.interrupt_main)
        timer.daemon = True
        timer.start()

    sys.unraisablehook = again


def _interrupt(number: int, frame: object) -> None:
    interrupts.append(number)
    raise KeyboardInterrupt


def open_closed_streams() -> None:
    """Put the null device in place of standard streams that are closed (cron, services).

    Otherwise the next file that is opened, a bank perhaps, becomes standard output.
    """
    opened = []
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
        opened.append(descriptor)
    os.close(descriptor)
    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            # Another file may have its number already, and must not be written to.
            source = os.fdopen(os.dup(number) if number in opened else os.open(os.devnull, os.O_RDWR), mode)
            setattr(sys, name, source)


def show_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    file: object = None,
    line: str | None = None,
) -> None:
    """Show a warning of a library, NumPy's about arithmetic above all, as one plain line."""
    from wavefocus.console import say
    from wavefocus.exits import one_line

    of_arithmetic = "; figures that follow from it may be wrong" if issubclass(category, RuntimeWarning) else ""
    say(f"warning: {one_line(str(message))}{of_arithmetic}")
