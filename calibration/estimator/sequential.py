"""From the recordings of a position to its Green's functions, with figures of how far to trust them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from calibration.clock.repeats import RepeatFinder
from calibration.defects.clipping import count_clipped, find_peaks
from calibration.defects.defect_finder import DefectFinder
from calibration.defects.figures import DEFECTS, not_looked_at
from calibration.estimator.causal_fit import CausalFit, ToeplitzFit
from calibration.excitation.sweeps import Sweeps
from storage.errors import InputError

MAX_PPM = 500.0
# A bin this close to the end of the band is in it.
EDGE = 1e-6
# Bounds memory to about 20 MB however many records are given, and to a tenth of a GB however long they are.
BATCH_RECORDS = 32
BATCH_VALUES = 1 << 19
# Elements of a matrix that is decomposed and kept: 64 MiB in float64. What is larger is solved without one.
DENSE_ELEMENTS = 1 << 23
FLOOR = 1e-30


@dataclass(frozen=True, slots=True)
class Estimate:
    """Green's functions of a batch of sequential records, and their quality.

    All energies are sums over the bins from the sweep's lowest to its highest frequency, of the response weighted as
    the fit weighs it; the fit itself uses all that the sweep excites, a little more.

    green, float32 (records, taps): Causal FIRs on the playback clock, response unit per volt of drive.
    snr_db, float32 (records,): Energy that the fitted FIR explains over the noise's in the same band, after averaging;
        the noise is the unexplained energy, scaled from the freedom that the FIR leaves to all of the band.
    residual_db, float32 (records,): Energy that the fitted FIR leaves unexplained over the response's whole energy; 0
        dB for silence. Sees clipping, dropouts, hum, and a response longer than L taps.
    coherence, float32 (records,): Share of the response's energy, over all repeats, that one linear relation to the
        reference explains; NaN for a single sweep.
    peak_v, float32 (records,): Largest magnitude of the response in DAQ volts.
    repeat_db, float32 (records,): Energy of the differences of the repeats from their common relation over that of the
        response, scaled to the variance of one repeat; NaN for a single sweep.
    noise_v, float32 (records,): Rms in DAQ volts of the white noise on one response recording (0 to half the sample
        rate) that would leave this residual.
    clip_count, int32 (records,): Samples of either channel that are clipped: at 0.999 of its range or beyond, or on a
        flat top below it, which an amplifier or the vibrometer left (see `calibration.defects.clipping`).
    offset_samples, float64 (records,): DAQ sample at which the first sweep starts.
    clock_ratio, float64 (records,): DAQ rate over playback rate.
    defects, structured (records,): What stands out of the residuals beyond chance, as
        `calibration.defects.figures.DEFECTS` has it; not examined by default.
    reference_db, float32 (records,): Level in band of the recorded reference over that of the played signal at the
        calibrated `reference_gain`, in dB: 0 where the rig is as it was calibrated. NaN by default.
    """

    green: NDArray[np.float32]
    snr_db: NDArray[np.float32]
    residual_db: NDArray[np.float32]
    coherence: NDArray[np.float32]
    peak_v: NDArray[np.float32]
    repeat_db: NDArray[np.float32]
    noise_v: NDArray[np.float32]
    clip_count: NDArray[np.int32]
    offset_samples: NDArray[np.float64]
    clock_ratio: NDArray[np.float64]
    defects: NDArray[np.void] = field(default_factory=lambda: np.zeros(0, DEFECTS))
    reference_db: NDArray[np.float32] = field(default_factory=lambda: np.zeros(0, np.float32))

    def __post_init__(self) -> None:
        if self.reference_db.size != self.snr_db.size:
            object.__setattr__(self, "reference_db", np.full(self.snr_db.size, np.nan, np.float32))
        if self.defects.size != self.snr_db.size:
            object.__setattr__(self, "defects", not_looked_at(self.snr_db.size))


class Estimator:
    """Averaged H1 from the recorded reference, then least squares for a causal FIR of L taps.

    Everything that is computed once depends on the configuration alone, so that the same recordings give the
    same bytes in whatever order they come. Safe to call from several threads.

    excitation: What each record plays.
    taps: Length L of the FIRs, 1 to the excitation's silence.
    reference_gain: DAQ volts on the reference channel per volt of drive, > 0.
    response_per_volt: Response unit per DAQ volt of the response channel, not 0.
    inter_channel_delay_s: How much later the response channel is sampled than the reference channel, in seconds.
    ridge: Penalty on the FIR's energy relative to the sweep's median power in band, > 0.

    Raises InputError: a value outside the range above.
    """

    def __init__(
        self,
        excitation: Sweeps,
        taps: int,
        *,
        reference_gain: float = 1.0,
        response_per_volt: float = 1.0,
        inter_channel_delay_s: float = 0.0,
        ridge: float = 1e-6,
    ) -> None:
        if not 1 <= taps <= excitation.decay_samples:
            raise InputError(
                f"taps is {taps}; allowed is 1 to the silence after each sweep, {excitation.decay_samples} samples"
            )
        if not (np.isfinite(reference_gain) and reference_gain > 0):
            raise InputError(f"reference_gain is {reference_gain:g}; allowed is a finite number above 0")
        if not (np.isfinite(response_per_volt) and response_per_volt != 0):
            raise InputError(f"response_per_volt is {response_per_volt:g}; allowed is a finite number, not 0")
        if not (np.isfinite(inter_channel_delay_s) and abs(inter_channel_delay_s) <= excitation.decay_s):
            raise InputError(
                f"inter_channel_delay_s is {inter_channel_delay_s:g}; allowed is at most decay_s either way"
            )
        if not 0 < ridge < 1:
            raise InputError(f"ridge is {ridge:g}; allowed is a number between 0 and 1")
        self.excitation = excitation
        self.taps = taps
        self._finder = RepeatFinder(excitation, excitation.decay_samples - taps, MAX_PPM)
        relative = self._finder.power / self._finder.median_power
        self._fit = _fit_for(self._finder.omega, relative, self._finder.period, taps, ridge)
        spectra = excitation.averages * self._finder.omega.size
        self._batch = int(min(max(BATCH_VALUES // spectra, 1), BATCH_RECORDS))
        late = inter_channel_delay_s * excitation.sample_rate_hz
        # The sweep's fades reach beyond its band; what hums there does the Green's function no harm.
        hertz = self._finder.omega * excitation.sample_rate_hz / (2 * np.pi)
        low, high = np.searchsorted(hertz, [excitation.start_hz * (1 - EDGE), excitation.stop_hz * (1 + EDGE)])
        self._in_band = slice(int(low), int(high)) if high - low > hertz.size // 2 else slice(0, hertz.size)
        self._share = (self._in_band.stop - self._in_band.start) / hertz.size
        self._weight = np.sqrt(2 * relative / self._finder.period).astype(np.float32)[self._in_band]
        self._defects = DefectFinder(
            self._finder.omega[self._in_band],
            self._finder.bins.start + self._in_band.start,
            self._finder.period,
            excitation.averages,
            excitation.sample_rate_hz,
            taps,
            freedom=1 - self._fit.rank / self._fit.elements,
            delay_rises=self._finder.delay_rises,
        )
        self._in_time = np.exp(-1j * self._finder.omega * late).astype(np.complex64)
        self._scale = reference_gain * response_per_volt
        self._reference_power = excitation.averages * reference_gain**2

    def estimate(
        self,
        reference_v: NDArray[np.float32],
        response_v: NDArray[np.float32],
        *,
        range_v: tuple[float, float],
    ) -> Estimate:
        """Estimate one Green's function per record.

        reference_v, response_v, float32 (records, samples): The two DAQ channels in volts, one sequential record per
            row.
        range_v: Largest input magnitude in volts on (reference, response), each > 0.

        Returns Estimate. Raises InputError: arrays of different or wrong shapes, or values that are not finite.
        ReferenceMissingError: a reference in which the sweeps cannot be found; the message names the record.
        """
        reference = np.ascontiguousarray(reference_v, dtype=np.float32)
        response = np.ascontiguousarray(response_v, dtype=np.float32)
        if reference.ndim != 2 or reference.shape != response.shape:
            raise InputError(
                f"reference and response have shapes {reference.shape} and {response.shape}; "
                "allowed is (records, samples) for both"
            )
        if not all(np.isfinite(end) and end > 0 for end in range_v):
            raise InputError(f"range_v is {range_v}; allowed are two finite numbers above 0")
        parts = [
            self._estimate(reference[low : low + self._batch], response[low : low + self._batch], range_v, low)
            for low in range(0, reference.shape[0], self._batch)
        ]
        if len(parts) == 1:
            return parts[0]
        if not parts:
            raise InputError("there are no records; allowed is at least one")
        return Estimate(**{name: np.concatenate([getattr(p, name) for p in parts]) for name in Estimate.__slots__})

    def _estimate(
        self,
        reference: NDArray[np.float32],
        response: NDArray[np.float32],
        range_v: tuple[float, float],
        first: int,
    ) -> Estimate:
        peaks = [find_peaks(channel) for channel in (reference, response)]
        if not all(np.isfinite(peak_v).all() for peak_v, _ in peaks):
            raise InputError("a recording holds values that are not finite; allowed are volts")
        repeats = self._finder.find(reference, first)
        x = repeats.spectra
        y = self._finder.segment_spectra(response, repeats.starts)
        reference_power = _energy(x).sum(axis=1)
        transfer = (x.conj() * y).sum(axis=1) / np.maximum(reference_power, np.float32(FLOOR))
        found = self._fit.solve(transfer * self._in_time, repeats.ratio - 1)
        here = self._in_band
        answered = _energy(y[..., here]).sum(axis=(1, 2), dtype=np.float64)
        differing, differing_power = self._differing(x, y, transfer)
        missed = found.missed * self._in_time.conj()
        outside = _energy(missed) * reference_power + (0 if differing_power is None else differing_power)
        outside[:, here] = 0
        if differing is not None and differing_power is not None:
            differing, differing_power = differing[..., here], differing_power[:, here]
        coherence, repeat_db = self._repeatability(answered, differing_power)
        whole = _energy(transfer[:, here] * self._weight).sum(axis=1, dtype=np.float64)
        left = _energy(found.whitened[:, here]).sum(axis=1, dtype=np.float64)
        variance = left / max(self._share * (self._fit.elements - self._fit.rank), 1.0)
        noise = variance * self._share * self._fit.elements
        gain = reference_power.sum(axis=1, dtype=np.float64) / self._finder.power.sum()
        return Estimate(
            green=found.green * np.float32(self._scale),
            snr_db=decibel(np.maximum(whole - noise, 0), noise),
            residual_db=decibel(left, whole),
            coherence=coherence,
            peak_v=peaks[1][0],
            repeat_db=repeat_db,
            noise_v=np.sqrt(variance * gain * self._finder.median_power).astype(np.float32),
            clip_count=count_clipped(reference, *peaks[0], range_v[0]) + count_clipped(response, *peaks[1], range_v[1]),
            offset_samples=repeats.offset_samples,
            clock_ratio=repeats.ratio,
            defects=self._defects.find(
                response_v=response,
                loudest=peaks[1][1],
                peak_v=peaks[1][0],
                reference=x[..., here],
                reference_power=reference_power[:, here],
                answered_energy=answered,
                differing=differing,
                differing_power=differing_power,
                transfer=transfer[:, here],
                missed=missed[:, here],
                whitened=found.whitened[:, here],
                outside=outside,
                first_outside=self._finder.bins.start,
            ),
            reference_db=decibel(gain, np.full_like(gain, self._reference_power)),
        )

    def _differing(
        self, x: NDArray[np.complex64], y: NDArray[np.complex64], transfer: NDArray[np.complex64]
    ) -> tuple[NDArray[np.complex64] | None, NDArray[np.float32] | None]:
        """What one relation to the reference leaves of each sweep, and its energy; None for a single sweep."""
        if x.shape[1] == 1:
            return None, None
        differing = y - transfer[:, None] * x
        return differing, _energy(differing).sum(axis=1)

    def _repeatability(
        self, whole: NDArray[np.float64], differing_power: NDArray[np.float32] | None
    ) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        if differing_power is None:
            unknown = np.full(whole.shape, np.nan, dtype=np.float32)
            return unknown, unknown.copy()
        averages = self.excitation.averages
        differing = differing_power.sum(axis=1, dtype=np.float64)
        coherence = 1 - (differing + FLOOR) / (whole + FLOOR)
        return coherence.astype(np.float32), decibel(differing * averages / (averages - 1), whole)


def _fit_for(
    omega: NDArray[np.float64], power: NDArray[np.float64], period: int, taps: int, ridge: float
) -> CausalFit | ToeplitzFit:
    if 2 * omega.size * taps <= DENSE_ELEMENTS:
        return CausalFit(omega, power, period, taps, ridge, MAX_PPM)
    return ToeplitzFit(omega, power, period, taps, ridge)


def _energy(spectra: NDArray[np.complex64]) -> NDArray[np.float32]:
    return np.square(spectra.real) + np.square(spectra.imag)


def decibel(part: NDArray[np.float64], whole: NDArray[np.float64]) -> NDArray[np.float32]:
    """Energy `part` over energy `whole` in dB; 0 dB where both are zero."""
    return (10 * np.log10((part + FLOOR) / (whole + FLOOR))).astype(np.float32)
