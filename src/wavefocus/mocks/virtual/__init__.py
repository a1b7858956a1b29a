"""Clock, sensors, patch bay and chance of the virtual laboratory."""

import hashlib
import re
import struct
import threading
import time
from collections.abc import Callable, Sequence
from functools import cache

import numpy as np

from wavefocus.drivers.protocols import Float32Array, RecordLabel

NANOSECONDS = 1_000_000_000


class VirtualClock:
    """Virtual time in whole nanoseconds, so that differences do not depend on the hour.

    realtime: Virtual time is the wall's: a wait of one virtual second lasts one second, and what a program does takes
        time, too.
    """

    def __init__(self, *, realtime: bool = False) -> None:
        self._now_ns = 0
        self._lock = threading.Lock()
        self._wall_start_ns = time.monotonic_ns() if realtime else None

    def now_s(self) -> float:
        """Virtual seconds since the clock was made."""
        return self.now_ns() / NANOSECONDS

    def now_ns(self) -> int:
        """Virtual nanoseconds since the clock was made."""
        with self._lock:
            return self._caught_up_ns()

    def sleep(self, seconds: float) -> None:
        """Let `seconds` of virtual time pass; a negative time is none."""
        with self._lock:
            self._now_ns = target_ns = self._caught_up_ns() + max(0, round(seconds * NANOSECONDS))
        self._keep_pace(target_ns)

    def advance_to_ns(self, instant_ns: int) -> None:
        """Let time pass until `instant_ns`, if that lies ahead."""
        with self._lock:
            self._now_ns = max(self._now_ns, instant_ns)
        self._keep_pace(instant_ns)

    def _caught_up_ns(self) -> int:
        if self._wall_start_ns is not None:
            self._now_ns = max(self._now_ns, time.monotonic_ns() - self._wall_start_ns)
        return self._now_ns

    def _keep_pace(self, instant_ns: int) -> None:
        if self._wall_start_ns is None:
            return
        ahead_ns = self._wall_start_ns + instant_ns - time.monotonic_ns()
        if ahead_ns > 0:
            time.sleep(ahead_ns / NANOSECONDS)


def sensor_of(clock: VirtualClock, course: tuple[tuple[float, float], ...]) -> Callable[[], float]:
    """A sensor that reads a course on the rig's clock.

    course: Instants in s, rising, and the values then; in between it changes evenly, before and after it stays.
    """
    instants, values = np.array(course, dtype=np.float64).T
    return lambda: float(np.interp(clock.now_s(), instants, values))


_VIBROMETER, _SUM, _BOTH = "vibrometer", "sum", "both"


class PatchBay:
    """Plugs one source at a time into the response input.

    The words are ``"vibrometer"`` (as for a campaign), ``"output K"`` (output K of the player), ``"sum"`` (all
    outputs that drive actuators, through a summing box of gain 1) and ``"both"`` (the loopback, which the reference
    input gets too).

    actuator_outputs: Outputs of the player that drive actuators.
    loopback_output: The output that is looped back to the reference input.

    word: What is plugged in now.
    """

    def __init__(self, actuator_outputs: Sequence[int], loopback_output: int) -> None:
        self._actuator_outputs = tuple(actuator_outputs)
        self._loopback_output = loopback_output
        self.word = _VIBROMETER

    def connect(self, word: str) -> None:
        """Plug in something else. Raises ValueError."""
        self._outputs_of(word)
        self.word = word

    @property
    def outputs(self) -> tuple[int, ...] | None:
        """Outputs whose voltages add up at the response input; None where the vibrometer is plugged in."""
        return self._outputs_of(self.word)

    def _outputs_of(self, word: str) -> tuple[int, ...] | None:
        if word == _VIBROMETER:
            return None
        if word == _SUM:
            return self._actuator_outputs
        if word == _BOTH:
            return (self._loopback_output,)
        output = re.fullmatch(r"output (\d{1,4})", word)
        if output is not None and int(output[1]) in (*self._actuator_outputs, self._loopback_output):
            return (int(output[1]),)
        wired = ", ".join(str(output) for output in sorted((*self._actuator_outputs, self._loopback_output)))
        raise ValueError(f"patch is {word!r}; allowed: vibrometer, sum, both, or output K with K one of {wired}")


# Randomness depends on the seed and the label, and on nothing that happened before.
_LATENCY, NOISE, DROPOUT, GROWING = range(4)  # what is drawn for a label, each from a stream of its own
_EVERY_RECORD = 0xFFFF_FFFF  # in place of a record: one stream for the whole attempt


# A normal distribution as 65,536 equally likely values (the middle quantiles, unit variance). Drawing
# from it is six times faster than a ziggurat, and after a 16-bit converter no test can distinguish them.
@cache
def _normal_values() -> Float32Array:
    """The values, in their order."""
    from scipy.special import ndtri  # the clock and the patch bay shall not wait for it

    quantiles = ndtri((np.arange(65_536) + 0.5) / 65_536)
    return np.asarray((quantiles / quantiles.std()).astype(np.float32))


def label_generator(seed: int, label: RecordLabel, stream: int, *, whole_attempt: bool = False) -> np.random.Generator:
    """The generator of one stream of one label.

    seed: Seed of the rig, >= 0.
    label: The measurement.
    stream: ``_LATENCY``, ``NOISE``, ``DROPOUT`` or ``GROWING``.
    whole_attempt: One stream for all records of the attempt.
    """
    record = _EVERY_RECORD if whole_attempt else label.record
    return np.random.Generator(np.random.SFC64(_digest(seed, label, record, stream, 16)))


def label_share(seed: int, label: RecordLabel) -> float:
    """A number from 0 to below 1, drawn once for a label: how late its player starts.

    seed: Seed of the rig, >= 0.
    label: The measurement.
    """
    return (_digest(seed, label, label.record, _LATENCY, 8) >> 11) / 2**53


def _digest(seed: int, label: RecordLabel, record: int, stream: int, size: int) -> int:
    """A hash of everything a stream depends on."""
    words = struct.pack("<qqqqq", label.position, label.attempt, record, stream, seed)
    digest = hashlib.blake2b(words + label.purpose.encode(), digest_size=size).digest()
    return int.from_bytes(digest, "little")


def normal(generator: np.random.Generator, samples: int) -> Float32Array:
    """Normally distributed samples of variance 1.

    samples: How many, >= 0.
    """
    words = np.asarray(generator.bit_generator.random_raw(-(-samples // 4)), dtype="<u8")
    # No index can be out of bounds, and numpy's check for it would cost as much as the rest.
    return _normal_values().take(words.view("<u2")[:samples], mode="wrap")
