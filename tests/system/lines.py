"""A command that talks in JSON lines, driven as a script drives it."""

import json
import queue
import subprocess
import sys
import threading
from typing import Any

# What a busy machine may take; nothing is judged by it.
SOON_S = 60.0


class Lines:
    """A running command; a block's end waits for its own."""

    def __init__(self, *arguments, environment=None):
        self.process = subprocess.Popen(
            [sys.executable, "-m", "wavefocus", *map(str, arguments)],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment,
        )  # fmt: skip
        self._told: queue.SimpleQueue[dict[str, Any] | None] = queue.SimpleQueue()
        self.said: list[str] = []
        self._threads = [threading.Thread(target=self._read), threading.Thread(target=self._listen)]
        for thread in self._threads:
            thread.start()

    def send(self, **line):
        self.send_text(json.dumps(line))

    def send_text(self, text):
        assert self.process.stdin is not None
        self.process.stdin.write(text + "\n")
        self.process.stdin.flush()

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
        told = []
        while (one := self.told()) is not None:
            told.append(one)
        return told

    def close_input(self):
        assert self.process.stdin is not None
        self.process.stdin.close()

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
            if stream is not None:
                stream.close()

    def _read(self):
        assert self.process.stdout is not None
        for line in self.process.stdout:
            self._told.put(json.loads(line))
        self._told.put(None)

    def _listen(self):
        assert self.process.stderr is not None
        for line in self.process.stderr:
            self.said.append(line.rstrip())
