"""One plate and one clock behind all wires: what is played comes back as the plate's response."""

from __future__ import annotations

import dataclasses
import threading
import time
from collections import deque
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from mocks.virtual.settings import VirtualSettings
from mocks.virtual.signals import SignalStore
from mocks.virtual.surroundings import NANOSECONDS, PatchBay
from mocks.virtual.synthesis import TAIL_S, Play, Spot, Synthesis

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]

# Silence on all channels that parts one sound from the next; sweeps of one record become one sound each, which the
# store of signals then recognises.
PARTING_S = 0.01
# What a converter cannot put out is silence: -160 dB of full scale.
SILENCE = 1e-8
KEPT_ONSETS = 1000


class Played(Protocol):
    """What has left the outputs of the audio interface, by frames of its clock."""

    @property
    def rate_hz(self) -> int:
        """Frames per second."""
        ...

    def frame_at(self, instant_ns: int) -> float:
        """The frame that sounds at an instant of `time.monotonic_ns`."""
        ...

    def read(self, first_frame: int, stop_frame: int) -> Float32Array:
        """Samples as parts of full scale, shape (channels, frames); waits for the last one."""
        ...


class Aimed(Protocol):
    """Where the mirror has looked."""

    def aims(self, start_ns: int, stop_ns: int) -> list[tuple[int, tuple[float, float] | None]]:
        """From each instant on the mirror stands at these optical angles in mrad; None while it moves."""
        ...


class WireBench:
    """The analog world between the instruments: amplifiers, plate, vibrometer and the loopback cable.

    settings: The rig; its player's latency and clock do not count, the audio server's do, but for the difference
        `clock_ppm` between the two clocks, which is made here.
    played: What the player's far side has put out.
    aimed: Where the mirror's far side has looked.
    full_scale_v: Volts that each output is believed to put out at full scale; what it does put out is this times its
        gain in `settings`.
    reference_input, response_input: Physical inputs that the loopback and the patch bay are wired to; others are open
        and read noise.

    patch_bay: What is plugged into the response input; the vibrometer, until somebody plugs in something else.
    onsets: Of the latest records, oldest first: the sample, on the recorder's clock, at which the first sound that
        began within the record began at the loopback output; NaN for a silent record. The truth that drivers and
        estimator are held against.
    """

    def __init__(
        self,
        settings: VirtualSettings,
        played: Played,
        aimed: Aimed,
        *,
        full_scale_v: tuple[float, ...],
        reference_input: str = "ai0",
        response_input: str = "ai1",
    ) -> None:
        self._settings = settings
        self._played = played
        self._aimed = aimed
        self._full_scale_v = full_scale_v
        self._inputs = (reference_input, response_input)
        self.patch_bay = PatchBay(settings.channel_of_actuator, settings.channel_of_loopback)
        self.onsets: deque[float] = deque(maxlen=KEPT_ONSETS)
        self._store = SignalStore(max(full_scale_v))
        # The plate is made, and refused, before anything is played.
        self._synthesis = {settings.inter_channel_delay_s: Synthesis(settings)}
        self._generator = np.random.default_rng(settings.seed)
        self._lock = threading.Lock()

    def record(
        self, start_ns: int, samples: int, rate_hz: float, inputs: tuple[str, ...], channel_delay_s: float
    ) -> Float64Array:
        """Voltages at some inputs, noise included, once they have been.

        start_ns: Instant of the first sample, of `time.monotonic_ns`.
        rate_hz: Their nominal rate in Hz; the recorder's clock is `clock_ppm` faster.
        inputs: Physical inputs in the order of the task.
        channel_delay_s: How much later each input is sampled than the one before.

        Returns float64 (inputs, samples): in volts, before the converter.
        """
        true_rate_hz = rate_hz * self._settings.clock_ratio
        end_ns = start_ns + round(samples / true_rate_hz * NANOSECONDS)
        plays = self._plays(start_ns, end_ns)
        begun_ns = [play.requested_ns - start_ns for play in plays if play.requested_ns >= start_ns]
        self.onsets.append(min(begun_ns, default=np.nan) / NANOSECONDS * true_rate_hz)
        patched = self.patch_bay.outputs
        with self._lock:
            spots = self._spots(start_ns, end_ns, samples, true_rate_hz)
            # Which input is converted first decides which of the two is late.
            order = [inputs.index(name) if name in inputs else 0 for name in self._inputs]
            synthesis = self._with_delay((order[1] - order[0]) * channel_delay_s)
            reference_v, response_v = synthesis.voltages(samples, rate_hz, start_ns, plays, spots, patched)
            for spot in spots:
                if spot.place_mm is None and patched is None:
                    lost_v = self._settings.lost_signal_v * self._generator.standard_normal(spot.stop - spot.first)
                    response_v[spot.first : spot.stop] = lost_v
            noise_v = self._generator.standard_normal((len(inputs), samples))
        volts = noise_v * self._settings.reference_noise_v
        for row, name in enumerate(inputs):
            if name == self._inputs[0]:
                volts[row] += reference_v
            elif name == self._inputs[1]:
                heard_v = self._settings.noise_v if patched is None else self._settings.reference_noise_v
                volts[row] = noise_v[row] * heard_v + response_v
        return np.asarray(volts)

    def spot_mm(self) -> tuple[float, float] | None:
        """Where the laser meets the surface now; None while it moves or misses it."""
        now_ns = time.monotonic_ns()
        aims = self._aimed.aims(now_ns, now_ns + 1)
        return self._place_mm(aims[-1][1]) if aims else None

    def _plays(self, start_ns: int, end_ns: int) -> list[Play]:
        """What sounded in a record or rings on into it, as one play for each stretch between silences."""
        rate_hz = self._played.rate_hz
        zero = self._played.frame_at(start_ns)
        first = int(np.floor(zero - TAIL_S * rate_hz))
        stop = int(np.ceil(zero + (end_ns - start_ns) / NANOSECONDS * rate_hz)) + 1
        frames = self._played.read(first, stop)
        sounding = np.flatnonzero((np.abs(frames) > SILENCE).any(axis=0))
        if not sounding.size:
            return []
        breaks = np.flatnonzero(np.diff(sounding) > PARTING_S * rate_hz)
        firsts = sounding[np.concatenate([[0], breaks + 1])]
        lasts = sounding[np.concatenate([breaks, [-1]])]
        return [
            self._play(frames[:, begin : last + 1], (first + begin - zero) / rate_hz, start_ns)
            for begin, last in zip(firsts.tolist(), lasts.tolist(), strict=True)
        ]

    def _play(self, frames: Float32Array, begins_s: float, start_ns: int) -> Play:
        signals = {
            channel: self._store.find(volts.astype(np.float64) * self._full_scale_v[channel])
            for channel, volts in enumerate(frames[: len(self._full_scale_v)])
            if (np.abs(volts) > SILENCE).any()
        }
        begins_ns = round(begins_s * NANOSECONDS)
        rest_s = begins_s - begins_ns / NANOSECONDS
        return Play(start_ns + begins_ns, float(self._played.rate_hz), signals, frames.shape[1], rest_s)

    def _spots(self, start_ns: int, end_ns: int, samples: int, rate_hz: float) -> list[Spot]:
        aims: Sequence[tuple[int, tuple[float, float] | None]] = self._aimed.aims(start_ns, end_ns)
        firsts = [min(samples, round((instant - start_ns) / NANOSECONDS * rate_hz)) for instant, _ in aims]
        bounds = [*firsts, samples]
        return [Spot(bounds[i], bounds[i + 1], self._place_mm(aim)) for i, (_, aim) in enumerate(aims)]

    def _place_mm(self, aim_mrad: tuple[float, float] | None) -> tuple[float, float] | None:
        if aim_mrad is None:
            return None
        place_mm = self._settings.mirror.spot_mm(*aim_mrad)
        return place_mm if bool(self._settings.outline.contains(place_mm)) else None

    def _with_delay(self, delay_s: float) -> Synthesis:
        """The signal chain with this delay of the response input; a task that is asked again finds it made."""
        if delay_s not in self._synthesis:
            self._synthesis = {delay_s: Synthesis(dataclasses.replace(self._settings, inter_channel_delay_s=delay_s))}
        return self._synthesis[delay_s]
