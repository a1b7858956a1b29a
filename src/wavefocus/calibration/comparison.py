"""Comparison of actuators by their responses, and of the recorder's two channels by one signal."""

from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.fft
from numpy.typing import ArrayLike, NDArray

from wavefocus.calibration import Float64Array
from wavefocus.calibration.evidence import HEARD_DB, MOST, ROW_CHANGE, SILENT
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.calibration.timing import ClockFit, ClockFitter

Verdict = Literal["good", "weak", "dead", "reversed", "unlike"]

# A magnet glued a few millimetres off is this much earlier or later, at some metres a second.
MAX_LAG_S = 1e-3
# Floor of a level, for a response of nothing at all.
FLOOR_DB = -200.0


@dataclass(frozen=True, slots=True)
class ActuatorComparison:
    """Each actuator against the others.

    level_db, float64 (actuators,): Energy of the response over the median's.
    verdict: ``"good"``, ``"weak"``, ``"dead"``, ``"reversed"`` or ``"unlike"``, for each.
    """

    level_db: Float64Array
    verdict: tuple[Verdict, ...]

    @property
    def polarity(self) -> tuple[Literal[1, -1], ...]:
        """The sign of each, as far as it was measured: 1 for all that are not reversed."""
        return tuple(-1 if word == "reversed" else 1 for word in self.verdict)


def compare_actuators(
    green: NDArray[np.floating], snr_db: NDArray[np.floating], sample_rate_hz: float
) -> ActuatorComparison:
    """Compare the responses of all actuators, each measured at the same distance from its actuator.

    The common response is the first singular vector of all that are not dead, each scaled to the same energy.
    The sign that most actuators share counts as positive.

    green, float (actuators, taps): Response per volt of drive.
    snr_db, float (actuators,): Signal-to-noise ratio of each.
    sample_rate_hz: Rate of the responses.
    """
    responses = np.asarray(green, dtype=np.float64)
    energy = np.sum(responses**2, axis=1)
    measurable = (np.asarray(snr_db) >= HEARD_DB) & (energy > 0)
    usual = float(np.median(energy[measurable])) if measurable.any() else 1.0
    level_db = 10 * np.log10(np.maximum(energy / usual, 10 ** (FLOOR_DB / 10)))
    alive = measurable & (level_db >= 20 * np.log10(SILENT))
    likeness = np.zeros(len(responses))
    if alive.any():
        shapes = responses[alive] / np.sqrt(energy[alive])[:, np.newaxis]
        common = np.linalg.svd(shapes, full_matrices=False)[2][0]
        found = _correlations(shapes, common, round(MAX_LAG_S * sample_rate_hz))
        likeness[alive] = found if np.count_nonzero(found < 0) <= len(found) / 2 else -found
    verdicts = tuple(_verdict(*figures) for figures in zip(alive, level_db, likeness, strict=True))
    return ActuatorComparison(level_db, verdicts)


def _verdict(alive: np.bool_, level_db: float, likeness: float) -> Verdict:
    if not alive:
        return "dead"
    if abs(likeness) < MOST:
        return "unlike"
    if likeness < 0:
        return "reversed"
    return "weak" if level_db < 20 * np.log10(ROW_CHANGE) else "good"


def _correlations(shapes: Float64Array, common: Float64Array, most_lag: int) -> Float64Array:
    """The largest correlation in magnitude of each shape with the common one, over small lags."""
    length = scipy.fft.next_fast_len(shapes.shape[1] + most_lag, real=True)
    spectra = scipy.fft.rfft(shapes, length, axis=1) * scipy.fft.rfft(common, length).conj()
    lagged = np.roll(scipy.fft.irfft(spectra, length, axis=1), most_lag, axis=1)[:, : 2 * most_lag + 1]
    return np.asarray(lagged[np.arange(len(lagged)), np.abs(lagged).argmax(axis=1)])


class ResponseMissingError(ReferenceMissingError):
    """The response channel does not hold the known signal."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """The known signal on the reference and on the response channel of one record.

    late_s: How much later the signal is on the response channel than on the reference channel, on the record's own time
        axis, in which both channels are sampled at once.
    reference, response: The signal on either channel.
    """

    late_s: float
    reference: ClockFit
    response: ClockFit


class ChannelComparer:
    """Compares the two channels of records of one known signal.

    Each channel is fitted by itself; they are compared at the signal's centre of energy, where a fit's offset and
    ratio do not trade errors.

    known_v, float64 (known,): What was played in volts, on the playback clock, its silences included.
    sample_rate_hz: Nominal rate of the record.
    """

    def __init__(self, known_v: Float64Array, sample_rate_hz: float) -> None:
        self._fitter = ClockFitter(known_v)
        self._rate_hz = sample_rate_hz
        energy = known_v**2
        self._centre = float(np.arange(known_v.size) @ energy / energy.sum())

    def compare(self, reference_v: ArrayLike, response_v: ArrayLike, *, diagnose: bool = True) -> Comparison:
        """Find the signal on both channels of one record.

        reference_v, response_v, (samples,): The two channels in volts, on the DAQ clock.
        diagnose: Whether to find out why the response does not hold the signal.

        Raises ReferenceMissingError: the reference does not hold the signal. ResponseMissingError: the response does
        not.
        """
        reference = self._fitter.fit(reference_v)
        try:
            response = self._fitter.fit(response_v, diagnose=diagnose, name="the response channel")
        except ReferenceMissingError as missing:
            words = str(missing)
            raise ResponseMissingError(words.replace("reference input", "response input"), advised=True) from None
        late = (response.offset_samples + response.ratio * self._centre) - (
            reference.offset_samples + reference.ratio * self._centre
        )
        return Comparison(late / self._rate_hz, reference, response)
