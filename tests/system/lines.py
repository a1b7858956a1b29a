"""A command that talks in JSON lines, driven as a script drives it."""

import contextlib
import io
import json
import os
import queue
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from wavefocus.__main__ import run

# What a busy machine may take; nothing is judged by it.
SOON_S = 60.0


def of_posix(test):
    """Mark a test that needs a POSIX shell, and signals to a process of its own."""
    reason = "a POSIX shell, and signals to a process of its own"
    return pytest.mark.may_skip(reason)(pytest.mark.skipif(os.name != "posix", reason=reason)(test))


def of_linux(reason):
    """Marks of a module that needs Linux, for this reason."""
    return [pytest.mark.may_skip(reason), pytest.mark.skipif(sys.platform != "linux", reason=reason)]


def python(*words, shell=(), timeout=110, **settings):
    """What Python does in a process of its own, from its beginning to its end."""
    command = [*shell, sys.executable, *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=timeout, check=False, **settings)


def wait_until(happened, what, timeout_s=SOON_S):
    """Come back when it happened; a bound, not a measurement."""
    latest_s = time.monotonic() + timeout_s
    while not happened():
        assert time.monotonic() < latest_s, f"{what}: not within {timeout_s} s"
        time.sleep(0.01)


class Talk:
    """What a command tells, one event a line, and the orders that it is sent."""

    def __init__(self, orders):
        self._told = queue.SimpleQueue()
        self._orders = orders
        self.said = []

    def send(self, **line):
        self.send_text(json.dumps(line))

    def send_text(self, text):
        try:
            self._orders.write(text + "\n")
            self._orders.flush()
        except BrokenPipeError:
            raise AssertionError(f"it ended: {self.rest()[-3:]} {self.said}") from None

    def told(self):
        """The next line that it tells; None at its end."""
        return self._told.get(timeout=SOON_S)

    def hear(self, *events):
        """The next event of one of some kinds; those before it are passed over."""
        while (told := self.told()) is not None:
            if told["event"] in events:
                return told
        raise AssertionError(f"it ended without {' or '.join(events)}: {self.said}")

    def next_of(self, event):
        """The next event of a kind that was told already, None where there is none; those before it are passed over."""
        while not self._told.empty():
            told = self._told.get()
            if told is None:
                self._told.put(None)
                return None
            if told["event"] == event:
                return told
        return None

    def rest(self):
        """All that it tells until its end."""
        return list(iter(self.told, None))

    def close_input(self):
        self._orders.close()


class _Told(io.TextIOBase):
    """Standard output whose whole lines are heard."""

    def __init__(self, hear):
        self._hear, self.lines = hear, [""]

    def write(self, text):
        *whole, rest = (self.lines.pop() + text).split("\n")
        self.lines += [*whole, rest]
        for line in whole:
            self._hear(json.loads(line))
        return len(text)


def in_process(script, *arguments):
    """Run a command in this process while a script talks with it in a thread of its own; the exit code."""
    reading, writing = os.pipe()
    with os.fdopen(reading) as stdin, os.fdopen(writing, "w") as orders, pytest.MonkeyPatch.context() as patch:
        talk = Talk(orders)
        patch.setattr(sys, "stdin", stdin)
        told = _Told(talk._told.put)
        patch.setattr(sys, "stdout", told)

        def carry_out():
            with orders:  # whatever becomes of the script, the command ends
                script(talk)

        with ThreadPoolExecutor(1) as thread:
            done = thread.submit(carry_out)
            try:
                code = run([str(one) for one in arguments])
            finally:
                talk._told.put(None)
            done.result(SOON_S)
    assert all(json.loads(line) for line in told.lines[:-1])  # and nothing else on standard output
    return code


class Lines(Talk):
    """A command in a process of its own; a block's end waits for its own."""

    def __init__(self, *arguments, environment=None):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "wavefocus", *map(str, arguments)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        super().__init__(self.process.stdin)
        self._threads = [threading.Thread(target=self._read), threading.Thread(target=self._listen)]
        for thread in self._threads:
            thread.start()

    def end(self):
        """Its exit code."""
        code = self.process.wait(timeout=SOON_S)
        for thread in self._threads:
            thread.join(SOON_S)
        assert not any("Traceback" in line for line in self.said), self.said
        return code

    def __enter__(self):
        return self

    def __exit__(self, kind, failure, trace):
        if self.process.poll() is None:
            self.process.kill()
        self.process.wait()
        for thread in self._threads:
            thread.join(SOON_S)
        for stream in (self.process.stdin, self.process.stdout, self.process.stderr):
            with contextlib.suppress(BrokenPipeError):  # an order that it did not wait for
                stream.close()

    def _read(self):
        for line in self.process.stdout:
            self._told.put(json.loads(line))
        self._told.put(None)

    def _listen(self):
        for line in self.process.stderr:
            self.said.append(line.rstrip())
