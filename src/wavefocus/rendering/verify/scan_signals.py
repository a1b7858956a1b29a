"""A scan's record: its signals, and its alignment to the playback clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from wavefocus.acquisition.setup import Setup
from wavefocus.calibration.timing import ClockFitter, to_playback_clock
from wavefocus.drivers.protocols import Recording
from wavefocus.rendering.arrays import Float32Array, Float64Array
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.storage.drive_file import Drive

MARKER_START_HZ = 20.0
# Shortest silence from which noise is measured, and the part before the drive that is not used, in samples.
MIN_SILENCE_SAMPLES = 50
SILENCE_GUARD_SAMPLES = 8


@dataclass(frozen=True, slots=True)
class Aligned:
    """A response on the playback clock, with noise and clock ratio of its record."""

    response: Float32Array
    noise_rms: float
    clock_ratio: float
    playback_gain: float
    signal_lost: bool


def scan_signals(setup: Setup, drive: Drive, samples: int) -> dict[int, Float64Array]:
    """Put the drive on the actuators' channels and a marker sweep over the whole record on the loopback channel.

    Raises InputError: the rig cannot play the drive.
    """
    actuators, drive_samples = drive.drive_v.shape
    if actuators != len(setup.actuator_channels):
        there = len(setup.actuator_channels)
        raise InputError(f"the drive is for {actuators} actuators; the rig has {there}")
    full_scale_v = setup.instruments.player.full_scale_v
    peak_v = np.max(np.abs(drive.drive_v), axis=1, initial=0.0)
    loudest = int(np.argmax(peak_v))
    if not peak_v[loudest] <= full_scale_v:
        raise InputError(
            f"the drive of actuator {loudest} reaches {peak_v[loudest]:.3g} V; "
            f"at most {full_scale_v:.3g} V, the player's full scale: set limit_v in the scene's [output]"
        )
    signals_v: dict[int, Float64Array] = {}
    for channel, signal in zip(setup.actuator_channels, drive.drive_v, strict=True):
        signals_v[channel] = np.concatenate([signal, np.zeros(samples - drive_samples)])
    signals_v[setup.loopback_channel] = marker_v(setup, samples, drive.sample_rate_hz)
    return signals_v


def marker_v(setup: Setup, samples: int, rate_hz: float) -> Float64Array:
    """A sweep for the loopback channel, in volts, by which a fit finds the start of a play in its record.

    It runs from 20 Hz to 1 kHz, or to 0.4 of the rate where that is lower, at half of full scale or 0.7 of the
    reference input's range, faded at both ends.
    """
    amplitude_v = min(0.5 * setup.instruments.player.full_scale_v, 0.7 * setup.range_v[0] / setup.reference_gain)
    time_s = np.arange(samples) / rate_hz
    stop_hz = min(0.4 * rate_hz, 1000.0)
    slope = (stop_hz - MARKER_START_HZ) / (samples / rate_hz)
    sweep = np.sin(2.0 * np.pi * (MARKER_START_HZ + 0.5 * slope * time_s) * time_s)
    fade = np.sin(0.5 * np.pi * np.clip(np.minimum(time_s, time_s[::-1]) / 0.02, 0.0, 1.0)) ** 2
    return np.asarray(amplitude_v * fade * sweep)


class Alignment:
    """Brings the responses of one scan to the playback clock, in response units.

    Safe to share between threads; a result depends only on its recording. `signals_v` are those of every record, from
    `scan_signals`, `rate_hz` their rate; above `quiet_hz` no response has energy to speak of.
    """

    def __init__(self, setup: Setup, signals_v: Mapping[int, Float64Array], rate_hz: float, quiet_hz: float) -> None:
        self._setup = setup
        marker_v = signals_v[setup.loopback_channel]
        self._samples = marker_v.size
        self._clock = ClockFitter(marker_v)
        # The response channel is sampled later, so its samples of an instant come earlier in the record.
        self._delay_samples = -setup.response_delay_s * rate_hz
        self._dropouts = DropoutCheck(rate_hz, quiet_hz)

    def align(self, recording: Recording) -> Aligned:
        """Bring one recorded response to the playback clock.

        Raises ReferenceMissingError: the marker is not on the reference channel.
        """
        reference, response = recording.volts
        fit = self._clock.fit(reference)
        on_clock = to_playback_clock(response, fit, self._samples, delay_samples=self._delay_samples)
        start = int(fit.offset_samples + self._delay_samples) - SILENCE_GUARD_SAMPLES
        end = int(fit.offset_samples + fit.ratio * self._samples) + SILENCE_GUARD_SAMPLES
        lead_in, tail = response[: max(start, 0)], response[end:]
        silence = lead_in if lead_in.size >= MIN_SILENCE_SAMPLES else tail
        noise_v = float(np.std(silence)) if silence.size >= MIN_SILENCE_SAMPLES else float("nan")
        unit = self._setup.response_per_volt
        return Aligned(
            response=(on_clock * unit).astype(np.float32),
            noise_rms=noise_v * abs(unit),
            clock_ratio=fit.ratio,
            playback_gain=fit.gain / self._setup.reference_gain,
            signal_lost=self._dropouts.finds_one(response),
        )


# Share of a response's energy above the frequency from which it is taken to be only noise.
QUIET_SHARE = 1e-5
# A window is lost when it holds more than this many times the noise, and more than this share of the loudest
# window of the response, both as rms.
NOISE_FACTOR = 6.0
RESPONSE_SHARE = 0.02


def quiet_above_hz(response: NDArray[np.floating], rate_hz: float, band_hz: tuple[float, float] | None) -> float:
    """Frequency above which responses (positions, samples) have no energy to speak of, in Hz.

    Frequencies up to twice the bank's band belong to the signal in any case.
    """
    power = np.square(np.abs(scipy.fft.rfft(response, axis=1))).sum(axis=0)
    above = np.cumsum(power[::-1])[::-1]
    quiet_hz = float(np.count_nonzero(above > QUIET_SHARE * above[0]) * rate_hz / response.shape[1])
    return quiet_hz if band_hz is None else max(quiet_hz, 2 * band_hz[1])


class DropoutCheck:
    """Looks for bursts of noise in recorded responses, above the frequency from which these are quiet."""

    def __init__(self, rate_hz: float, quiet_hz: float) -> None:
        # A dropout lasts some milliseconds (speckle crossing the spot); windows of 3.2 ms overlap by half.
        half = max(round(0.0032 * rate_hz / 2), 1)
        self._half = half
        shape = np.kaiser(2 * half, 6.0)  # keeps all that lies more than two of its bins away below -60 dB
        bins = np.arange(int(quiet_hz * 2 * half / rate_hz) + 1 + 2, half)
        turn = np.exp(-1j * np.pi * np.outer(np.arange(2 * half), bins) / half)
        outside = shape[:, None] * turn / np.sqrt(max(bins.size, 1) * np.square(shape).sum())
        # Where responses fill the spectrum, no bin is left for the check.
        self._outside = np.concatenate([outside.real, outside.imag], axis=1).astype(np.float32)

    def finds_one(self, response_v: Float32Array) -> bool:
        """The vibrometer lost the signal during a record."""
        windows = np.lib.stride_tricks.sliding_window_view(response_v, 2 * self._half)[:: self._half]
        if not self._outside.size or len(windows) < 8:
            return False
        windows = np.ascontiguousarray(windows)
        loudest = float(_norm(windows).max()) / np.sqrt(2 * self._half)
        outside = _norm(windows @ self._outside)
        return bool(outside.max() > max(NOISE_FACTOR * float(np.median(outside)), RESPONSE_SHARE * loudest))


def _norm(rows: Float32Array) -> Float32Array:
    """Root of the sum of the squares of each row."""
    return np.asarray(np.sqrt(np.einsum("rs,rs->r", rows, rows)))
