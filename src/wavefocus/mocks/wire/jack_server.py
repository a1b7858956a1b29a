"""An emulated audio interface: an audio server on a dummy driver, and everything recorded that is played to it.

What was played lies in memory that is shared with the process `wavefocus.mocks.wire.jack_interface`.
"""

from __future__ import annotations

import json
import mmap
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.drivers.protocols import Float32Array
from wavefocus.mocks.virtual import NANOSECONDS

if TYPE_CHECKING:
    from wavefocus.config.emulation import WireFault

_Int64Array = NDArray[np.int64]

_HEADER = np.dtype(
    [
        ("channels", "<i8"),
        ("rate_hz", "<i8"),
        ("period_frames", "<i8"),
        ("ring_frames", "<i8"),
        ("written", "<i8"),  # frames so far; moved on when they are in the ring
        ("silent", "<i8"),  # 1 while the audio server is down or frozen
        ("revision", "<i8"),  # moved on when frames and time were found to be related otherwise than was thought
        ("cycle", "<i8"),  # how many cycles; the newest is at cycle % _CYCLES - 1
    ]
)
_CYCLES = 64

_SLOWEST = 2e-5
"""How much slower than the monotonic clock the server's may run, so that the recording keeps up with it."""

_LOOKS = 4
"""Callbacks that are all late show that the grid has moved, and not that they were late."""


class AudioRing:
    """The last seconds of all outputs, and when they were asked for.

    header, record (1,): As `_HEADER`.
    cycles, int64 (_CYCLES, 2): First frame of a cycle, and its nominal start by `time.monotonic_ns`.
    samples, float32 (channels, ring_frames): Parts of full scale.
    """

    def __init__(self, descriptor: int) -> None:
        self.descriptor = descriptor
        memory = mmap.mmap(descriptor, 0)
        self.header = np.frombuffer(memory, _HEADER, 1)
        at = _HEADER.itemsize
        self.cycles: _Int64Array = np.frombuffer(memory, np.int64, 2 * _CYCLES, at).reshape(_CYCLES, 2)
        at += self.cycles.nbytes
        channels, frames = int(self.header["channels"][0]), int(self.header["ring_frames"][0])
        samples = np.frombuffer(memory, np.float32, channels * frames, at)
        self.samples: Float32Array = samples.reshape(channels, frames)

    def close(self) -> None:
        """Let no more processes inherit it; what was written can be read as long as this object is there."""
        os.close(self.descriptor)

    def __getitem__(self, name: str) -> int:
        return int(self.header[name][0])

    def __setitem__(self, name: str, value: int) -> None:
        self.header[name] = value

    def write(self, first: int, block: list[Float32Array]) -> None:
        """Put one cycle's frames in their place; channels beyond those given are silent."""
        for here, there in self._pieces(first, block[0].size):
            for row, frames in zip(self.samples, block, strict=False):
                row[there] = frames[here]
            self.samples[len(block) :, there] = 0

    def silence(self, first: int, frames: int) -> None:
        """Put silence in the place of frames that never were."""
        for _, there in self._pieces(first, min(frames, self.samples.shape[1])):
            self.samples[:, there] = 0

    def read(self, first: int, stop: int) -> Float32Array:
        """A copy of frames that are in the ring, shape (channels, stop - first)."""
        out = np.empty((self.samples.shape[0], stop - first), dtype=np.float32)
        for here, there in self._pieces(first, stop - first):
            out[:, here] = self.samples[:, there]
        return out

    def _pieces(self, first: int, frames: int) -> list[tuple[slice, slice]]:
        """The stretch and its rest after the ring's end, as slices of a block and of the ring."""
        ring = self.samples.shape[1]
        at = first % ring
        head = min(frames, ring - at)
        pieces = [(slice(0, head), slice(at, at + head))]
        return pieces if head == frames else [*pieces, (slice(head, frames), slice(0, frames - head))]


class RingWriter:
    """Puts what is played into the ring, in time."""

    def __init__(self, ring: AudioRing) -> None:
        self._ring = ring
        self._rate_hz = ring["rate_hz"]
        self._grid_ns = 0
        self._lates_ns: deque[int] = deque(maxlen=_LOOKS)
        self._resumed = False

    def note_return(self) -> None:
        """The server has stood still, or is another; the next cycle is its first."""
        self._resumed = True

    def take(self, now_ns: int, block: list[Any]) -> bool:
        """Record one cycle.

        now_ns: When the server asked for it.
        block, list of float32 (frames,): One for each channel.

        Returns bool: whether anything sounds in it.
        """
        ring, frames = self._ring, block[0].size
        period_ns = frames * NANOSECONDS // self._rate_hz
        sounds = any(channel.any() for channel in block)
        if ring["cycle"] == 0:
            self._grid_ns = now_ns
        # A callback this long before its time shows that the first one, which the times are counted from, was late.
        if now_ns < self._grid_ns - 500_000:
            ring["revision"] += 1
        self._grid_ns = min(self._grid_ns, now_ns)
        self._keep_time(now_ns - self._grid_ns, silent=not sounds)
        written = ring["written"]
        ring.write(written, block)
        ring.cycles[ring["cycle"] % _CYCLES] = (written, self._grid_ns)
        ring["cycle"] += 1
        ring["written"] = written + frames
        self._grid_ns += round(period_ns * (1 + _SLOWEST))
        return sounds

    def _keep_time(self, late_ns: int, *, silent: bool) -> None:
        """Let the clock go on where the server's did not, as an interface's would have done."""
        ring = self._ring
        self._lates_ns.append(late_ns)
        enough = len(self._lates_ns) == _LOOKS
        moved_ns = late_ns if self._resumed else min(self._lates_ns) * enough
        # When a cycle was late the server's clock stood still, and no sample was lost: made up for in silence.
        # A grid of periods that has moved by less is not noticed.
        if moved_ns > 2_000_000 and (self._resumed or silent):
            gap = moved_ns * self._rate_hz // NANOSECONDS
            ring.silence(ring["written"], gap)
            ring["revision"] += 1
            self._grid_ns += moved_ns
            self._lates_ns.clear()
            ring["written"] += gap
        self._resumed = False


def _make_ring(channels: int, rate_hz: int, period_frames: int, seconds: float) -> AudioRing:
    """A ring whose descriptor a child process may inherit.

    In anonymous memory where there is such a thing: /dev/shm is small in containers, and a file on a disk would
    keep the audio waiting.
    """
    frames = -(-round(seconds * rate_hz) // period_frames) * period_frames
    size = _HEADER.itemsize + 16 * _CYCLES + 4 * channels * frames
    if sys.platform == "linux":
        descriptor = os.memfd_create("wavefocus-audio")
    else:
        with tempfile.TemporaryFile() as file:
            descriptor = os.dup(file.fileno())
    os.ftruncate(descriptor, size)
    header = np.zeros(1, _HEADER)
    header["channels"], header["rate_hz"] = channels, rate_hz
    header["period_frames"], header["ring_frames"] = period_frames, frames
    with mmap.mmap(descriptor, 0) as memory:
        memory[: _HEADER.itemsize] = header.tobytes()
    return AudioRing(descriptor)


_LATE_S = 10.0
"""How late frames may come on a busy machine."""


class _AudioNotCapturedError(Exception):
    """Frames that were asked for are not to be had: too old, or the capture is gone."""


class PlayedAudio:
    """What has left the outputs, by frames of the audio clock; safe to share between threads.

    The clock goes on whatever happens. While the audio server is frozen or down, nothing leaves the outputs: those
    frames are silent.

    ring: Filled by the process that is the interface.
    alive: Whether that process is.
    """

    def __init__(self, ring: AudioRing, alive: Callable[[], bool]) -> None:
        self._ring = ring
        self._alive = alive
        self.rate_hz = ring["rate_hz"]
        self.channels = ring["channels"]
        self._held: tuple[int, int, int] | None = None
        self._lock = threading.Lock()

    def frame_at(self, instant_ns: int) -> float:
        """The frame that sounds at an instant of `time.monotonic_ns`.

        A frame sounds one period after the server asked for it, as with an interface that plays one half of its
        buffer while the other is filled. The slope is `rate_hz`, exactly. The relation is measured anew only when
        it is asked for an instant more than 30 s from the last measurement, and then moves by what the two clocks
        have parted, or after an interruption.
        """
        ring = self._ring
        with self._lock:
            revision = ring["revision"]
            held = self._held
            # How long one relation of frames and time is held: longer than a record, shorter than two clocks take to
            # part.
            if held is None or abs(instant_ns - held[1]) > 30 * NANOSECONDS or held[2] != revision:
                frame, start_ns = self._newest_cycle()
                self._held = held = (frame, start_ns, revision)
        return held[0] - ring["period_frames"] + (instant_ns - held[1]) * self.rate_hz / NANOSECONDS

    def read(self, first_frame: int, stop_frame: int) -> Float32Array:
        """Frames as parts of full scale, once the last one is there. Raises _AudioNotCapturedError.

        first_frame, stop_frame: Which frames; those before the interface was there, below 0, are silent.

        Returns float32 (channels, stop_frame - first_frame).
        """
        out = np.zeros((self.channels, stop_frame - first_frame), dtype=np.float32)
        first, stop = max(0, first_frame), max(0, stop_frame)
        stop = min(stop, self._wait_for(stop))
        if first < stop:
            oldest = self._ring["written"] - self._ring["ring_frames"]
            if first >= oldest:
                out[:, first - first_frame : stop - first_frame] = self._ring.read(first, stop)
            # A cycle more, because the next one may have been on its way into the ring meanwhile.
            oldest = self._ring["written"] + self._ring["period_frames"] - self._ring["ring_frames"]
            if first < oldest:
                raise _AudioNotCapturedError(f"frame {first} is gone, the oldest is {oldest}: keep more seconds")
        return out

    def _wait_for(self, stop: int) -> int:
        """Wait for frames; how many there are, fewer only if the rest are silent."""
        latest_s = None
        while (written := self._ring["written"]) < stop:
            silent = bool(self._ring["silent"])
            missing_s = (stop - self.frame_at(time.monotonic_ns())) / self.rate_hz
            if silent and missing_s <= 0 and self._ring["silent"]:
                return written
            now_s = time.monotonic()
            latest_s = latest_s or now_s + max(0.0, missing_s) + _LATE_S
            if not self._alive():
                raise _AudioNotCapturedError("the process that records the audio is gone")
            if now_s > latest_s:
                raise _AudioNotCapturedError(f"frame {stop} is {_LATE_S:g} s late, {written} are there")
            time.sleep(min(max(missing_s, 0.001), 0.02))
        return written

    def _newest_cycle(self) -> tuple[int, int]:
        while True:
            cycle = self._ring["cycle"]
            frame, start_ns = self._ring.cycles[(cycle - 1) % _CYCLES]
            if self._ring["cycle"] - cycle < _CYCLES - 1:  # it was not overwritten in between
                return int(frame), int(start_ns)


DEVICE = "wavefocus interface"
PLACE_S = 60.0
"""How long an interface waits for room in shared memory."""
START_S = 20.0
STOP_S = 5.0
_ANSWER_S = PLACE_S + START_S + 10.0


class JackServerError(Exception):
    """The emulated interface did not obey."""


class JackServer(AbstractContextManager["JackServer"]):
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
        self._ring = _make_ring(channels, rate_hz, period_frames, ring_s)
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
        settings = {"faults": [fault.model_dump() for fault in faults if fault.role == "player"]}
        try:
            name = self._ask(json.dumps(settings), _ANSWER_S)["server"]
        except BaseException:
            self.stop()
            raise
        self.environment = {"JACK_DEFAULT_SERVER": name, "JACK_NO_START_SERVER": "1"}

    def __exit__(self, *failure: object) -> None:
        self.stop()

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
            self._ask(word, _ANSWER_S)

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
