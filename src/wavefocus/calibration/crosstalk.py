"""Crosstalk: the share of the loopback voltage that leaks into the response input, from a record or from rows.

A leak adds the same early pulse to every row, whatever its position and actuator. From the rows X (pairs, columns) of
all far pairs, c is taken out so that

    X - c 1 e^T,    e the pulse of a leak of share 1 in the band,

is left with the least energy beyond its first few singular values. Those hold the waves, so they must be few: on gels
in the taps before waves arrive, where only what the band lets begin too soon is left; on glass, whose bending waves
have no front, in the whole band, where few modes lie or few functions of the distance. Of both the surer one counts.
"""

from __future__ import annotations

import json
import math
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from wavefocus.calibration import BoolArray, Float64Array, Int64Array
from wavefocus.calibration.numerics import eigenvalue_rises
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.storage.bank.reading import Bank  # texts of the remedy need no files

NAMED_SHARE = 0.6e-4
"""A leak from here on is named: below the -80 dB that must be, by what rows on glass can be off."""
SIGMAS = 6.0
"""And it is so many times its standard error."""
MAX_DELAY_S = 0.01
"""Longest delay looked for in a record."""
REMEDY = (
    "put a grounded channel between the two inputs in the converter's scan list, lower the source impedance or the "
    "conversion clock; keep the vibrometer's cable away from amplifiers, coils and magnets, and ground it once"
)
EARLY_RANKS, WHOLE_RANKS = (3, 4), (6, 8)
"""Singular values that waves may take up, in early taps and in the band; both numbers must show the leak."""
FAR_SHARE = 0.5
"""Pairs count that are farther apart than this share of the widest."""
MIN_PAIRS = 30
"""Fewer far pairs judge nothing."""
ROWS_SHARE, SURE_PAIRS = 0.7e-4, 120
"""Rows name a leak from this share on where so many far pairs show it; with fewer, waves can imitate larger ones: the
share grows with the square of the pairs that lack. On a stadium of gel, clean rows 4 mm apart were seen to show 0.63e-4
with 140 pairs, 1.4e-4 with 84."""
SHARED = 0.4
"""Part of a leak seen in early taps that the whole band must show: it showed 1.2 to 1.9 times where there was one, and
less than 0.1 times where waves imitated one."""
PAIRS_OF_ONE = 60
"""Far pairs of one actuator that are judged by themselves."""
MAX_POSITIONS = 400
"""So many positions, spread over all, are enough."""
WHOLE_PERIODS = 50.0
"""Taps that are transformed, in periods of the band's upper end."""
ROW_DELAYS = (0.0, 0.05, 0.1, 0.2, 0.3, 0.5)
"""Delays looked for in rows, in those periods: later, a leak cannot be distinguished from a wave."""
RELATIVE = 50.0
"""Where the response input's sensitivity is unknown, 1e-4 stands for -46 dB of the median row."""
MAX_ROW = 1e9
"""Values beyond, in V per V, are not rows."""
SHARES = np.geomspace(1e-6, 1.0, 31)
"""Magnitudes tried first."""


@dataclass(frozen=True, slots=True)
class Crosstalk:
    """A leak of the loopback into the response input.

    share: Volts at the response input per volt of the loopback; negative where it is upside down.
    delay_s: How much later it comes than the loopback's voltage.
    error: Standard error of the share.
    actuators: Whose rows show it, where not all do: in a staggered campaign those that sound undelayed.
    is_relative: Whether the share is relative to the rows, the sensitivity of the response input being unknown.
    least_share: Smallest share that is named.
    """

    share: float
    delay_s: float
    error: float
    actuators: tuple[int, ...] = ()
    is_relative: bool = False
    least_share: float = NAMED_SHARE

    @property
    def level_db(self) -> float:
        """Level re the loopback in dB."""
        return 20 * math.log10(max(abs(self.share), 1e-12))

    @property
    def sigmas(self) -> float:
        """The share in standard errors."""
        return abs(self.share) / max(self.error, 1e-300)

    @property
    def is_named(self) -> bool:
        """Whether it is large and sure enough to be named."""
        return abs(self.share) >= self.least_share and self.sigmas >= SIGMAS

    @property
    def is_resolved(self) -> bool:
        """Whether a leak that must be named would have been: the measurement was quiet enough."""
        return SIGMAS * self.error <= self.least_share

    @property
    def visible_db(self) -> float:
        """Smallest level that would have been named, in dB re the loopback."""
        return 20 * math.log10(max(self.least_share, SIGMAS * self.error))

    @property
    def rows(self) -> str:
        """Which rows show it, in words."""
        named = ", ".join(map(str, self.actuators))
        return f"the rows of actuators {named}" if self.actuators else "all rows"

    def __str__(self) -> str:
        return f"{self.in_words(self.level_db)}, {1e6 * self.delay_s:.0f} us late"

    def in_words(self, level_db: float) -> str:
        """A level with its reference."""
        if self.is_relative:
            return f"{level_db + 20 * math.log10(RELATIVE):.0f} dB of the median row"
        return f"{level_db:.1f} dB re the loopback"


def crosstalk_of_record(
    reference_v: ArrayLike,
    response_v: ArrayLike,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    *,
    reference_gain: float = 1.0,
    inter_channel_delay_s: float = 0.0,
) -> Crosstalk:
    """Measure the leak in a record in which no response is expected: only the loopback plays, or no light comes back.

    reference_v, response_v, (samples,): The two channels in volts.
    band_hz: Lowest and highest frequency of what was played.
    reference_gain: Volts at the reference input per volt of the loopback.
    inter_channel_delay_s: How much later the response input is sampled.
    """
    reference, response = (np.asarray(channel, dtype=np.float64) for channel in (reference_v, response_v))
    size = 1 << math.ceil(math.log2(reference.size + MAX_DELAY_S * sample_rate_hz))
    hertz = np.fft.rfftfreq(size, 1 / sample_rate_hz)
    inside = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
    known, heard = (np.fft.rfft(channel, size)[inside] for channel in (reference, response))
    energy = float(np.sum(np.abs(known) ** 2))
    if energy == 0.0:
        return Crosstalk(0.0, 0.0, math.inf)
    cross = np.conj(known) * heard / energy
    angular = 2 * np.pi * hertz[inside]

    def share_at(late_s: Float64Array) -> Float64Array:
        return np.asarray((np.exp(1j * np.outer(late_s, angular)) @ cross).real)

    step_s = 1 / (16 * band_hz[1])
    late_s = np.arange(-4 * step_s, MAX_DELAY_S, step_s)
    for finer in (16, 16):
        best = float(late_s[np.argmax(np.abs(share_at(late_s)))])
        late_s = best + np.linspace(-step_s, step_s, 2 * finer + 1)
        step_s /= finer
    best = float(late_s[np.argmax(np.abs(share_at(late_s)))])
    share = float(share_at(np.array([best]))[0])
    left = heard - share * np.exp(-1j * angular * best) * known
    error = math.sqrt(float(np.mean(np.abs(left) ** 2)) / (2 * energy))
    return Crosstalk(share * reference_gain, best + inter_channel_delay_s, error * reference_gain)


def taps_needed(sample_rate_hz: float, band_hz: tuple[float, float]) -> int:
    """How many taps of each row are looked at."""
    return math.ceil(WHOLE_PERIODS * sample_rate_hz / band_hz[1])


def spread_positions(positions: Int64Array) -> Int64Array:
    """Those of some positions that are looked at: evenly spread, `MAX_POSITIONS` at most."""
    step = max(1, math.ceil(len(positions) / MAX_POSITIONS))
    return positions[::step]


def crosstalk_of_rows(
    green: NDArray[np.floating],
    position_mm: Float64Array,
    actuator_mm: Float64Array,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    response_per_volt: float,
) -> Crosstalk | None:
    """Measure the leak in the rows of a bank.

    green, (positions, actuators, taps): Rows, or their first `taps_needed`.
    position_mm, float64 (positions, 2): Where they were measured.
    actuator_mm, float64 (actuators, 2): Where the actuators are; those that are NaN are left out.
    sample_rate_hz, band_hz: Of the bank.
    response_per_volt: Unit of the rows per volt at the response input.

    Returns None where too few pairs are far apart, or the taps are too few.
    """
    bench = _Bench(sample_rate_hz, band_hz, green.shape[2])
    if green.shape[2] < 2 * bench.period or band_hz[1] > 0.45 * sample_rate_hz:
        return None
    far = far_pairs(position_mm, actuator_mm) & np.any(green != 0, axis=2)
    with np.errstate(over="ignore", divide="ignore", invalid="ignore"):
        green = np.asarray(green, dtype=np.float64) / response_per_volt
    pairs = int(np.count_nonzero(far))
    if pairs < MIN_PAIRS or not np.all(np.abs(green) < MAX_ROW):
        return None
    least = ROWS_SHARE * max(1.0, (SURE_PAIRS / pairs) ** 2)
    joint = replace(bench.measure(green[far], ROW_DELAYS), least_share=least)
    if joint.is_named or len(actuator_mm) == 1:
        return joint
    single = [
        (actuator, replace(bench.measure(green[far[:, actuator], actuator], ROW_DELAYS[:1]), least_share=least))
        for actuator in np.flatnonzero(far.sum(axis=0) >= PAIRS_OF_ONE).tolist()
    ]
    shown = [(actuator, leak) for actuator, leak in single if leak.is_named]
    if not shown:
        return joint
    _, loudest = max(shown, key=lambda pair: abs(pair[1].share))
    return replace(loudest, actuators=tuple(actuator for actuator, _ in shown))


def crosstalk_of_bank(bank: Bank, positions: Int64Array) -> Crosstalk | None:
    """Measure the leak in some positions of a bank; damaged rows are left out.

    Without the vibrometer's sensitivity the share is in units in which 1e-4 is -46 dB of the median row.
    Returns None where it cannot be measured, as `crosstalk_of_rows`, or the bank has no band.
    """
    if bank.band_hz is None:
        return None
    taps = taps_needed(bank.sample_rate_hz, bank.band_hz)
    rows, kept = [], []
    for position in spread_positions(positions).tolist():
        with suppress(InputError):
            rows.append(np.asarray(bank.green(position)[:, :taps], dtype=np.float64))
            kept.append(position)
    if not rows:
        return None
    green, per_volt = np.stack(rows), response_per_volt(bank.rig_json)
    if known := per_volt is not None:
        scale = per_volt
    else:
        peak = float(np.max(np.abs(green))) or 1.0  # a norm of huge values would not be finite
        scale = RELATIVE * peak * float(np.median(np.linalg.norm(green / peak, axis=2)))
    found = crosstalk_of_rows(
        green, bank.position_mm[kept], bank.actuator_mm, bank.sample_rate_hz, bank.band_hz, scale or 1.0
    )
    return found if found is None or known else replace(found, is_relative=True)


def response_per_volt(rig_json: str | None) -> float | None:
    """The vibrometer's sensitivity as a bank's rig has it; None where it was asked of the instrument, or is unknown."""
    try:
        sensitivity = json.loads(rig_json or "{}")["vibrometer"]["sensitivity_m_s_per_v"]
        return float(sensitivity) if float(sensitivity) > 0 else None
    except (KeyError, TypeError, ValueError, RecursionError):
        return None


def far_pairs(position_mm: Float64Array, actuator_mm: Float64Array) -> BoolArray:
    """Pairs that count, bool (positions, actuators)."""
    distance_mm = np.hypot(*(position_mm[:, None] - actuator_mm[None]).transpose(2, 0, 1))
    known_mm = distance_mm[np.isfinite(distance_mm)]
    return np.asarray(distance_mm >= FAR_SHARE * known_mm.max(initial=0.0))


class _Bench:
    """Measures leaks in rows of one rate, band and length."""

    def __init__(self, sample_rate_hz: float, band_hz: tuple[float, float], taps: int) -> None:
        self._rate_hz, self._band_hz = sample_rate_hz, band_hz
        self.period = math.ceil(sample_rate_hz / band_hz[1])
        self._whole = min(taps, taps_needed(sample_rate_hz, band_hz))
        self._taper = np.cos(0.5 * np.pi * np.arange(self._whole) / self._whole) ** 2
        hertz = np.fft.rfftfreq(self._whole, 1 / sample_rate_hz)
        self._inside = (hertz >= 1.3 * band_hz[0]) & (hertz <= 0.95 * band_hz[1])

    def measure(self, rows: NDArray[np.floating], delays: tuple[float, ...]) -> Crosstalk:
        """The leak that early taps or the whole band show, whichever is surer; rows (pairs, taps) in V per V."""
        early = [self._early(rows, late) for late in delays]
        spectra = _Moments(self._in_band(rows))
        whole = [self._fitted(spectra, self._in_band(self._pulse(late)), WHOLE_RANKS, late) for late in delays]
        first, all_of_it = (max(some, key=lambda pair: pair[0])[1] for some in (early, whole))
        if all_of_it.error < first.error:
            return all_of_it
        # A leak is in the whole band, too; what is in the early taps only is the beginning of a wave.
        contradicted = all_of_it.share * np.sign(first.share) < SHARED * abs(first.share)
        if contradicted and abs(first.share) >= 0.5 * NAMED_SHARE:
            return replace(first, error=max(first.error, 0.5 * abs(first.share - all_of_it.share)))
        return first

    def _early(self, rows: NDArray[np.floating], late: float) -> tuple[float, Crosstalk]:
        taps = math.ceil((1 + late) * self.period)
        moments = _Moments(np.asarray(rows[:, :taps], dtype=np.float64))
        return self._fitted(moments, self._pulse(late)[:taps], EARLY_RANKS, late)

    def _fitted(
        self, moments: _Moments, pulse: Float64Array, ranks: tuple[int, int], late: float
    ) -> tuple[float, Crosstalk]:
        """By how much the removal of the best share lowers what is left, and that share."""
        shares, errors, gains = moments.fit(pulse, ranks)
        share = float(shares[np.argmin(np.abs(shares))])
        error = math.hypot(float(errors.max()), float(np.ptp(shares)) / 2)
        return float(gains.min()), Crosstalk(share, late / self._band_hz[1], error)

    def _in_band(self, rows: NDArray[np.floating]) -> Float64Array:
        """Real and imaginary parts of spectra of the first taps, tapered."""
        spectra = np.fft.rfft(rows[..., : self._whole] * self._taper)[..., self._inside]
        return np.concatenate([spectra.real, spectra.imag], axis=-1)

    def _pulse(self, late: float) -> Float64Array:
        """The FIR of a leak of share 1, as long as the rows that are looked at."""
        pulse = np.zeros(self._whole)
        known = _known_pulse(self._rate_hz, self._band_hz, min(8 * self.period, self._whole), late)
        pulse[: known.size] = known
        return pulse


@lru_cache(maxsize=2 * len(ROW_DELAYS))
def _known_pulse(rate_hz: float, band_hz: tuple[float, float], length: int, late: float) -> Float64Array:
    """The causal FIR of least energy that is a delay in the band: what the estimator makes of a leak of share 1."""
    angular = 2 * np.pi * np.linspace(*band_hz, 2 * length)
    basis = np.exp(-1j * np.outer(angular, np.arange(length) / rate_hz))
    gram = (basis.conj().T @ basis).real
    gram[np.diag_indices(length)] += 1e-6 * len(angular)
    wanted = np.exp(-1j * angular * late / band_hz[1])
    return np.asarray(np.linalg.solve(gram, (basis.conj().T @ wanted).real))


class _Moments:
    """Second moments of rows (pairs, columns): of their distances from the mean row, by its axes, and of the mean."""

    def __init__(self, rows: Float64Array) -> None:
        self._pairs, self._columns = rows.shape
        self._mean = rows.mean(axis=0)
        around = rows - self._mean
        self._spread, self._axes = np.linalg.eigh(around.T @ around)

    def fit(self, pulse: Float64Array, ranks: tuple[int, int]) -> tuple[Float64Array, Float64Array, Float64Array]:
        """For each rank: the best share, its standard error, and by how much (ln) its removal lowers what is left."""
        coarse = np.concatenate([-SHARES[::-1], [0.0], SHARES])
        left = self._left(coarse, pulse, ranks)
        found = [self._refined(coarse, left[:, number], pulse, rank) for number, rank in enumerate(ranks)]
        shares, errors, gains = np.array(found).T
        return shares, errors, gains

    def _refined(
        self, shares: Float64Array, left: Float64Array, pulse: Float64Array, rank: int
    ) -> tuple[float, float, float]:
        for _ in range(3):
            least = int(np.argmin(left))
            shares = np.linspace(shares[max(least - 1, 0)], shares[min(least + 1, len(shares) - 1)], 13)
            left = self._left(shares, pulse, (rank,))[:, 0]
        best = float(shares[np.argmin(left)])
        aside = max(abs(best), 1e-5)
        below, at, above, none = self._left(np.array([best - aside, best, best + aside, 0.0]), pulse, (rank,))[:, 0]
        curvature = max((below + above - 2 * at) / (2 * aside**2), 1e-300)
        variance = at / max(self._pairs * (self._columns - rank) - 1, 1)
        return best, math.sqrt(variance / curvature), math.log(max(none, 1e-300) / max(at, 1e-300))

    def _left(self, shares: Float64Array, pulse: Float64Array, ranks: tuple[int, ...]) -> Float64Array:
        """Energy beyond the first singular values once each share of a pulse is taken out, (shares, ranks).

        A share of a pulse moves only the mean of the rows: the moments without the mean stay, and the mean's are added
        to them as one more direction.
        """
        most = max(ranks)
        squares = self._pairs * np.square((self._mean - shares[:, None] * pulse) @ self._axes)
        rises = eigenvalue_rises(self._spread, squares, most)
        energy = squares.sum(axis=1)
        left = [
            energy + self._spread[: self._columns - rank].sum() - rises[:, most - rank :].sum(axis=1) for rank in ranks
        ]
        return np.asarray(np.maximum(np.stack(left, axis=1), 0.0))
