"""A rig file whose instruments stand at the other ends of emulated wires, and the emulated instruments themselves."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

from tests.wire.serial_bench import DIALECTS

ACTUATORS = [[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0], [20.0, -60.0]]

RIG = """
[rig]
name = "emulated"

[actuators]
position_mm = {actuators}

[mirror]
driver = "{dialect}"
port = "{mirror}"
settle_s = 0.02
{keys}

[recorder]
driver = "nidaqmx"
device = "Dev1"
address = "{recorder}"
inter_channel_delay_s = 1.4e-5
response_range_v = 1.0
post_roll_s = 0.3

[player]
driver = "sounddevice"
host_api = "JACK Audio Connection Kit"
device = "wavefocus interface"

[emulation]
seed = 4
noise_v = 1e-4
period_frames = {period_frames}
"""


def rig_text(
    folder: Path, recorder: str, *, dialect: str = "asi-tiger", mirror: str = "", period_frames: int = 4096
) -> str:
    """A rig file's text: its mirror behind a link in `folder`, unless another port is named."""
    return RIG.format(
        actuators=ACTUATORS,
        dialect=dialect,
        mirror=mirror or folder / "mirror",
        keys=DIALECTS[dialect].rig,
        recorder=recorder,
        period_frames=period_frames,
    )


class EmulatedInstruments:
    """A running ``wavefocus emulate``.

    rig_file: What it stands in for.
    """

    def __init__(self, rig_file: Path) -> None:
        self._process = subprocess.Popen(
            [sys.executable, "-m", "wavefocus", "emulate", str(rig_file), "--json"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._process.stdout is not None
        self.lines: list[str] = []
        self._heard = threading.Condition()
        self._reader = threading.Thread(target=self._listen)
        self._reader.start()
        first = self._process.stdout.readline()
        if not first:
            self.close()
            raise AssertionError("\n".join(self.lines))
        with self._heard:
            assert self._heard.wait_for(lambda: any("and here:" in line for line in self.lines), timeout=30)
        self.environment: Mapping[str, str] = {**os.environ, **json.loads(first)["environment"]}

    def say(self, line: str) -> str:
        """Type a line; what the emulated instruments answer."""
        assert self._process.stdin is not None
        with self._heard:
            before = len(self.lines)
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
            assert self._heard.wait_for(lambda: len(self.lines) > before, timeout=30), f"no answer to {line}"
            return self.lines[before]

    def close(self) -> int:
        """Say quit, and wait for the end."""
        if self._process.poll() is None and self._process.stdin is not None:
            self._process.stdin.write("quit\n")
            self._process.stdin.flush()
        code = self._process.wait(timeout=60)
        self._reader.join()
        for stream in (self._process.stdin, self._process.stdout, self._process.stderr):
            if stream is not None:
                stream.close()
        return code

    def _listen(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            with self._heard:
                self.lines.append(line.rstrip())
                self._heard.notify_all()


@contextmanager
def emulated_instruments(rig_file: Path) -> Iterator[EmulatedInstruments]:
    """Emulated devices for the length of a block."""
    sides = EmulatedInstruments(rig_file)
    try:
        yield sides
    finally:
        sides.close()


def free_port() -> int:
    """A TCP port that nobody listens at."""
    import socket

    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
