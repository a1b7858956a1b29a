"""Entry point: runs a command and turns every error into one line and its exit code."""

from __future__ import annotations

import os
import sys
from collections.abc import Sequence
from contextlib import suppress

import typer.main
from typer.exceptions import TyperException

from wavefocus.cli import app
from wavefocus.exits import Exit, exit_code, sentence


def run(arguments: Sequence[str]) -> int:
    """Run one command line and return its exit code.

    Parameters
    ----------
    arguments : sequence of str
        Without the program's name; none shows the help.
    """
    command = typer.main.get_command(app)
    try:
        result = command.main(list(arguments) or ["--help"], prog_name="wavefocus", standalone_mode=False)
    except TyperException as wrong:
        message = " ".join(wrong.format_message().split())
        print(f"wavefocus: {message} (wavefocus --help shows what there is)", file=sys.stderr)
        return Exit.WRONG_INPUT
    except BrokenPipeError:
        return Exit.NOT_GOOD_ENOUGH
    except BaseException as failure:
        code = exit_code(failure)
        if code is None:
            raise
        # A terminal that is gone, or a pipe nobody reads any more, must not change the exit code.
        with suppress(OSError, ValueError):
            print(f"wavefocus: {sentence(failure)}", file=sys.stderr, flush=True)
        return code
    return int(result or 0)


def main() -> None:
    """Run the command line of this process and exit."""
    code = run(sys.argv[1:])
    for stream in (sys.stdout, sys.stderr):
        try:
            stream.flush()
        except (OSError, ValueError):
            # Whoever read our output has gone; the interpreter must not fail on its own last flush.
            with suppress(OSError, ValueError):
                os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
    sys.exit(code)


if __name__ == "__main__":
    main()
