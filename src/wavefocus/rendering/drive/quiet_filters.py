"""Filters of least drive energy that focus at one place and keep the response low at others.

At each frequency, with the row h (N,) of the focus, the rows q (R, N) of the quiet places and the filters w (N,) of the
actuators per unit of the signal, time reversal is w = h*, and its response at the focus a = h h*. Here

    minimise  sum S |w|^2   with  h w = a  at each frequency  and  sum S |q_k w|^2 <= E_k  for each place k,

sums being over the frequencies and S the power spectrum of the signal. The bounds are totals over the band, so that
there is one multiplier m_k for each place and not one for each frequency; the rows of a disc share its multiplier, and
so do all sources and instants of a scene. With A = I + q* diag(m) q:

    z = A^-1 h*,   d = h z,   w = z a / d.

With a response that may deviate, sum S |h w - b a|^2 <= e^2 sum S a^2 instead of h w = a, there is one more multiplier
k for all foci, and b keeps the amplitude of each focus:

    w = b z a / (k + d),   b = sum S a^2 / sum (S a^2 d / (k + d)).

Actuators that saturate (eq. 14) count as in time reversal: with s the diagonal of their factors, w -> s^(1/2) w,
h -> h s^(1/2) and q -> q s^(1/2), so that w is s h* where nothing is quiet.

References: Lagrange duality, S. Boyd and L. Vandenberghe, Convex Optimization, chapter 5; acoustic contrast control,
J.-W. Choi and Y.-H. Kim, J. Acoust. Soc. Am. 111 (2002) 1695.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from wavefocus.rendering.arrays import BoolArray, Complex128Array, Float64Array, Int64Array

STEPS = 60
TOLERANCE_DB = 0.02
RATE = 0.6
"""Exponent of the multiplicative step: a level falls with the first to second power of its multiplier."""
MAX_STEP = 1.5
MIN_MULTIPLIER, MAX_MULTIPLIER = 1e-6, 1e6
"""Bounds of a multiplier over the reciprocal of its place's mean power."""
CAP_STEPS = 12
"""Halvings of the range of multipliers, in decades, until the energy of the drives is met."""
SLACK_STEPS = 60
WORTH = 10**-0.1
"""Where the energy that is allowed lowers no place by 1 dB, none is spent."""
CUT_ROUNDS = 3
"""Times that levels are asked lower by what cutting the filters to their length costs."""
FAINT = 1e-9
"""Bins with less of the emitted power than this, relative to the largest, do not count."""
TINY = 1e-300


@dataclass(frozen=True, slots=True, eq=False)
class Focus:
    """The focus of one source at one instant, and the rows that it keeps quiet.

    row, complex128 (bins, actuators): Transfer functions from the actuators to the focus.
    quiet, complex128 (bins, rows, actuators): To the quiet places.
    place, int64 (rows,): The place of each row.
    sigma, float64 (actuators,): Saturation of eq. (14), > 0; None where all are 1.
    source: Its number.
    """

    row: Complex128Array
    quiet: Complex128Array
    place: Int64Array
    sigma: Float64Array | None = None
    source: int = 0


def of_rows(multiplier: Float64Array, place: Int64Array) -> Float64Array:
    """Multiplier of each row, (rows,): that of its place, shared by the place's rows."""
    return np.asarray(multiplier[place] / np.bincount(place, minlength=len(multiplier))[place])


class Steering:
    """The solutions z of foci with the same quiet rows and saturation, for any multipliers.

    What does not depend on the multipliers is computed once, and what does not depend on the focus once for all.
    """

    def __init__(self, foci: Sequence[Focus]) -> None:
        sigma, quiet = foci[0].sigma, foci[0].quiet
        self._root = np.ones(quiet.shape[2]) if sigma is None else np.sqrt(sigma)
        self._adjoint = np.stack([np.conj(focus.row * self._root) for focus in foci], axis=2)
        self._quiet = quiet if sigma is None else quiet * self._root
        rows, actuators = quiet.shape[1:]
        self._by_rows = rows < actuators
        self._across = self._quiet.conj().transpose(0, 2, 1)
        if rows and self._by_rows:
            self._gram, self._there = self._quiet @ self._across, self._quiet @ self._adjoint

    def at(self, multiplier: Float64Array) -> list[tuple[Complex128Array, Float64Array]]:
        """Steer around the quiet rows with their multipliers > 0, (rows,).

        Returns of each focus z, times the root of sigma, complex128 (bins, actuators), and d, float64 (bins,).
        """
        rows, steered = len(multiplier), self._adjoint
        d = np.zeros((steered.shape[0], steered.shape[2]))
        # d is z* A z, a sum of positive terms: h z would lose all digits where the focus is nearly a quiet place.
        if rows and self._by_rows:
            # A^-1 = I - q* (diag(1/m) + q q*)^-1 q, of as many unknowns as there are rows; q z is x / m.
            gram = self._gram.copy()
            gram[:, np.arange(rows), np.arange(rows)] += 1.0 / multiplier
            x = np.linalg.solve(gram, self._there)
            steered = steered - self._across @ x
            d += (np.square(np.abs(x)) / multiplier[:, None]).sum(axis=1)
        elif rows:
            normal = (self._across * multiplier) @ self._quiet + np.eye(len(self._root))
            steered = np.linalg.solve(normal, steered)
            d += (np.square(np.abs(self._quiet @ steered)) * multiplier[:, None]).sum(axis=1)
        d += np.square(np.abs(steered)).sum(axis=1)
        return [(steered[:, :, index] * self._root, d[:, index]) for index in range(d.shape[1])]


def least_energy(focus: Focus, multiplier: Float64Array) -> tuple[Complex128Array, Float64Array]:
    """Steer one focus around its quiet rows; see `Steering.at`."""
    return Steering([focus]).at(multiplier)[0]


def reversed_in_time(focus: Focus) -> Complex128Array:
    """Filters of plain time reversal, s h*, (bins, actuators)."""
    return np.asarray(np.conj(focus.row) * (1.0 if focus.sigma is None else focus.sigma))


def reversed_power(focus: Focus) -> Float64Array:
    """a, the response of time reversal at the focus, (bins,)."""
    power = np.square(np.abs(focus.row))
    return np.asarray(power.sum(axis=1) if focus.sigma is None else power @ focus.sigma)


def focusing(a: Float64Array, d: Float64Array, slack: float, power: Float64Array) -> Float64Array:
    """Factor b a / (k + d) on z, (bins,); `slack` is k, `power` is S, (bins,)."""
    factor = np.divide(a, slack + d, out=np.ones_like(a), where=a > 0)
    if slack > 0 and (own := float(power @ (a * factor * d))) > 0:
        factor *= float(power @ np.square(a)) / own
    return factor


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """The foci of sources that sound together.

    foci: Of each source.
    emitted, complex128 (sources, sources, bins): Cross spectra U_j U_l* of what they emit, times the gains n(x) of both
        foci; bins that stand for two signs of frequency count twice.
    quiet, complex128 (bins, rows, actuators), place, int64 (rows,): Rows of all places at this instant.
    applies, bool (sources, places): Whether a source is to be quiet at a place.
    """

    foci: Sequence[Focus]
    emitted: Complex128Array
    quiet: Complex128Array
    place: Int64Array
    applies: BoolArray


@dataclass(frozen=True, slots=True, eq=False)
class Multipliers:
    """The multipliers of a scene, and what its drives do with them.

    of_place, float64 (places,): Multiplier m of each place.
    slack: k.
    energy: Of the drives over plain time reversal's.
    level, plain_level, float64 (places,): Energy of the response at each place over that at the loudest focus, with the
        filters and with plain time reversal.
    capped: The levels cost more than the energy that is allowed.
    """

    of_place: Float64Array
    slack: float
    energy: float
    level: Float64Array
    plain_level: Float64Array
    capped: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Totals:
    """Energies over all moments: of the drives, of the response at each place and at the loudest focus."""

    drive: float
    place: Float64Array
    focus: float

    @property
    def level(self) -> Float64Array:
        return self.place / max(self.focus, TINY)


Cut = Callable[[Complex128Array], Complex128Array]
"""What is left of filters (bins, actuators) that are cut to their length in time."""


def find_multipliers(
    moments: Sequence[Moment],
    level: Float64Array,
    *,
    response_error: float = 0.0,
    most_energy: float = np.inf,
    cut: Cut | None = None,
) -> Multipliers:
    """Find the multipliers of least drive energy with which no place exceeds its level.

    level, float64 (places,): Energy of the response at each place over that at the loudest focus, > 0.
    response_error: e, 0 or above.
    most_energy: Of the drives over plain time reversal's, 1 or above. Where the levels cost more, the largest
        multipliers are lowered together until the energy is met; then some levels are not reached.
    cut: By default filters are as long as they come out.
    """
    search, whole = _Search(_sounding(moments), response_error), _Search(moments, response_error)
    wanted, start = level, None
    for _ in range(CUT_ROUNDS):
        found, totals = search.find(wanted, most_energy, start)
        if cut is not None:
            totals = whole.totals(found.of_place, found.slack, cut)
        excess = totals.level / level
        if cut is None or found.capped or (excess < 1.0 + TOLERANCE_DB / 4).all():
            break
        wanted, start = wanted / np.clip(excess, 1.0, 10.0), found.of_place
    if found.capped and (totals.level > WORTH * search.plain.level).all():
        found, totals = search.unsteered(found)
    return replace(found, level=totals.level, energy=totals.drive / max(search.plain.drive, TINY))


def _sounding(moments: Sequence[Moment]) -> list[Moment]:
    """The bins of moments in which their sources emit something."""
    powers = [np.abs(np.einsum("jjf->jf", moment.emitted)).sum(axis=0) for moment in moments]
    power = np.sum(powers, axis=0)
    used = power > FAINT * power.max(initial=0.0)
    kept: dict[int, Complex128Array] = {}

    def narrowed(quiet: Complex128Array) -> Complex128Array:
        """The same array for the same rows, by which foci are found to share them."""
        return kept.setdefault(id(quiet), quiet[used])

    return [
        replace(
            moment,
            foci=[replace(focus, row=focus.row[used], quiet=narrowed(focus.quiet)) for focus in moment.foci],
            emitted=moment.emitted[:, :, used],
            quiet=narrowed(moment.quiet),
        )
        for moment in moments
    ]


class _Search:
    """The search for the multipliers of a scene."""

    def __init__(self, moments: Sequence[Moment], response_error: float) -> None:
        self._moments, self._error = moments, response_error
        self._a = [[reversed_power(focus) for focus in moment.foci] for moment in moments]
        groups: dict[tuple[int, int], list[Focus]] = {}
        for moment in moments:
            for focus in moment.foci:
                groups.setdefault((id(focus.quiet), 0 if focus.sigma is None else id(focus.sigma)), []).append(focus)
        self._groups = [(Steering(foci), foci) for foci in groups.values()]
        self._emitted = [np.ascontiguousarray(moment.emitted.transpose(2, 0, 1)) for moment in moments]
        places = moments[0].applies.shape[1]
        power, emitted = np.zeros(places), np.zeros(places)
        for moment in moments:
            own = np.einsum("jjf->f", moment.emitted).real
            row_power = own @ np.square(np.abs(moment.quiet)).sum(axis=2)
            np.add.at(power, moment.place, row_power / np.bincount(moment.place)[moment.place])
            emitted[np.unique(moment.place)] += own.sum()
        # Where the bank has no energy there is nothing to be lowered.
        self._unit = np.divide(emitted, power, out=np.ones(places), where=power > TINY)
        self.plain = self._summed([[reversed_in_time(focus) for focus in moment.foci] for moment in moments])

    def find(
        self, level: Float64Array, most_energy: float, start: Float64Array | None = None
    ) -> tuple[Multipliers, _Totals]:
        """The multipliers that meet the levels within the energy; `start` holds others to begin from."""
        most = most_energy * self.plain.drive
        begin = np.where(self.plain.level > level, 10.0, MIN_MULTIPLIER) if start is None else start / self._unit
        relative, slack, totals = self._met(begin, level, MAX_MULTIPLIER)
        if capped := totals.drive > most:
            low, high = np.log10(MIN_MULTIPLIER), np.log10(MAX_MULTIPLIER)
            asked = relative
            relative, slack, totals = self._met(np.full_like(begin, MIN_MULTIPLIER), level, MIN_MULTIPLIER)
            for _ in range(CAP_STEPS):
                middle = 0.5 * (low + high)
                tried = self._met(np.minimum(asked, 10.0**middle), level, 10.0**middle)
                if tried[2].drive > most:
                    high = middle
                else:
                    low, (relative, slack, totals) = middle, tried
        energy = totals.drive / max(self.plain.drive, TINY)
        return Multipliers(relative * self._unit, slack, energy, totals.level, self.plain.level, capped), totals

    def unsteered(self, found: Multipliers) -> tuple[Multipliers, _Totals]:
        """Plain time reversal, but for what rounding leaves of the smallest multipliers."""
        least = MIN_MULTIPLIER * self._unit
        return replace(found, of_place=least, slack=0.0), self._summed(self._filters(self._steered(least), 0.0))

    def totals(self, multiplier: Float64Array, slack: float, cut: Cut) -> _Totals:
        """Energies of filters that are cut."""
        filters = self._filters(self._steered(multiplier), slack)
        return self._summed([[cut(spectra) for spectra in own] for own in filters])

    def _met(self, relative: Float64Array, level: Float64Array, ceiling: float) -> tuple[Float64Array, float, _Totals]:
        """Multipliers up to a ceiling that meet the levels, in units of the reciprocals of the places' powers."""
        for last in range(STEPS):
            steered = self._steered(relative * self._unit)
            slack = self._slack([d for own in steered for _, d in own])
            totals = self._summed(self._filters(steered, slack))
            excess = np.log10(np.maximum(totals.level, TINY) / level)
            done = (np.abs(excess) < TOLERANCE_DB / 10) | ((excess < 0) & (relative <= MIN_MULTIPLIER))
            if last == STEPS - 1 or (done | ((excess > 0) & (relative >= ceiling))).all():
                break
            relative = np.clip(relative * 10.0 ** np.clip(RATE * excess, -MAX_STEP, MAX_STEP), MIN_MULTIPLIER, ceiling)
        return relative, slack, totals

    def _steered(self, multiplier: Float64Array) -> list[list[tuple[Complex128Array, Float64Array]]]:
        found: dict[int, tuple[Complex128Array, Float64Array]] = {}
        for steering, foci in self._groups:
            for focus, steered in zip(foci, steering.at(of_rows(multiplier, foci[0].place)), strict=True):
                found[id(focus)] = steered
        return [[found[id(focus)] for focus in moment.foci] for moment in self._moments]

    def _filters(
        self, steered: list[list[tuple[Complex128Array, Float64Array]]], slack: float
    ) -> list[list[Complex128Array]]:
        return [
            [
                z * focusing(a, d, slack, moment.emitted[index, index].real)[:, None]
                for index, ((z, d), a) in enumerate(zip(own, powers, strict=True))
            ]
            for moment, own, powers in zip(self._moments, steered, self._a, strict=True)
        ]

    def _slack(self, ds: list[Float64Array]) -> float:
        """The k with which all responses together deviate by e; 0 for e = 0."""
        if not self._error or not ds:
            return 0.0
        a, d = np.concatenate([values for own in self._a for values in own]), np.concatenate(ds)
        power = np.concatenate([m.emitted[j, j].real for m in self._moments for j in range(len(m.foci))])
        edges = np.cumsum([0] + [len(values) for values in ds[:-1]])
        whole = power * np.square(a)
        low, high = -16.0, 16.0
        unit = float(whole @ d / max(float(whole.sum()), TINY))
        for _ in range(SLACK_STEPS):
            middle = 0.5 * (low + high)
            part = np.divide(d, unit * 10.0**middle + d, out=np.ones_like(d), where=d > 0)
            amplitude = np.add.reduceat(whole, edges) / np.maximum(np.add.reduceat(whole * part, edges), TINY)
            off = np.square(part * np.repeat(amplitude, np.diff(np.append(edges, len(d)))) - 1.0)
            if float(whole @ off) > self._error**2 * float(whole.sum()):
                high = middle
            else:
                low = middle
        return float(unit * 10.0**low)

    def _summed(self, filters: list[list[Complex128Array]]) -> _Totals:
        drive, places = 0.0, self._moments[0].applies.shape[1]
        place, focus = np.zeros(places), dict[int, float]()
        for moment, emitted, own in zip(self._moments, self._emitted, filters, strict=True):
            driven = np.stack(own, axis=2)
            drive += float(_energies(emitted, driven).sum())
            there = (moment.quiet @ driven) * moment.applies[:, moment.place].T
            np.add.at(place, moment.place, _energies(emitted, there) / np.bincount(moment.place)[moment.place])
            rows = np.stack([source_focus.row for source_focus in moment.foci], axis=1)
            for source_focus, energy in zip(moment.foci, _energies(emitted, rows @ driven).tolist(), strict=True):
                focus[source_focus.source] = focus.get(source_focus.source, 0.0) + energy
        return _Totals(drive, np.maximum(place, 0.0), max(focus.values()))


def _energies(emitted: Complex128Array, response: Complex128Array) -> Float64Array:
    """Energy over all bins of the sum of the sources' responses (bins, rows, sources), (rows,)."""
    return np.asarray(((response @ emitted) * response.conj()).real.sum(axis=(0, 2)))
