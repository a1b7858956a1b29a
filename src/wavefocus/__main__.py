"""Entry point: runs a command and turns every error into one line and its exit code.

Nothing slow is imported before `main` has taken over Ctrl-C and the standard streams.
"""

from __future__ import annotations

import os
import signal
import sys
from collections.abc import Sequence
from contextlib import suppress

# Signals that `_interrupt` has received; a broken import may fail in other words than KeyboardInterrupt.
interrupts: list[int] = []


def _end_at_interrupt(code: int | None = None) -> None:
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
        # It landed in a finaliser or a callback, which may not raise: once more, when that is over.
        import threading

        timer = threading.Timer(0.05, _interrupt_again)
        timer.daemon = True
        timer.start()

    sys.unraisablehook = again


def _interrupt_again() -> None:
    from wavefocus.ending import interrupt

    interrupt()


def _interrupt(number: int, frame: object) -> None:
    interrupts.append(number)
    raise KeyboardInterrupt


def _open_closed_streams() -> None:
    """Put the null device in place of standard streams that are closed (cron, services).

    Otherwise the next file that is opened, a bank perhaps, becomes standard output.
    """
    opened = []
    while (descriptor := os.open(os.devnull, os.O_RDWR)) <= 2:
        os.set_inheritable(descriptor, True)
        opened.append(descriptor)
    os.close(descriptor)
    from wavefocus.console import STAND_IN

    for number, (name, mode) in enumerate((("stdin", "r"), ("stdout", "w"), ("stderr", "w"))):
        if getattr(sys, name) is None:
            # Another file may have its number already, and must not be written to.
            source = os.fdopen(os.dup(number) if number in opened else os.open(os.devnull, os.O_RDWR), mode)
            vars(source)[STAND_IN] = True
            setattr(sys, name, source)


def _show_warning(message: Warning | str, category: type[Warning], *_: object, **__: object) -> None:
    """Show a warning of a library, NumPy's about arithmetic above all, as one plain line."""
    from wavefocus.console import one_line, say

    of_arithmetic = "; figures that follow from it may be wrong" if issubclass(category, RuntimeWarning) else ""
    say(f"warning: {one_line(str(message))}{of_arithmetic}")


def run(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit code."""
    from wavefocus.console import Exit, account, exit_code

    try:
        from wavefocus import cli

        return cli.run_command(arguments or ["--help"])
    except SystemExit:  # the help was shown
        return Exit.DONE
    except BaseException as failure:
        # An import that Ctrl-C breaks off may fail in other words than KeyboardInterrupt.
        code = Exit.STOPPED if interrupts else exit_code(failure)
        # A terminal that is gone, or a pipe nobody reads any more, must not change the exit code.
        with suppress(OSError, ValueError):
            # Python's own account of an error beside the one line.
            if os.environ.get("WAVEFOCUS_TRACEBACK") and code is not Exit.STOPPED:
                import traceback

                traceback.print_exception(failure)
            print(f"wavefocus: {account(failure, code, arguments)}", file=sys.stderr, flush=True)
        return code


def main() -> None:
    """Run the command line of this process and exit."""
    _end_at_interrupt()
    _open_closed_streams()
    import warnings

    import wavefocus.cli  # noqa: F401  (all that is slow to load before a command is chosen)
    from wavefocus.console import Exit, Listener

    warnings.showwarning = _show_warning
    try:
        raise_at_interrupt()
        sys.stdout = Listener.in_place_of(sys.stdout)
        code = run(sys.argv[1:])
    except KeyboardInterrupt:
        code = Exit.STOPPED
    _end_at_interrupt(code)
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            # The reader of our output has gone; the interpreter must not fail on its own last flush.
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    if code == Exit.STOPPED:
        # Python up to 3.12 takes a thread for ended once an interrupt has broken off its join (python/cpython#89437);
        # if it is within C++ when the interpreter goes, the process aborts. All that is to be closed has been.
        os._exit(code)
    sys.exit(code)


if __name__ == "__main__":
    main()
