"""Green's functions from whole records of any excitation: hammer hits, noise, sweeps of any law, once or repeated."""

from collections.abc import Callable, Sequence

import numpy as np
import scipy.fft

from wavefocus.calibration import Complex128Array, Float32Array, Float64Array
from wavefocus.calibration.estimator.causal_fit import MAX_RIDGE, RIDGE, circulant_inverse, conjugate_gradients
from wavefocus.calibration.estimator.defect_finder import measure_levels, not_looked_at
from wavefocus.calibration.estimator.estimate import FLOOR, Estimate, Records, decibel
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.calibration.resampling import resampled
from wavefocus.storage.errors import InputError

# Penalty outside of the band, as `RIDGE`.
OUTSIDE_RIDGE = 1e-5
# What was already sounding when a record starts leaves so much more, per sample, in its first taps than later.
RUNNING = 2.0
# A hit or a sweep within those first samples, many times as loud as what follows, is kept.
LOUDER = 10.0
# Samples beyond those taps that such a record must have, over the taps that are looked for.
MIN_SHARE = 1.2


class WholeRecordEstimator:
    """Least squares in time: each record's response is its own reference, convolved with the FIRs that it drives.

    Nothing is asked of the excitation but that it fills the band. A record may begin in silence or in the midst of
    the signal; then its first samples, which answer to what came before it, are left out. Records that drive the
    same slots are fitted together, so that each counts by its energy. Conjugate gradients and transforms, no
    matrix. Safe to call from several threads.

    records: What plays when, not periodic.
    clock_ratio: DAQ rate over playback rate of a reference channel (samples,) in volts, and where it begins in samples;
        both channels are then resampled to the playback clock. Without it one clock played and recorded.

    Raises InputError: a periodic schedule.
    """

    def __init__(
        self, records: Records, *, clock_ratio: Callable[[Float32Array], tuple[float, float]] | None = None
    ) -> None:
        if records.schedule.period_s > 0:
            raise InputError("period_s is above 0; records that begin and end by themselves are needed")
        self._records, self._clock_ratio = records, clock_ratio
        groups: dict[bytes, list[int]] = {}
        for record in range(records.schedule.records):
            groups.setdefault(b"".join(part.tobytes() for part in records.schedule.slots(record)), []).append(record)
        self._groups = list(groups.values())

    def estimate(
        self, reference_v: Float32Array, response_v: Float32Array, *, range_v: tuple[float, float]
    ) -> Estimate:
        """See `wavefocus.calibration.estimator.estimate.PositionEstimator`; what compares sweeps is NaN."""
        self._records.require(reference_v, response_v)
        found = [self._estimate(reference_v[group], response_v[group], range_v, group) for group in self._groups]
        return self._records.by_actuator(found, [group[0] for group in self._groups])

    def _estimate(
        self, reference_v: Float32Array, response_v: Float32Array, range_v: tuple[float, float], group: Sequence[int]
    ) -> Estimate:
        levels = measure_levels(reference_v, response_v, range_v)
        for record, peak_v in zip(group, levels.reference_v, strict=True):
            if peak_v == 0:
                raise ReferenceMissingError(f"the reference of record {record} is silent", "silence")
        clocks = [(1.0, 0.0)] * len(group) if self._clock_ratio is None else list(map(self._clock_ratio, reference_v))
        references, responses = (
            [self._played(row, ratio) for row, (ratio, _) in zip(channel, clocks, strict=True)]
            for channel in (reference_v, response_v)
        )
        green, shares, whole, left, noise, noise_v = _Fit(references, responses, self._records, group[0]).solve()
        channels = self._records.channels
        return Estimate.of_slots(
            (green * (channels.reference_gain * channels.response_per_volt)).astype(np.float32),
            decibel(np.maximum(whole - noise, 0) * shares, noise),
            defects=not_looked_at(len(green)),
            reference_db=np.nan,
            residual_db=float(decibel(left, whole)),
            coherence=np.nan,
            peak_v=float(levels.response_v.max()),
            noise_v=noise_v,
            clip_count=int(levels.clip_count.sum()),
            offset_samples=clocks[0][1],
            clock_ratio=clocks[0][0],
        )

    @staticmethod
    def _played(channel_v: Float32Array, ratio: float) -> Float64Array:
        """A channel on the playback clock, without its constant voltage."""
        channel = channel_v.astype(np.float64)
        if ratio != 1:
            channel = resampled(channel[None], 0.0, ratio, int(channel.size / ratio))[0]
        return np.asarray(channel - channel.mean())


class _Fit:
    """The normal equations of records that drive the same slots, those of record `first`."""

    def __init__(
        self, references: Sequence[Float64Array], responses: Sequence[Float64Array], records: Records, first: int
    ) -> None:
        rate_hz, band_hz, taps = records.sample_rate_hz, records.band_hz, records.taps
        _, delay_s, gain = records.schedule.slots(first)
        self._taps, self._gain = taps, gain
        self._samples = [reference.size for reference in references]
        self._lead = int(np.ceil(delay_s.max() * rate_hz)) + taps
        self._length = scipy.fft.next_fast_len(max(self._samples) + self._lead, real=True)
        hertz = scipy.fft.rfftfreq(self._length, 1 / rate_hz)
        self._in_band = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
        self._band_share = (band_hz[1] - band_hz[0]) / (rate_hz / 2)
        # A response that is sampled late shows each event at an earlier sample.
        self._slots = gain[:, None] * np.exp(
            -2j * np.pi * hertz * (delay_s[:, None] - records.channels.inter_channel_delay_s)
        )
        self._spectra = [scipy.fft.rfft(reference, self._length) for reference in references]
        self._references, self._responses = references, responses
        power = sum(np.square(np.abs(spectrum)) for spectrum in self._spectra) * np.square(gain).mean()
        self._median = float(np.median(power[self._in_band])) if self._in_band.any() else 0.0
        if not self._median > 0:
            raise ReferenceMissingError("the reference is silent in band_hz", "silence")
        kernel = scipy.fft.irfft(power, self._length)[:taps]
        self._ring = scipy.fft.next_fast_len(2 * taps, real=True)
        ring = scipy.fft.rfftfreq(self._ring, 1 / rate_hz)
        self._outside = np.where((ring >= band_hz[0]) & (ring <= band_hz[1]), 0.0, OUTSIDE_RIDGE * self._median)
        penalty = scipy.fft.irfft(self._outside, self._ring)[:taps]
        self._kernel = kernel + penalty

    def solve(self) -> tuple[Float64Array, Float64Array, float, float, float, float]:
        """The FIRs (slots, taps); what was already running when the records start is left out if there is such.

        Also each one's share of the energy, and energies in band: of the responses, of what is left of them, and of the
        noise in it; the rms of white noise in volts.
        """
        first = 0
        green, left = self._solved(first)
        if self._may_run():
            lead, rest = self._lead, sum(residual.size - self._lead for residual in left)
            early = sum(self._energy(residual[:lead]) for residual in left) / (lead * len(left))
            later = sum(self._energy(residual[lead:]) for residual in left) / rest
            if early > RUNNING * later:
                first = self._lead
                green, left = self._solved(first)
        whole = sum(self._energy(response[first:]) for response in self._responses)
        unexplained = sum(self._energy(residual[first:]) for residual in left)
        rows = sum(samples - first for samples in self._samples) * self._band_share
        noise = unexplained * rows / self._free(first)
        each = np.array([np.square(row).sum() for row in green * self._gain[:, None]]) + FLOOR
        noise_v = np.sqrt(unexplained / self._free(first))
        return green, each / each.sum(), whole, unexplained, noise, float(noise_v)

    def _may_run(self) -> bool:
        """Whether the references go on after their first samples, and are long enough to leave those out."""
        lead, rest = self._lead, sum(samples - self._lead for samples in self._samples)
        if min(self._samples) <= 2 * lead or rest <= MIN_SHARE * self._taps * len(self._gain):
            return False
        begin = sum(float(np.square(reference[:lead]).sum()) for reference in self._references) / lead
        later = sum(float(np.square(reference[lead:]).sum()) for reference in self._references) / rest
        return begin < LOUDER * later * len(self._samples)

    def _free(self, first: int) -> float:
        """Directions in band that the taps leave free."""
        rows = sum(samples - first for samples in self._samples) - len(self._gain) * self._taps
        return float(max(rows * self._band_share, 1.0))

    def _solved(self, first: int) -> tuple[Float64Array, list[Float64Array]]:
        """FIRs (slots, taps), and what they leave of each record, from sample `first` on."""
        wanted = self._seen([response if not first else _silenced(response, first) for response in self._responses])
        green, ridge = np.zeros_like(wanted), RIDGE * self._median
        left: list[Float64Array] = []
        for _ in range(2):
            inverse = circulant_inverse(self._kernel, ridge)
            green = conjugate_gradients(lambda taps: self._gram(taps, first), wanted, ridge, inverse, green)
            left = [response - shown for response, shown in zip(self._responses, self._shown(green), strict=True)]
            variance = sum(self._energy(residual[first:]) for residual in left) / self._free(first)
            energy = float(np.square(green).mean())
            likely = min(max(variance / energy, ridge), MAX_RIDGE * self._median) if energy > 0 else ridge
            if likely <= 2 * ridge:
                break
            ridge = likely
        return green, left

    def _gram(self, green: Float64Array, first: int) -> Float64Array:
        outside = scipy.fft.irfft(scipy.fft.rfft(green, self._ring) * self._outside, self._ring)[:, : self._taps]
        return np.asarray(self._seen([_silenced(response, first) for response in self._shown(green)]) + outside)

    def _shown(self, green: Float64Array) -> list[Float64Array]:
        """Responses that FIRs (slots, taps) make."""
        spectrum = (scipy.fft.rfft(green, self._length) * self._slots).sum(axis=0)
        return [
            scipy.fft.irfft(reference * spectrum, self._length)[:samples]
            for reference, samples in zip(self._spectra, self._samples, strict=True)
        ]

    def _seen(self, responses: Sequence[Float64Array]) -> Float64Array:
        """What responses say of each tap: the adjoint of `_shown`."""
        total: Complex128Array = np.zeros(self._length // 2 + 1, dtype=np.complex128)
        for response, reference in zip(responses, self._spectra, strict=True):
            total += scipy.fft.rfft(response, self._length) * reference.conj()
        return np.asarray(scipy.fft.irfft(total * self._slots.conj(), self._length)[:, : self._taps])

    def _energy(self, signal: Float64Array) -> float:
        """Energy in band."""
        spectrum = scipy.fft.rfft(signal, self._length)[self._in_band]
        return float(2 * np.square(np.abs(spectrum)).sum() / self._length)


def _silenced(signal: Float64Array, first: int) -> Float64Array:
    """A signal without what comes before sample `first`."""
    kept = signal.copy()
    kept[:first] = 0
    return kept
