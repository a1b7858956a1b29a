"""Processes that are killed, stopped or failed at a chosen call or moment.

A server, into which `calls.c` is loaded, forks one for each order, so that hundreds of captures start without importing
anew. What is forked runs the program as it is, from its entry point to the interpreter's end.
"""

import atexit
import ctypes
import errno
import gc
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from enum import IntEnum
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

HERE = Path(__file__).parent
# A tiny capture takes a second; one that takes this long hangs.
PATIENCE_S = 60.0


class How(IntEnum):
    """What becomes of a process at its chosen call, as `calls.c` knows it."""

    WATCH = 0
    KILL_BEFORE = 1
    KILL_WITHIN = 2
    STOP_BEFORE = 3
    FAIL_ONCE = 4
    FAIL_ON = 5


@dataclass(frozen=True, slots=True)
class Order:
    """What becomes of a process: `how` at its `call`-th call, after `part` bytes of a write, or with an error.

    call: Counted from 1.
    part: Bytes that a write completes before the process is killed within it.
    error: The error number of calls that fail.
    """

    how: How = How.WATCH
    call: int = 0
    part: int = 512
    error: int = errno.ENOSPC


@dataclass(frozen=True, slots=True)
class Ended:
    """How a process ended: its exit code (negative: the signal), what it said, and how many calls it made."""

    code: int
    out: str
    err: str
    calls: int

    @property
    def killed(self):
        return self.code == -signal.SIGKILL


class HungError(Exception):
    """A process that should have ended did not."""


class Processes:
    """Starts processes, one at a time, by forking one that has imported everything; a context manager.

    folder: For the library, and what processes say.
    watched: Calls on files in this folder are counted.
    """

    def __init__(self, folder, watched):
        self.folder, self.watched, self.pid = folder, watched.resolve(), 0
        library = folder / "calls.so"
        compile_it = [shutil.which("cc") or "gcc", "-shared", "-fPIC", "-O1", "-Wall", "-Wextra", "-Werror"]
        subprocess.run([*compile_it, "-o", library, HERE / "calls.c", "-ldl", "-lpthread"], check=True)
        self._pipe, theirs = Pipe()
        # One thread for linear algebra: more would outlive no fork. What keeps a system awake and translations are not
        # found, which saves a tenth of the time.
        surroundings = {"LD_PRELOAD": str(library), "OPENBLAS_NUM_THREADS": "1", "PATH": "", "LANGUAGE": "C"}
        self._server = subprocess.Popen(
            [sys.executable, "-W", "ignore", "-m", "tests.system.crash.processes", str(theirs.fileno())],
            stdin=subprocess.DEVNULL, pass_fds=[theirs.fileno()], cwd=HERE.parents[2], env=os.environ | surroundings,
        )  # fmt: skip
        theirs.close()

    def warm_up(self, *commands):
        """Let commands run once in the process that the others are forked from."""
        self._pipe.send(("warm", [[str(word) for word in command] for command in commands]))
        self._answer()

    def start(self, *arguments, order=None, log=os.devnull, stdin=os.devnull):
        """Start a process; return its number."""
        files = [str(self.folder / name) for name in ("out.txt", "err.txt", "calls.txt")]
        for name in files:  # it may be killed before it makes its own
            Path(name).write_bytes(b"")
        words = [str(one) for one in arguments]
        self._pipe.send(("run", (words, str(self.watched), [str(stdin), *files, str(log)], order or Order())))
        self.pid = self._answer()
        return self.pid

    def wait(self):
        """Wait for the end of the process that was started.

        Raises HungError: when it did not end in a minute; it was killed.
        """
        try:
            code = self._answer()
        except TimeoutError as error:
            os.kill(self.pid, signal.SIGKILL)
            self._answer()
            raise HungError(f"process {self.pid} did not end in {PATIENCE_S:g} s") from error
        said = [(self.folder / name).read_bytes() for name in ("out.txt", "err.txt", "calls.txt")]
        out, err, calls = (one.decode(errors="replace") for one in said)
        return Ended(code, out, err, int(calls or 0))

    def run(self, *arguments, order=None, log=os.devnull):
        """Start a process and wait for its end."""
        self.start(*arguments, order=order, log=log)
        return self.wait()

    def run_for(self, lifetime_s, *arguments):
        """Start a process and kill it after so many seconds, unless it has ended."""
        self.start(*arguments)
        deadline_s = time.monotonic() + lifetime_s
        # Not through poll alone: its rounding to milliseconds is coarse beside a commit.
        while time.monotonic() < deadline_s and not self._pipe.poll():
            time.sleep(0.0005)
        if not self._pipe.poll():
            with suppress(ProcessLookupError):  # it has just ended
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
            while not self._pipe.poll():
                if time.monotonic() > min(started_s + lifetime_s, last_s + PATIENCE_S):
                    os.kill(self.pid, signal.SIGKILL)
                    break
                content = (self.folder / "out.txt").read_bytes()[printed:]
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

    def __enter__(self):
        return self

    def __exit__(self, kind, error, trace):
        self._pipe.close()
        self._server.wait(timeout=PATIENCE_S)

    def _answer(self):
        if not self._pipe.poll(PATIENCE_S):
            raise TimeoutError
        return self._pipe.recv()


def _serve(pipe):
    """Carry out one order after the other until there are no more; tell each process's number and how it ended."""
    while True:
        try:
            what, order = pipe.recv()
        except EOFError:
            return
        if what == "warm":
            _warm_up(order)
            pipe.send(0)
            continue
        child = os.fork()
        if child == 0:
            _become(*order)
        pipe.send(child)
        _, status = os.waitpid(child, 0)
        pipe.send(os.waitstatus_to_exitcode(status))


def _warm_up(commands):
    """Run commands here, so that whoever is forked finds everything imported and every cache filled."""
    from wavefocus.__main__ import run

    with Path(os.devnull).open("w", encoding="utf-8") as nothing, redirect_stdout(nothing), redirect_stderr(nothing):
        for command in commands:
            run(command)
    # A collection in a child would touch, and so copy, every page of what it inherits.
    gc.collect()
    gc.freeze()


def _become(arguments, folder, files, order):
    """Be the process that was ordered; `files` are its standard streams, the number of its calls and their log."""
    from wavefocus.__main__ import main

    stdin, stdout, stderr, calls, log = files
    library, log_fd = ctypes.CDLL(None), -1
    for number, name in enumerate((stdin, stdout, stderr)):
        fd = os.open(name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC if number else os.O_RDONLY, 0o600)
        os.dup2(fd, number)
        os.close(fd)
    if log != os.devnull:
        log_fd = os.open(log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    atexit.register(lambda: Path(calls).write_text(str(library.crash_calls()), encoding="utf-8"))
    sys.argv = ["wavefocus", *arguments]
    at, part = ctypes.c_long(order.call), ctypes.c_long(order.part)
    library.crash_order(os.fsencode(folder), int(order.how), at, part, order.error, log_fd)
    code = 0
    try:
        main()
    except SystemExit as ended:
        code = int(ended.code or 0)
    # As the interpreter ends, but for taking down what it inherited, which takes longer than a capture.
    threading._shutdown()
    atexit._run_exitfuncs()
    sys.stdout.flush()
    sys.stderr.flush()
    os._exit(code)


if __name__ == "__main__":
    _serve(Connection(int(sys.argv[1])))
