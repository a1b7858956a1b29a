"""Filters of least drive energy that focus at one place and keep the response low at others.

At each frequency, with the row h (N,) of the focus, the rows q (R, N) of the quiet places and the filters w (N,) of the
actuators per unit of the signal, time reversal is w = h*, and its response at the focus a = h h*. Here

    minimise  sum S |w|^2   with  h w = a  at each frequency  and  sum S |q_k w|^2 <= E_k  for each place k,

sums being over the frequencies and S the power spectrum of the signal. The bounds are totals over the band, so that
there is one multiplier m_k for each place and not one for each frequency; the rows of a disc share its multiplier, and
so do all sources and instants of a scene. With A = I + q* diag(m) q:

    z = A^-1 h*,   d = h z,   w = z a / d.

Actuators that saturate (eq. 14) count as in time reversal: with s the diagonal of their factors, w -> s^(1/2) w,
h -> h s^(1/2) and q -> q s^(1/2), so that w is s h* where nothing is quiet.

References: Lagrange duality, S. Boyd and L. Vandenberghe, Convex Optimization, chapter 5; acoustic contrast control,
J.-W. Choi and Y.-H. Kim, J. Acoust. Soc. Am. 111 (2002) 1695.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from wavefocus.rendering.arrays import BoolArray, Complex128Array, Float64Array, Int64Array

STEPS, RATE, MAX_STEP = 60, 0.6, 1.5
"""Steps of the search; its exponent, for a level falls with the first to second power of its multiplier; decades that a
multiplier changes in one step, at most."""
CLOSE_DB = 0.02
MIN_MULTIPLIER, MAX_MULTIPLIER = 1e-6, 1e6
"""Bounds of a multiplier over the reciprocal of its place's mean power."""
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


def least_energy(foci: Sequence[Focus], multiplier: Float64Array) -> list[Complex128Array]:
    """Filters w of foci with the same quiet rows and saturation, complex128 (bins, actuators) each.

    multiplier, float64 (places,): Above 0.
    """
    sigma, place = foci[0].sigma, foci[0].place
    root = np.ones(foci[0].row.shape[1]) if sigma is None else np.sqrt(sigma)
    quiet = foci[0].quiet if sigma is None else foci[0].quiet * root
    adjoint = np.stack([np.conj(focus.row * root) for focus in foci], axis=2)
    across, z, d = quiet.conj().transpose(0, 2, 1), adjoint, 0.0
    m = multiplier[place] / np.bincount(place, minlength=len(multiplier))[place]
    # d is z* A z, a sum of positive terms: h z would lose all digits where the focus is nearly a quiet place.
    if 0 < len(m) < len(root):
        # A^-1 = I - q* (diag(1/m) + q q*)^-1 q, of as many unknowns as there are rows; q z is x / m.
        gram = quiet @ across
        gram[:, np.arange(len(m)), np.arange(len(m))] += 1.0 / m
        x = np.linalg.solve(gram, quiet @ adjoint)
        z = adjoint - across @ x
        d = (np.square(np.abs(x)) / m[:, None]).sum(axis=1)
    elif len(m):
        z = np.linalg.solve((across * m) @ quiet + np.eye(len(root)), adjoint)
        d = (np.square(np.abs(quiet @ z)) * m[:, None]).sum(axis=1)
    d = d + np.square(np.abs(z)).sum(axis=1)
    a = np.square(np.abs(adjoint)).sum(axis=1)
    w = z * np.divide(a, d, out=np.ones_like(a), where=a > 0)[:, None] * root[:, None]
    return [w[:, :, index] for index in range(len(foci))]


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
    energy: Of the drives over plain time reversal's.
    level, uncut_level, float64 (places,): Energy of the response at each place over that at the loudest focus: with the
        filters, and before they were cut to their length.
    focus: Energy of the response at the loudest focus.
    capped: The levels cost more than the energy that is allowed.
    """

    of_place: Float64Array
    energy: float
    level: Float64Array
    uncut_level: Float64Array
    focus: float
    capped: bool


@dataclass(frozen=True, slots=True, eq=False)
class _Energies:
    """Energies over all moments: of the drives, of the response at each place and at the loudest focus."""

    drive: float
    place: Float64Array
    focus: float

    @property
    def level(self) -> Float64Array:
        """Of each place over the loudest focus."""
        return self.place / max(self.focus, TINY)


Filters = list[list[Complex128Array]]
"""Of each moment and source, (bins, actuators)."""
Cut = Callable[[Complex128Array], Complex128Array]
"""What is left of filters (bins, actuators) that are cut in time."""


def filters_of(moments: Sequence[Moment], multiplier: Float64Array) -> Filters:
    """The filters of all foci; those that share rows and saturation are solved for together."""
    groups: dict[tuple[int, int], list[Focus]] = {}
    for moment in moments:
        for focus in moment.foci:
            groups.setdefault((id(focus.quiet), id(focus.sigma)), []).append(focus)
    found = {
        id(focus): filters
        for foci in groups.values()
        for focus, filters in zip(foci, least_energy(foci, multiplier), strict=True)
    }
    return [[found[id(focus)] for focus in moment.foci] for moment in moments]


def energies_of(moments: Sequence[Moment], filters: Filters) -> _Energies:
    """Energies of what the sources emit, through their filters."""
    drive, places = 0.0, moments[0].applies.shape[1]
    place, at_focus = np.zeros(places), dict[int, float]()
    for moment, own in zip(moments, filters, strict=True):
        driven, emitted = np.stack(own, axis=2), moment.emitted.transpose(2, 0, 1)
        there = (moment.quiet @ driven) * moment.applies[:, moment.place].T
        rows = np.stack([focus.row for focus in moment.foci], axis=1)
        drive += float(_energy(emitted, driven).sum())
        np.add.at(place, moment.place, _energy(emitted, there) / np.bincount(moment.place)[moment.place])
        for focus, energy in zip(moment.foci, _energy(emitted, rows @ driven).tolist(), strict=True):
            at_focus[focus.source] = at_focus.get(focus.source, 0.0) + energy
    return _Energies(drive, np.maximum(place, 0.0), max(at_focus.values()))


def _energy(emitted: Complex128Array, response: Complex128Array) -> Float64Array:
    """Energy over all bins of the sum of the sources' responses (bins, rows, sources), (rows,)."""
    return np.asarray(((response @ emitted) * response.conj()).real.sum(axis=(0, 2)))


def find_multipliers(
    moments: Sequence[Moment], level: Float64Array, *, most_energy: float = np.inf, cut: Cut = lambda filters: filters
) -> Multipliers:
    """Find the multipliers of least drive energy with which no place exceeds its level.

    level, float64 (places,): Energy of the response at each place over that at the loudest focus, > 0.
    most_energy: Of the drives over plain time reversal's, 1 or above. Where the levels cost more, the largest
        multipliers are lowered together until the energy is met; then some levels are not reached.
    cut: By default filters are as long as they come out.
    """
    loud = _sounding(moments)
    # Filters of plain time reversal, s h*.
    reversed_in_time = [
        [np.asarray(f.row.conj() * (1.0 if f.sigma is None else f.sigma)) for f in m.foci] for m in loud
    ]
    unit, plain = _units(loud), energies_of(loud, reversed_in_time)
    relative, wanted = np.where(plain.level > level, 10.0, MIN_MULTIPLIER), level
    # Times that levels are asked lower by what cutting the filters to their length costs.
    for _ in range(3):
        relative, uncut, capped = _within(most_energy * plain.drive, loud, wanted, unit, relative)
        after = energies_of(moments, [[cut(one) for one in own] for own in filters_of(moments, relative * unit)])
        excess = after.level / level
        if capped or (excess < 10 ** (0.1 * CLOSE_DB)).all():
            break
        wanted = wanted / np.clip(excess, 1.0, 10.0)
    # Where the energy that is allowed lowers no place by 1 dB, none is spent.
    if capped and (after.level > 10**-0.1 * plain.level).all():
        # Plain time reversal, but for what rounding leaves of the smallest multipliers.
        relative = np.full_like(relative, MIN_MULTIPLIER)
        after = energies_of(moments, filters_of(moments, relative * unit))
    of_plain = 1.0 / max(plain.drive, TINY)
    return Multipliers(
        relative * unit,
        after.drive * of_plain,
        after.level,
        uncut.level,
        after.focus,
        capped,
    )


def _sounding(moments: Sequence[Moment]) -> list[Moment]:
    """The bins of moments in which their sources emit something."""
    power = np.sum([np.abs(np.einsum("jjf->jf", moment.emitted)).sum(axis=0) for moment in moments], axis=0)
    used, narrowed = power > FAINT * power.max(initial=0.0), dict[int, Complex128Array]()

    def quiet(rows: Complex128Array) -> Complex128Array:
        """The same array for the same rows, by which foci are found to share them."""
        return narrowed.setdefault(id(rows), rows[used])

    return [
        Moment(
            [Focus(focus.row[used], quiet(focus.quiet), focus.place, focus.sigma, focus.source) for focus in m.foci],
            m.emitted[:, :, used], quiet(m.quiet), m.place, m.applies,
        )
        for m in moments
    ]  # fmt: skip


def _units(moments: Sequence[Moment]) -> Float64Array:
    """Emitted power over that of each place, (places,): the unit of its multiplier."""
    power, emitted = np.zeros((2, moments[0].applies.shape[1]))
    for moment in moments:
        own = np.einsum("jjf->f", moment.emitted).real
        row_power = own @ np.square(np.abs(moment.quiet)).sum(axis=2)
        np.add.at(power, moment.place, row_power / np.bincount(moment.place)[moment.place])
        emitted[np.unique(moment.place)] += own.sum()
    # Where the bank has no energy there is nothing to be lowered.
    return np.divide(emitted, power, out=np.ones_like(power), where=power > TINY)


def _within(
    most: float, moments: Sequence[Moment], level: Float64Array, unit: Float64Array, start: Float64Array
) -> tuple[Float64Array, _Energies, bool]:
    """The multipliers that meet the levels within an energy, and whether it acts."""
    relative, found = _met(moments, level, unit, start, MAX_MULTIPLIER)
    if found.drive <= most:
        return relative, found, False
    low, high, asked = np.log10(MIN_MULTIPLIER), np.log10(MAX_MULTIPLIER), relative
    relative, found = _met(moments, level, unit, np.full_like(asked, MIN_MULTIPLIER), MIN_MULTIPLIER)
    # Halvings of the range of multipliers, in decades, until the energy of the drives is met.
    for _ in range(12):
        middle = 0.5 * (low + high)
        tried = _met(moments, level, unit, np.minimum(asked, 10.0**middle), 10.0**middle)
        if tried[1].drive > most:
            high = middle
        else:
            low, (relative, found) = middle, tried
    return relative, found, True


def _met(
    moments: Sequence[Moment], level: Float64Array, unit: Float64Array, relative: Float64Array, ceiling: float
) -> tuple[Float64Array, _Energies]:
    """Multipliers up to a ceiling that meet the levels, in their units."""
    for last in range(STEPS):
        found = energies_of(moments, filters_of(moments, relative * unit))
        excess = np.log10(np.maximum(found.level, TINY) / level)
        done = (np.abs(excess) < 0.1 * CLOSE_DB) | ((excess < 0) & (relative <= MIN_MULTIPLIER))
        if last == STEPS - 1 or (done | ((excess > 0) & (relative >= ceiling))).all():
            break
        relative = np.clip(relative * 10.0 ** np.clip(RATE * excess, -MAX_STEP, MAX_STEP), MIN_MULTIPLIER, ceiling)
    return relative, found
