"""Why a reference channel does not carry what was played: another rate, silence, another signal, or too much noise."""

from typing import Literal

import numpy as np
import scipy.fft

from wavefocus.calibration import Float32Array, Float64Array
from wavefocus.storage.errors import WavefocusError

Cause = Literal["rate", "silence", "noise", "other", "cut"]

# Rates that audio interfaces are set to, in Hz.
RATES_HZ = (8000, 11025, 16000, 22050, 32000, 44100, 48000, 88200, 96000, 176400, 192000)
# A rate is named where the measured one is this near to it.
SAME_RATE = 5e-4
# Ratios looked at, and the most of them; a longer signal is cut until its width allows for it.
SLOWEST, FASTEST, MAX_RATIOS = 0.48, 2.1, 3000
MAX_SAMPLES = 20_000_000
# In units of the ratio that turns the ends of the signal's band against each other.
RATIO_STEP = 0.4
# The signal is there when it explains this much of the energy where it lies.
CARRIED = 0.3
# Less than this of the signal's rms is silence with its noise, for a loopback with a gain near 1: -46 dB.
SILENT = 0.005
UPSAMPLED = 4

REMEDIES: dict[Cause, str] = {
    "rate": "set the audio interface and player.interface_rate_hz to one rate, and its clock source to internal",
    "silence": "check the cable from the loopback output to the reference input",
    "noise": "check level, cable and input range of the loopback, and recorder and player for lost samples",
    "other": "check which output is wired to the reference input, and recorder and player for lost samples",
    "cut": "make pre-roll and post-roll longer",
}


class ReferenceMissingError(WavefocusError):
    """The reference channel does not hold the whole known signal, clearly enough to fit the clock.

    cause: ``"rate"``, ``"silence"``, ``"noise"``, ``"other"`` (signal), or ``"cut"`` (only a part of it was recorded).
    remedy: What to do about it; the message ends with it unless it has advice of its own (`advised`).
    ratio: DAQ rate over playback rate where the cause is the rate, else 1.
    """

    def __init__(self, message: str, cause: Cause = "other", ratio: float = 1.0, *, advised: bool = False) -> None:
        super().__init__(message if advised else f"{message}; {REMEDIES[cause]}")
        self.cause, self.remedy, self.ratio = cause, REMEDIES[cause], ratio


def missing_reference(
    reference_v: Float32Array | Float64Array, known_v: Float64Array, name: str, found: str, max_ppm: float
) -> ReferenceMissingError:
    """Find out why a reference does not carry the known signal.

    reference_v, float (samples,): The reference channel in volts.
    known_v, float64 (known,): What was played, in volts.
    name: Of the recording, for the message.
    found: What was found wrong, for the message.
    max_ppm: Largest clock skew that is allowed.
    """
    reference = reference_v.astype(np.float64) - float(np.mean(reference_v, dtype=np.float64))
    rms_v = float(np.sqrt(np.mean(np.square(reference))))
    expected_v = float(np.sqrt(np.sum(np.square(known_v)) / max(reference.size, known_v.size)))
    ratio, share, sure_to = playing_ratio(reference, known_v) if rms_v > 0 else (1.0, 0.0, 1.0)
    off_ppm = 1e6 * (ratio - 1)
    if share > CARRIED and abs(off_ppm) > max(max_ppm, 1e6 * sure_to):
        rates = f"{_rates(1 / ratio)} (clock skew {off_ppm:.0f} ppm, allowed {max_ppm:g} ppm)"
        return ReferenceMissingError(f"{name} carries what was played at another rate: {rates}", "rate", ratio)
    missing, level = f"{name} does not carry what was played", f"{1e3 * rms_v:.2g} mV rms"
    if share > CARRIED:
        return ReferenceMissingError(f"{missing} clearly enough ({found})", "noise")
    if rms_v < SILENT * expected_v:
        return ReferenceMissingError(f"{missing}; it is silent, {level}", "silence")
    return ReferenceMissingError(f"{missing} but another signal, {level} ({found})", "other")


def _rates(factor: float) -> str:
    """In words: what plays is so many times as fast as it should be."""
    pairs = [(is_hz, asked_hz) for is_hz in RATES_HZ for asked_hz in RATES_HZ if is_hz != asked_hz]
    is_hz, asked_hz = min(
        sorted(pairs, key=lambda pair: (48000 not in pair, 44100 not in pair)),
        key=lambda pair: abs(pair[0] / pair[1] / factor - 1),
    )
    words = f"the player's clock runs {factor:.5f} times as fast as asked"
    if abs(is_hz / asked_hz / factor - 1) < SAME_RATE:
        words += f", as {is_hz} Hz where {asked_hz} Hz are asked for"
    return words


def playing_ratio(reference: Float64Array, known: Float64Array) -> tuple[float, float, float]:
    """DAQ rate over playback rate at which a known signal is found best.

    Returns ratio; share of the reference's energy that the signal explains, where it lies; how far the ratio may be
    off.
    """
    power = np.square(np.abs(scipy.fft.rfft(known)))
    below = np.cumsum(power) / power.sum()
    low, high = (int(np.searchsorted(below, edge)) for edge in (0.005, 0.995))
    # So many samples that twice the highest frequency is still there.
    step = max(1, int(known.size / (2 * FASTEST * max(high, 1)) / 1.05))
    reference, known = _decimated(reference, step), _decimated(known, step)
    width = max(high - low, 1)
    step_ratio, span = RATIO_STEP / width, np.log(FASTEST / SLOWEST)
    most = min(MAX_RATIOS, max(MAX_SAMPLES // (reference.size + known.size), 50))
    if span / step_ratio > most:
        # A part of the signal resolves less.
        part = max(int(known.size * most * step_ratio / span), 64)
        first = min(max(int(np.argmax(np.abs(known))) - part // 2, 0), max(known.size - part, 0))
        known, step_ratio = known[first : first + part], span / most
    length = scipy.fft.next_fast_len(reference.size + int(known.size * FASTEST) + 8, real=True)
    spectrum = scipy.fft.rfft(reference, length)
    energy = np.concatenate([[0.0], np.cumsum(np.square(reference))])
    fine = scipy.fft.irfft(scipy.fft.rfft(known) * UPSAMPLED, UPSAMPLED * known.size)

    def explained(ratio: float) -> float:
        samples = int(known.size * ratio)
        stretched = np.interp(np.arange(samples) * (UPSAMPLED / ratio), np.arange(fine.size), fine)
        correlation = scipy.fft.irfft(spectrum * scipy.fft.rfft(stretched, length).conj(), length)
        lag = int(np.argmax(np.abs(correlation)))
        first = lag if lag < reference.size else lag - length
        inside = energy[np.clip([first, first + samples], 0, reference.size)]
        own = float(stretched @ stretched) * float(inside[1] - inside[0])
        return float(correlation[lag] ** 2) / own if own > 0 else 0.0

    ratios = SLOWEST * np.exp(step_ratio * np.arange(int(span / step_ratio) + 1))
    best = float(ratios[int(np.argmax([explained(float(ratio)) for ratio in ratios]))])
    for finer in (5, 25, 125):
        near = best * (1 + step_ratio / finer * np.arange(-5, 6))
        best = float(near[int(np.argmax([explained(float(ratio)) for ratio in near]))])
    return best, explained(best), 0.1 * step_ratio


def _decimated(signal: Float64Array, step: int) -> Float64Array:
    """Every `step`-th sample of a signal, low-passed before that."""
    kept = -(-signal.size // step)
    padded = np.pad(signal, (0, kept * step - signal.size))
    return np.asarray(scipy.fft.irfft(scipy.fft.rfft(padded)[: kept // 2 + 1], kept) / step)
