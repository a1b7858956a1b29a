"""A rig to practise on: three instruments, one plate and one clock, all virtual; here the recorder and the whole."""

import threading
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.emulation import RigFault
from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.drivers.protocols import Float32Array, Recorder, Recording, RecordLabel, RecordRequest
from wavefocus.mocks.virtual import (
    DROPOUT,
    GROWING,
    NANOSECONDS,
    NOISE,
    PatchBay,
    VirtualClock,
    label_generator,
    normal,
    sensor_of,
)
from wavefocus.mocks.virtual.faults import VirtualDevice
from wavefocus.mocks.virtual.mirror import VirtualMirror
from wavefocus.mocks.virtual.player import VirtualPlayer
from wavefocus.mocks.virtual.settings import MirrorGeometry, VirtualSettings
from wavefocus.mocks.virtual.synthesis import Spot, Synthesis

_DROPOUT_S = (0.002, 0.010)  # how long speckle hides the surface


@dataclass(frozen=True, slots=True)
class _Speckle:
    """Which record of an attempt loses the signal, for how long, and how far into the record."""

    record: int | None
    duration_s: float
    place: float


class _VirtualRecorder(VirtualDevice, Recorder):
    """Records reference and response.

    mirror, player: Where the laser is, and what is played.
    synthesis: The plate and the signal chain between them.
    patch_bay: What is plugged into its response input.
    """

    def __init__(
        self,
        settings: VirtualSettings,
        clock: VirtualClock,
        mirror: VirtualMirror,
        player: VirtualPlayer,
        synthesis: Synthesis,
        patch_bay: PatchBay,
    ) -> None:
        limits = f"2 channels, ranges up to ±{settings.largest_range_v:g} V, 16 bit"
        super().__init__("recorder", settings.fault_plan, limits)
        self._settings = settings
        self._clock = clock
        self._mirror = mirror
        self._player = player
        self._synthesis = synthesis
        self._patch_bay = patch_bay
        self._speckle = lru_cache(4)(self._draw_speckle)
        self._under_way: tuple[RecordRequest, int] | None = None
        self._lock = threading.Lock()

    @property
    def input_ranges_v(self) -> tuple[float, ...]:
        return tuple(
            sorted(range_v for range_v in self._settings.input_ranges_v if range_v <= self._settings.largest_range_v)
        )

    def start(self, request: RecordRequest) -> None:
        doing = f"starting {request.label}"
        self._check_open(doing)
        largest = self._settings.largest_range_v
        if not all(0 < range_v <= largest for range_v in request.range_v):
            raise self._refusal(doing, f"no range of {request.range_v} V", f"choose above 0 and up to {largest:g} V")
        if request.samples < 1 or not request.sample_rate_hz > 0:
            cause = f"{request.samples} samples at {request.sample_rate_hz} Hz"
            raise self._refusal(doing, cause, "ask for at least one sample at a rate above 0 Hz")
        with self._lock:
            if self._under_way is not None:
                raise self._refusal(doing, "a record is under way", "read or abort it first")
            self._faults.meet("start", doing, request.label)
            self._under_way = (request, self._clock.now_ns())
        self._player.settle_latency(request.label)

    def read(self, timeout_s: float) -> Recording:
        self._check_open("reading")
        with self._lock:
            if self._under_way is None:
                raise self._refusal("reading", "no record was started", "start one first")
            request, start_ns = self._under_way
        doing = f"recording {request.label}"
        true_rate_hz = request.sample_rate_hz * self._settings.clock_ratio
        end_ns = start_ns + round(request.samples / true_rate_hz * NANOSECONDS)
        latest_ns = self._clock.now_ns() + round(timeout_s * NANOSECONDS)
        self._clock.advance_to_ns(min(end_ns, latest_ns))
        if end_ns > latest_ns:
            raise TransientInstrumentError(
                self._name, doing, f"not finished after {timeout_s:g} s", "allow the length of the record"
            )
        try:
            faults = self._faults.meet("read", doing, request.label)
            return self._recording(request, start_ns, end_ns, true_rate_hz, faults)
        finally:
            with self._lock:
                self._under_way = None

    def abort(self) -> None:
        with self._lock:
            self._under_way = None

    def reconnect(self) -> None:
        """Open the device afresh; a record under way is dropped."""
        self.abort()
        super().reconnect()

    def close(self) -> None:
        self.abort()
        super().close()

    def label_under_way(self) -> RecordLabel | None:
        """The label of the record under way, None if there is none."""
        under_way = self._under_way
        return None if under_way is None else under_way[0].label

    def _recording(
        self, request: RecordRequest, start_ns: int, end_ns: int, rate_hz: float, faults: tuple[RigFault, ...]
    ) -> Recording:
        plays = self._player.plays_between(start_ns, end_ns)
        aims = self._mirror.motion.aims(start_ns, end_ns)
        spots = self._synthesis.spots(aims, start_ns, request.samples, rate_hz)
        patched = self._patch_bay.outputs
        clean = self._synthesis.voltages(request.samples, request.sample_rate_hz, start_ns, plays, spots, patched)
        reference_v, response_v = self._corrupted(clean, request.range_v, faults, request.sample_rate_hz)
        generator = label_generator(self._settings.seed, request.label, NOISE)
        noise = [normal(generator, request.samples) for _ in range(2)]
        if patched is None:
            self._make_imperfect(response_v, request)
        noise[0] *= np.float32(self._settings.reference_noise_v)
        noise[1] *= np.float32(self._settings.noise_v if patched is None else self._settings.reference_noise_v)
        reference_v += noise[0]
        response_v += noise[1]
        always = any(fault.kind == "dropout" for fault in faults)
        dark = [fault for fault in faults if fault.kind == "dark"]
        blind = [
            (spot.first, spot.stop)
            for spot in spots
            if spot.place_mm is None or any(_hides(cover, spot) for cover in dark)
        ]
        lost = [*blind, *self._dropout(request, always=always)] if patched is None else []
        for first, stop in lost:
            response_v[first:stop] = self._settings.lost_signal_v * normal(generator, stop - first)
        self._synthesis.add_crosstalk(response_v, request.sample_rate_hz, start_ns, plays)
        if any(fault.kind == "dead_response" for fault in faults):
            response_v[:] = 0.0
        volts = np.empty((2, request.samples), dtype=np.float32)
        step_v, over_range = [], []
        for row, volts_in in enumerate((reference_v, response_v)):
            step_v.append(request.range_v[row] / 32768)
            over_range.append(_convert(volts_in, step_v[-1], out=volts[row]))
        return Recording(volts, (step_v[0], step_v[1]), (over_range[0], over_range[1]))

    def _make_imperfect(self, response_v: Float32Array, request: RecordRequest) -> None:
        """What of the plate and its vibrometer grows with the response: harmonics and noise."""
        cubic, growing = self._settings.cubic_per_v2, self._settings.noise_per_response
        if cubic:
            response_v += np.float32(cubic) * response_v**3
        if growing:
            share = normal(label_generator(self._settings.seed, request.label, GROWING), response_v.size)
            response_v *= 1 + np.float32(growing) * share

    def _dropout(self, request: RecordRequest, *, always: bool) -> list[tuple[int, int]]:
        """The samples, if any, that speckle hides in this record."""
        label = request.label
        speckle = self._speckle(replace(label, record=0))
        duration_s, place = speckle.duration_s, speckle.place
        if always:
            # One on order is the longest there is, and never in the silence before or after the signal.
            duration_s, place = _DROPOUT_S[1], 0.25 + 0.5 * place
        elif label.record != speckle.record:
            return []
        samples = round(duration_s * request.sample_rate_hz)
        first = round(place * max(0, request.samples - samples))
        return [(first, min(request.samples, first + samples))]

    def _draw_speckle(self, label: RecordLabel) -> _Speckle:
        chance = label_generator(self._settings.seed, label, DROPOUT, whole_attempt=True)
        happens = chance.random() < self._settings.dropout_probability
        record = int(chance.integers(self._settings.actuators))
        return _Speckle(record if happens else None, chance.uniform(*_DROPOUT_S), chance.random())

    def _corrupted(
        self,
        clean: tuple[Float32Array, Float32Array],
        range_v: tuple[float, float],
        faults: tuple[RigFault, ...],
        rate_hz: float,
    ) -> tuple[Float32Array, Float32Array]:
        reference_v, response_v = clean
        for fault in faults:
            if fault.kind == "missing_reference":
                reference_v = np.zeros_like(reference_v)
            elif fault.kind == "faint_reference":
                reference_v = reference_v * np.float32(10 ** (fault.level_db / 20))
            elif fault.kind == "drift":
                response_v = response_v * np.float32(10 ** (fault.level_db / 20))
            elif fault.kind == "over_range":
                largest_v = max(float(np.abs(response_v).max()), 1e-9)
                response_v = response_v * np.float32(1.5 * range_v[1] / largest_v)
            elif fault.kind in ("clipped", "lost_sample", "hum"):
                response_v = _spoilt(response_v, fault, rate_hz)
        return reference_v, response_v


def _spoilt(response_v: Float32Array, fault: RigFault, rate_hz: float) -> Float32Array:
    """A response with one of the defects that no instrument reports."""
    level = 10 ** (fault.level_db / 20)
    if fault.kind == "clipped":
        end_v = level * float(np.abs(response_v).max())
        return np.asarray(np.clip(response_v, -end_v, end_v), dtype=np.float32)
    if fault.kind == "lost_sample":
        middle = response_v.size // 2
        return np.concatenate([response_v[:middle], response_v[middle + 1 :], response_v[-1:]])
    hum = np.sin(2 * np.pi * 50.0 / rate_hz * np.arange(response_v.size))
    return np.asarray(response_v + level * np.sqrt(2) * float(response_v.std()) * hum, dtype=np.float32)


def _hides(fault: RigFault, spot: Spot) -> bool:
    """Whether no light comes back from a spot."""
    if fault.spot_mm is None or spot.place_mm is None:
        return True
    x_mm, y_mm, radius_mm = fault.spot_mm
    return float(np.hypot(spot.place_mm[0] - x_mm, spot.place_mm[1] - y_mm)) < radius_mm


def _convert(volts: Float32Array, step_v: float, *, out: Float32Array) -> bool:
    """Round to 16-bit counts, clip, write volts to `out`; returns whether an end was reached."""
    np.multiply(volts, np.float32(1 / step_v), out=out)
    np.rint(out, out=out)
    over_range = bool(out.max() >= 32767 or out.min() <= -32768)
    if over_range:
        np.clip(out, -32768, 32767, out=out)
    out *= np.float32(step_v)
    return over_range


__all__ = ["MirrorGeometry", "VirtualRig", "VirtualSettings"]


class VirtualRig:
    """Mirror, recorder and player before one soft plate; only voltages come out of them.

    A signal sample k of the player appears in the record at sample offset + k * clock_ratio (rates
    being equal), the offset not known. Everything random depends on the seed and the record's label, so
    neither the order of takes nor what happened before them changes a byte.

    settings: The rig; the default rig, if absent.

    mirror, recorder, player, clock: The three instruments and their clock.
    patch_bay: What is plugged into the response input; the vibrometer, until somebody plugs in something else.
    sensors: ``"room"`` and ``"light"``.
    """

    def __init__(self, settings: VirtualSettings | None = None) -> None:
        self.settings = settings or VirtualSettings()
        self._synthesis = Synthesis(self.settings)
        self.patch_bay = PatchBay(self.settings.channel_of_actuator, self.settings.channel_of_loopback)
        self.clock = clock = VirtualClock(realtime=self.settings.realtime)
        self.mirror = mirror = VirtualMirror(self.settings, clock)
        self.player = player = VirtualPlayer(self.settings, clock)
        self.recorder = _VirtualRecorder(self.settings, clock, mirror, player, self._synthesis, self.patch_bay)
        player.follow(self.recorder.label_under_way)
        self.sensors = {
            "room": sensor_of(clock, self.settings.room_c),
            "light": sensor_of(clock, self.settings.light),
        }

    def truth(self, x_mm: float, y_mm: float, taps: int, sample_rate_hz: float = 10_000.0) -> NDArray[np.float64]:
        """The plate's true Green's functions at one point, for tests and the demo's last line.

        From player volts to surface velocity as the vibrometer shows it: amplifier, coil, plate and
        vibrometer low-pass are in, the delay between the recorder's channels is not.

        x_mm, y_mm: Point on the surface in mm.
        taps: Length of the FIRs, > 0.
        sample_rate_hz: Their rate on the player's clock in Hz.

        Returns float64 (actuators, taps): in (m/s)/V.
        """
        return self._synthesis.green((float(x_mm), float(y_mm)), taps, float(sample_rate_hz))

    def truth_spectra(
        self, position_mm: NDArray[np.float64], taps: int, length: int, bins: slice, sample_rate_hz: float = 10_000.0
    ) -> NDArray[np.complex128]:
        """Some bins of the transforms of `truth` at many points, within 1e-6, without the transforms.

        position_mm, float64 (positions, 2): Points on the surface in mm, not on a magnet.
        taps: Length of the FIRs, > 0.
        length: Length of the transform that the FIRs are padded to.
        bins: Which bins, start and stop given.
        sample_rate_hz: Rate of the FIRs on the player's clock in Hz.

        Returns complex128 (positions, actuators, bins).
        """
        return self._synthesis.green_spectra(position_mm, taps, float(sample_rate_hz), length, bins)
