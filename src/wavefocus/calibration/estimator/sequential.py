"""From sequential records, sweeps with silence after each, to Green's functions and figures of their quality."""

from dataclasses import replace

import numpy as np

from wavefocus.calibration import Float32Array
from wavefocus.calibration.clock.repeats import SweepCutter
from wavefocus.calibration.estimator.causal_fit import RIDGE, CausalFit, ToeplitzFit
from wavefocus.calibration.estimator.clipping import measure_levels
from wavefocus.calibration.estimator.defect_finder import DefectFinder, Residuals, energy
from wavefocus.calibration.estimator.estimate import DIRECT, EDGE, FLOOR, MAX_PPM, Channels, Estimate, decibel
from wavefocus.calibration.excitation import Excitation
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.header import Schedule

# Bounds memory to about 20 MB however many records are given, and to a tenth of a GB however long they are.
BATCH_RECORDS = 32
BATCH_VALUES = 1 << 19
# Elements of a matrix that is decomposed and kept: 64 MiB in float64. What is larger is solved without one.
DENSE_ELEMENTS = 1 << 23


class SequentialEstimator:
    """Averaged H1 from the recorded reference, then least squares for a causal FIR of L taps.

    Everything that is computed once depends only on the configuration, so that the same recordings give the
    same bytes in whatever order they come. Safe to call from several threads.

    excitation: What each record plays.
    taps: Length L of the FIRs, 1 to the excitation's silence.
    channels: How the channels see it.
    schedule: Which actuator in which record, sequential; without it record k is that of actuator k.
    comparable: Whether the coherence of the repeats means something; else it is NaN.

    Raises InputError: a value outside the range above.
    """

    def __init__(
        self,
        excitation: Excitation,
        taps: int,
        channels: Channels = DIRECT,
        *,
        schedule: Schedule | None = None,
        comparable: bool = True,
    ) -> None:
        if not 1 <= taps <= excitation.decay_samples:
            raise InputError(
                f"taps is {taps}; allowed is 1 to the silence after each sweep, {excitation.decay_samples} samples"
            )
        if abs(channels.inter_channel_delay_s) * excitation.sample_rate_hz > excitation.decay_samples:
            raise InputError(
                f"inter_channel_delay_s is {channels.inter_channel_delay_s:g}; allowed is at most decay_s either way"
            )
        self.excitation, self.taps = excitation, taps
        self._schedule, self._comparable = schedule, comparable
        self._cutter = SweepCutter(excitation, excitation.decay_samples - taps, MAX_PPM)
        omega, period = self._cutter.omega, self._cutter.period
        relative = self._cutter.power / self._cutter.median_power
        self._fit = (
            CausalFit(omega, relative, period, taps, RIDGE, MAX_PPM)
            if 2 * omega.size * taps <= DENSE_ELEMENTS
            else ToeplitzFit(omega, relative, period, taps, RIDGE)
        )
        self._batch = int(min(max(BATCH_VALUES // (excitation.averages * omega.size), 1), BATCH_RECORDS))
        # The sweep's fades reach beyond its band; what hums there does the Green's function no harm.
        hertz = omega * excitation.sample_rate_hz / (2 * np.pi)
        low, high = np.searchsorted(hertz, [excitation.start_hz * (1 - EDGE), excitation.stop_hz * (1 + EDGE)])
        self._in_band = slice(int(low), int(high)) if high - low > hertz.size // 2 else slice(0, hertz.size)
        self._share = (self._in_band.stop - self._in_band.start) / hertz.size
        self._weight = np.sqrt(2 * relative / period).astype(np.float32)[self._in_band]
        self._defects = DefectFinder(
            self._in_band,
            self._cutter.bins.start,
            period,
            excitation.averages,
            excitation.sample_rate_hz,
            taps,
            freedom=1 - self._fit.rank / self._fit.elements,
            is_swept=self._cutter.is_swept,
        )
        late = channels.inter_channel_delay_s * excitation.sample_rate_hz
        self._in_time = np.exp(-1j * omega * late).astype(np.complex64)
        self._scale = channels.reference_gain * channels.response_per_volt
        self._reference_power = excitation.averages * channels.reference_gain**2

    def estimate(
        self, reference_v: Float32Array, response_v: Float32Array, *, range_v: tuple[float, float]
    ) -> Estimate:
        """See `wavefocus.calibration.estimator.estimate.PositionEstimator`; if no schedule, any number of records."""
        reference = np.ascontiguousarray(reference_v, dtype=np.float32)
        response = np.ascontiguousarray(response_v, dtype=np.float32)
        records = len(reference) if self._schedule is None else self._schedule.records
        if reference.ndim != 2 or reference.shape != response.shape or len(reference) != records or not records:
            raise InputError(
                f"reference and response have shapes {reference.shape} and {response.shape}; "
                f"allowed is ({records if self._schedule else 'records'}, samples) for both"
            )
        if not all(np.isfinite(end) and end > 0 for end in range_v):
            raise InputError(f"range_v is {range_v}; allowed are two finite numbers above 0")
        parts = [
            self._estimate(reference[low : low + self._batch], response[low : low + self._batch], range_v, low)
            for low in range(0, records, self._batch)
        ]
        found = parts[0] if len(parts) == 1 else Estimate.joined(parts)
        if not self._comparable:
            found = replace(found, coherence=np.full_like(found.coherence, np.nan))
        if self._schedule is None:
            return found
        slots = [self._schedule.slots(record) for record in range(records)]
        gain = np.array([slot[2][0] for slot in slots], dtype=np.float32)
        return replace(found, green=found.green / gain[:, None]).by_actuator(
            np.concatenate([slot[0] for slot in slots]), gain
        )

    def _estimate(
        self, reference: Float32Array, response: Float32Array, range_v: tuple[float, float], first: int
    ) -> Estimate:
        levels = measure_levels(reference, response, range_v)
        repeats = self._cutter.cut(reference, first)
        x = repeats.spectra
        y = self._cutter.spectra(response, repeats.starts)
        reference_power = energy(x).sum(axis=1)
        transfer = (x.conj() * y).sum(axis=1) / np.maximum(reference_power, np.float32(FLOOR))
        found = self._fit.solve(transfer * self._in_time, repeats.ratio - 1)
        here = self._in_band
        answered = energy(y[..., here]).sum(axis=(1, 2), dtype=np.float64)
        # What one relation to the reference leaves of each sweep.
        differing = y - transfer[:, None] * x
        coherence = np.full(answered.shape, np.nan, np.float32)
        if self.excitation.averages > 1:
            apart = energy(differing[..., here]).sum(axis=(1, 2), dtype=np.float64)
            coherence = (1 - (apart + FLOOR) / (answered + FLOOR)).astype(np.float32)
        whole = energy(transfer[:, here] * self._weight).sum(axis=1, dtype=np.float64)
        left = energy(found.whitened[:, here]).sum(axis=1, dtype=np.float64)
        variance = left / max(self._share * (self._fit.elements - self._fit.rank), 1.0)
        noise = variance * self._share * self._fit.elements
        gain = reference_power.sum(axis=1, dtype=np.float64) / self._cutter.power.sum()
        residual_db = decibel(left, whole)
        noise_v = np.sqrt(variance * gain * self._cutter.median_power)
        missed = found.missed * self._in_time.conj()
        defects = self._defects.find(Residuals(response, levels, answered, x, differing, missed))
        defects["slip_db"] = repeats.residual_db
        return Estimate(
            green=found.green * np.float32(self._scale),
            snr_db=decibel(np.maximum(whole - noise, 0), noise),
            residual_db=residual_db,
            coherence=coherence,
            peak_v=levels.response_v,
            noise_v=noise_v.astype(np.float32),
            clip_count=levels.clip_count,
            offset_samples=repeats.offset_samples,
            clock_ratio=repeats.ratio,
            defects=defects,
            reference_db=decibel(gain, self._reference_power),
        )
