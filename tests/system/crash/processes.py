"""Processes that are killed, stopped or failed at a chosen call or moment."""

import errno
import json
import os
import select
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from enum import IntEnum
from pathlib import Path

HERE = Path(__file__).parent
ROOT = HERE.parents[2]
# A tiny capture takes a second; one that takes this long hangs.
PATIENCE_S = 60.0


class How(IntEnum):
    """What becomes of a process at its chosen call, as `calls.c` knows it."""

    WATCH = 0
    KILL_BEFORE = 1
    KILL_AFTER = 2
    KILL_WITHIN = 3
    STOP_BEFORE = 4
    FAIL_ONCE = 5
    FAIL_ON = 6


@dataclass(frozen=True, slots=True)
class Order:
    """What becomes of a process: `how` at its `call`-th call, after `part` bytes of a write, or with an error.

    how: What happens.
    call: At which call, counted from 1.
    part: Bytes that a write completes before the process is killed within it.
    error: The error number of calls that fail.
    """

    how: How = How.WATCH
    call: int = 0
    part: int = 512
    error: int = errno.ENOSPC


@dataclass(frozen=True, slots=True)
class Ended:
    """How a process ended: its exit code (negative: the signal), and what it said."""

    code: int
    out: str
    err: str
    calls: int | None

    @property
    def killed(self):
        """Whether it was killed."""
        return self.code == -signal.SIGKILL


class HungError(Exception):
    """A process that should have ended did not."""


class Processes:
    """Starts processes, one at a time, by forking one that has imported everything; a context manager.

    folder: For the library, and what processes say.
    watched: Calls on files in this folder are counted.
    """

    def __init__(self, folder, watched):
        self.folder = folder
        self.watched = watched.resolve()
        library = folder / "calls.so"
        compiler = shutil.which("cc") or shutil.which("gcc") or "gcc"
        command = [compiler, "-shared", "-fPIC", "-O1", "-Wall", "-Wextra", "-Werror", "-o", library, HERE / "calls.c"]
        subprocess.run([*command, "-ldl", "-lpthread"], check=True)
        # One thread for linear algebra: more would outlive no fork.
        surroundings = os.environ | {"LD_PRELOAD": str(library), "OPENBLAS_NUM_THREADS": "1"}
        self._server = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-m", "tests.system.crash.process_server"],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, cwd=ROOT, env=surroundings,
        )  # fmt: skip
        self._said = b""
        self.pid = 0

    def warm_up(self, *commands):
        """Let commands run once in the process that the others are forked from."""
        self._order({"warm": [[str(word) for word in command] for command in commands]})
        self._answer("ready")

    def start(self, *arguments, order=None, log=None, stdin=os.devnull):
        """Start a process; return its number."""
        order = order or Order()
        for name in ("calls.txt", "out.txt", "err.txt"):  # it may be killed before it makes its own
            (self.folder / name).unlink(missing_ok=True)
        line = {
            "arguments": [str(one) for one in arguments], "folder": str(self.watched),
            "stdin": str(stdin), "stdout": str(self.folder / "out.txt"), "stderr": str(self.folder / "err.txt"),
            "ended": str(self.folder / "calls.txt"), "log": str(log) if log else "",
            "how": order.how, "call": order.call, "part": order.part, "error": order.error,
        }  # fmt: skip
        self._order(line)
        self.pid = self._answer("pid")
        return self.pid

    def wait(self):
        """Wait for the end of the process that was started.

        Raises HungError: when it did not end in a minute; it was killed.
        """
        try:
            code = self._answer("end")
        except TimeoutError as error:
            os.kill(self.pid, signal.SIGKILL)
            self._answer("end")
            raise HungError(f"process {self.pid} did not end in {PATIENCE_S:g} s") from error
        out, err, calls = (self._said_in(name) for name in ("out.txt", "err.txt", "calls.txt"))
        return Ended(code, out, err, int(calls) if calls else None)

    def run(self, *arguments, order=None, log=None):
        """Start a process and wait for its end."""
        self.start(*arguments, order=order, log=log)
        return self.wait()

    def run_for(self, lifetime_s, *arguments):
        """Start a process and kill it after so many seconds, unless it has ended."""
        self.start(*arguments)
        deadline_s = time.monotonic() + lifetime_s
        # Not through select: its rounding to milliseconds is coarse beside a commit.
        while time.monotonic() < deadline_s and not self._has_answer():
            time.sleep(0.0005)
        if not self._has_answer():
            os.kill(self.pid, signal.SIGKILL)
        return self.wait()

    def converse(self, answers, *arguments, order=None, lifetime_s=1000000000.0):
        """Start a process, write the answer to each line that it prints to its input, and wait for its end.

        It is killed after so many seconds, or when it becomes silent for a minute.
        """
        pipe, printed, rest = self.folder / "in.fifo", 0, b""
        pipe.unlink(missing_ok=True)
        os.mkfifo(pipe)
        descriptor = os.open(pipe, os.O_RDWR)  # so that neither end waits for the other
        try:
            self.start(*arguments, order=order, stdin=pipe)
            started_s = last_s = time.monotonic()
            while not self._has_answer():
                if time.monotonic() > min(started_s + lifetime_s, last_s + PATIENCE_S):
                    os.kill(self.pid, signal.SIGKILL)
                    break
                out = self.folder / "out.txt"
                content = out.read_bytes()[printed:] if out.exists() else b""
                printed += len(content)
                *lines, rest = (rest + content).split(b"\n")
                for line in lines:
                    last_s = time.monotonic()
                    if answer := answers(line.decode()):
                        os.write(descriptor, answer.encode() + b"\n")
                if not lines:
                    time.sleep(0.001)
            return self.wait()
        finally:
            os.close(descriptor)

    def close(self):
        """End the server."""
        assert self._server.stdin is not None
        assert self._server.stdout is not None
        self._server.stdin.close()
        self._server.wait(timeout=PATIENCE_S)
        self._server.stdout.close()

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        self.close()

    def _said_in(self, name):
        said = self.folder / name
        return said.read_text(encoding="utf-8", errors="replace") if said.exists() else ""

    def _order(self, order):
        assert self._server.stdin is not None
        self._server.stdin.write(json.dumps(order).encode() + b"\n")
        self._server.stdin.flush()

    def _has_answer(self):
        assert self._server.stdout is not None
        return bool(select.select([self._server.stdout], [], [], 0)[0])

    def _answer(self, expected):
        assert self._server.stdout is not None
        deadline_s = time.monotonic() + PATIENCE_S
        while b"\n" not in self._said:
            left_s = max(0.0, deadline_s - time.monotonic())
            if not select.select([self._server.stdout], [], [], left_s)[0]:
                raise TimeoutError(f"no {expected!r} in {PATIENCE_S:g} s")
            heard = os.read(self._server.stdout.fileno(), 4096)
            if not heard:
                raise EOFError("the server of processes has ended")
            self._said += heard
        line, self._said = self._said.split(b"\n", 1)
        word, number = line.decode().split()
        assert word == expected, line
        return int(number)
