"""An emulated audio interface: an audio server on a dummy driver, and everything recorded that is played to it."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from types import TracebackType

from wavefocus.mocks.wire.faults import WireFault
from wavefocus.mocks.wire.jack_capture import PlayedAudio, make_ring
from wavefocus.mocks.wire.jack_interface import DEVICE, PLACE_S, START_S, STOP_S

ANSWER_S = PLACE_S + START_S + 10.0


class JackServerError(Exception):
    """The emulated interface did not obey."""


class JackServer:
    """An audio interface of PortAudio's host API `host_api`, called `device`; use it as a context, or stop it.

    period_frames: Frames that the server asks for at a time, a power of two.
    ring_s: How many seconds of what was played are kept.
    faults: What goes wrong by itself: role ``"player"``, kind ``"underflow"`` (the server stands still for `seconds`,
        three periods at least), ``"lost"`` (it is killed, and comes back after `seconds`) or ``"frozen"`` (it stands
        still for `seconds`); 0 seconds are for good. The operation is ``"period"``, or ``"sounding"`` for periods in
        which anything is played.

    host_api, device: What a player has to ask for.
    """

    host_api = "JACK Audio Connection Kit"
    device = DEVICE

    def __init__(
        self,
        *,
        period_frames: int = 4096,
        channels: int = 24,
        rate_hz: int = 48_000,
        ring_s: float = 30.0,
        faults: Sequence[WireFault] = (),
    ) -> None:
        self._ring = make_ring(channels, rate_hz, period_frames, ring_s)
        root = str(Path(__file__).parents[3])
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-m", "wavefocus.mocks.wire.jack_interface", str(self._ring.descriptor)],
            env={**os.environ, "PYTHONPATH": os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            pass_fds=[self._ring.descriptor],
            start_new_session=True,
        )
        self._lock = threading.Lock()
        self.played = PlayedAudio(self._ring, lambda: self._process.poll() is None)
        settings = {"faults": [asdict(fault) for fault in faults if fault.role == "player"]}
        try:
            name = self._ask(json.dumps(settings), ANSWER_S)["server"]
        except BaseException:
            self.stop()
            raise
        self.environment = {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1"}

    def __enter__(self) -> JackServer:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()

    @property
    def process_id(self) -> int:
        """The process that is the interface."""
        return self._process.pid

    def kill(self) -> None:
        """Pull the plug: the server ends without notice."""
        self._order("kill")

    def restart(self, channels: int = 0) -> None:
        """Plug it in again after `kill`; `played` goes on, with silence in between.

        channels: With fewer outputs than before, as an interface that came back in another mode; 0 for all.
        """
        self._order(f"start {channels}")

    def freeze(self) -> None:
        """Let the driver hang."""
        self._order("freeze")

    def thaw(self) -> None:
        """Let it go on."""
        self._order("thaw")

    def underflow(self) -> None:
        """Let the server stand still for three periods."""
        self._order("underflow")

    def stop(self) -> None:
        """End everything; twice does no harm."""
        if self._process.stdin is None or self._process.stdin.closed:
            return
        assert self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(START_S + 3 * STOP_S)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait(STOP_S)
        self._process.stdout.close()
        self._ring.close()

    def _order(self, word: str) -> None:
        with self._lock:
            self._ask(word, ANSWER_S)

    def _ask(self, line: str, timeout_s: float) -> dict[str, str]:
        """Send a line and wait for the answer; a process that gives none is ended."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        guard = threading.Timer(timeout_s, self._process.kill)
        guard.start()
        try:
            self._process.stdin.write(line + "\n")
            self._process.stdin.flush()
            answer = json.loads(self._process.stdout.readline() or '{"failed": "its process ended"}')
        except BrokenPipeError:
            answer = {"failed": "its process is gone"}
        finally:
            guard.cancel()
        if "failed" in answer:
            raise JackServerError(f"the emulated audio interface failed: {answer['failed']}")
        return dict(answer)
