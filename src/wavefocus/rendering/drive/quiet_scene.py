"""Scenes with quiet places: rows that focus and are quiet elsewhere take the place of the bank's own.

A filter w of `wavefocus.rendering.drive.quiet_filters` is longer than the Green's functions that it is made of. It is
computed at the frequencies of a transform of twice its length, and kept from -(L - 1) samples, where the drive begins,
to a tail after its focus. So its reversal in time is a row of L + tail samples, and the block accumulator makes drives
of such rows as it does of the bank's. The drives begin where those of other scenes do, and end a tail later. The tail
is the first of `TAILS_S` behind which the filters would lie `BELOW_DB` below the levels asked for; the response at the
focus at its instant stays as it is, since no tap of a Green's function meets what is cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.device import fast_length
from wavefocus.rendering.drive.quiet_filters import (
    Focus,
    Moment,
    Multipliers,
    energies_of,
    filters_of,
    find_multipliers,
    least_energy,
)
from wavefocus.rendering.field.quiet_levels import QuietLevel, quiet_levels, rendered_levels
from wavefocus.rendering.greens.interpolation.base import Nodes
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import GreenSource, RealArray, RowReader
from wavefocus.rendering.scene.emission import ContinuousEmission, Emission, Events, PointEmission
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.quiet_places import (
    PlaceRows,
    PlannedPlace,
    QuietPlan,
    changes_place,
    paths_of,
    place_at,
    plan_quiet,
)
from wavefocus.rendering.scene.sampling import SampledScene
from wavefocus.storage.drive_file import Drive, QuietTrack

TAILS_S = (0.05, 0.07, 0.1, 0.14, 0.2)
"""Lengths of the filters after the focus that are tried."""
BELOW_DB = 20.0
"""What is cut then changes a level by 1 dB at most."""
MAX_STATES = 64
MAX_SIGNAL_SAMPLES = 2**21
MISSED_DB = 0.2
"""Level above the one asked for from which it is said; the search ends within a tenth of it."""


@dataclass(frozen=True, slots=True, eq=False)
class QuietFigures:
    """Figures of the quiet places of a scene.

    levels: The places, with the levels of the finished drive; of the filters where there is no drive in memory.
    multiplier, float64 (places,): Of the equations in `wavefocus.rendering.drive.quiet_filters`, for rows in the bank's
        unit.
    energy: Of the drives over plain time reversal's.
    warnings: Levels that are not reached, and places that a source passes.
    """

    levels: tuple[QuietLevel, ...]
    multiplier: Float64Array
    energy: float
    warnings: tuple[str, ...]


def quiet_scene(scene: Scene, bank: GreenSource, sampled: SampledScene) -> tuple[SampledScene, QuietRows]:
    """The scene as the accumulator takes it, and its rows.

    Raises InputError: a quiet place is at a focus, off the grid or not measured.
    """
    place_rows = PlaceRows(bank, sampled.interpolation)
    plan = plan_quiet(scene, bank, sampled, place_rows)
    for tail_s in TAILS_S:
        rows = QuietRows(scene, sampled, bank, place_rows, plan, max(1, round(tail_s * float(bank.sample_rate_hz))))
        rows.solve()
        if rows.long_enough:
            break
    sources = [
        replace(source, emission=_QuietEmission(source.emission, plan, index, rows), nodes=2 * source.nodes)
        for index, source in enumerate(sampled.sources)
    ]
    return replace(sampled, sources=sources, samples=sampled.samples + rows.tail), rows


class _QuietEmission:
    """An emission whose rows are those of a `QuietRows`, fading from one knot of the plan to the next."""

    def __init__(self, emission: Emission, plan: QuietPlan, source: int, rows: QuietRows) -> None:
        self.first_sample, self.stop_event = emission.first_sample, emission.stop_event
        self.stop_sample, self.event_samples = emission.stop_sample, emission.event_samples
        self.piece_spectra = emission.piece_spectra
        self._emission, self._knots, self._sets, self._rows = emission, plan.knots, plan.of_source[source], rows

    def events(self, start: int, stop: int) -> Events:
        made = self._emission.events(start, stop)
        last = len(self._knots) - 1
        step = float(self._knots[1] - self._knots[0]) if last else 1.0
        along = np.clip((made.sample + start - self._knots[0]) / step, 0.0, last)
        low = along.astype(np.int64)
        before, after = self._sets[low], self._sets[np.minimum(low + 1, last)]
        rows, weights = self._rows.numbers(before, made.nodes), made.nodes.weights
        if (before != after).any():
            share = np.where(before == after, 0.0, along - low)[:, None]
            rows = np.concatenate([rows, self._rows.numbers(after, made.nodes)], axis=1)
            weights = np.concatenate([weights * (1.0 - share), weights * share], axis=1)
        return replace(made, nodes=Nodes(rows, weights, made.nodes.nearest))


class QuietRows(BankRows):
    """Rows that focus like a row of the bank and are quiet elsewhere, by numbers that `numbers` gives.

    tail: Samples of the filters after the focus.
    found: The multipliers, once `solve` found them.
    """

    found: Multipliers
    long_enough: bool
    """No longer filters are of use."""
    _bins: Int64Array

    def __init__(
        self, scene: Scene, sampled: SampledScene, bank: GreenSource, place_rows: PlaceRows, plan: QuietPlan, tail: int
    ) -> None:
        self._moments, self._lasts = _instants(scene, sampled, plan)
        rate_hz = float(bank.sample_rate_hz)
        # An interpolation adds rows at its nodes, so these come before its rows are looked at.
        self._nodes = [
            sampled.interpolation.nodes(
                place_at(source.path, source.speed_mm_s, source.start_s, plan.knots[self._moments], rate_hz)
            )
            for source in scene.sources
        ]
        super().__init__(sampled.interpolation.rows_of(bank), scene.regularisation, sampled.naming)
        self.plan, self.tail = plan, tail
        self._scene, self._sampled, self._measured_bank, self._place_rows = scene, sampled, bank, place_rows
        self._saturates = bool(scene.regularisation.saturation or scene.regularisation.saturation_absolute)
        self._numbers: dict[tuple[int, int, int], int] = {}
        self._keys: list[tuple[int, int, int]] = []
        self._length = fast_length(2 * (bank.taps + tail))
        # Both read the same rows, and a bank is asked by one thread at a time only where they share the reader.
        self._quiet_reader = self._reader if place_rows.rows is self.bank else RowReader(place_rows.rows)
        self._quiet_spectrum = lru_cache(256)(self._transform)
        self._quiet = lru_cache(MAX_STATES)(self._stack)  # foci that keep the same rows quiet share the array

    @property
    def taps(self) -> int:
        return self.bank.taps + self.tail

    def numbers(self, sets: Int64Array, nodes: Nodes) -> Int64Array:
        """Numbers of the rows that focus like those of nodes (n, k) with sets of the plan, (n,), as (n, k)."""
        by = nodes.nearest if self._saturates else np.full_like(nodes.nearest, -1)
        key = np.stack(np.broadcast_arrays(sets[:, None], nodes.rows, by[:, None]), axis=2).reshape(-1, 3)
        different, inverse = np.unique(key, axis=0, return_inverse=True)
        numbers = np.empty(len(different), dtype=np.int64)
        for place, one in enumerate(map(tuple, different.tolist())):
            if one not in self._numbers:
                self._numbers[one] = len(self._keys)
                self._keys.append(one)
            numbers[place] = self._numbers[one]
        return np.asarray(numbers[inverse.ravel()].reshape(nodes.rows.shape))

    def read(self, row: int, *, single: bool = False) -> RealArray:
        """The row of a number, (actuators, taps)."""
        number, focus_row, by = self._keys[row]
        green = self._measured(focus_row)
        sigma = self.sigma(by) if by >= 0 else None
        made = np.zeros((len(green), self.taps))
        made[:, self.tail :] = green
        focus = Focus(self._spectrum_of(green), *self._quiet(number), sigma)
        [filters] = least_energy([focus], self.found.of_place)
        # The accumulator multiplies by sigma; what is left of the bins without energy is the row itself.
        change = np.conj(filters / (1.0 if sigma is None else sigma)) - focus.row
        turn = np.exp(-2j * np.pi * self.tail / self._length * self._bins)
        made += self._in_time(change * turn[:, None])[:, : self.taps]
        return made.astype(np.float32) if single else made

    def figures(self, drive: Drive | None) -> QuietFigures:
        """The places with the levels of the finished drive, where there is one in memory."""
        found = self.found
        kept = self._kept
        places = [self.plan.places[number] for number in kept.tolist()]
        # Instants at which a place that moves is kept in drive files, and those of all places together.
        instants = min(32, max(2, 1000 // max(len(places), 1)))
        reached_db = 10.0 * np.log10(np.maximum(found.level[kept], 1e-30))
        tracks = [self._track(*pair, instants) for pair in zip(places, reached_db.tolist(), strict=True)]
        levels = rendered_levels(tuple(tracks))
        if drive is not None and drive.drive_v.any():
            levels = tuple(
                replace(level, track=replace(level.track, rendered_db=round(level.reached_db, 3)))
                for level in quiet_levels(replace(drive, quiet=tuple(tracks)), self._measured_bank)
            )
        warnings = [*self.plan.warnings, *self._row_error_words()]
        for number, place, level in zip(kept.tolist(), places, levels, strict=True):
            if level.reached_db > place.level_db + MISSED_DB:
                why = self._reason(number, place)
                warnings.append(
                    f"{place.words} reaches {level.reached_db:.1f} dB of {place.level_db:g} dB asked; {why}"
                )
        return QuietFigures(levels, found.of_place[kept], found.energy, tuple(warnings))

    def _track(self, place: PlannedPlace, level_db: float, instants: int) -> QuietTrack:
        knots = self.plan.knots if changes_place(place.path) else self.plan.knots[:1]
        sample = knots[evenly_spread(len(knots), instants)]
        return QuietTrack(
            place.words, sample, place.at(sample, self._rate_hz).round(6), place.radius_mm, place.level_db,
            round(level_db, 3), -1 if place.source is None else place.source, self._place_rows.name,
        )  # fmt: skip

    def _row_error_words(self) -> list[str]:
        """Says how quiet places between positions are, where their rows are not known well enough."""
        error = self._place_rows.error([source.signal for source in self._sampled.sources])
        # What is wrong with a row is alike in no two actuators, so that their drives do not focus on it.
        true_db = 10.0 * np.log10(max(error**2 * self.found.energy / self.bank.actuators, 1e-30))
        if true_db <= max(place.level_db for place in self.plan.places) - MISSED_DB:
            return []
        return [
            f"between the grid's positions, the responses at quiet places are wrong by about {100 * error:.0f} %, so"
            f" that these are no quieter than about {true_db:.0f} dB; measure a finer grid"
        ]

    def _reason(self, number: int, place: PlannedPlace) -> str:
        """Why a place is louder than asked: energy, the actuators, or the filters' length."""
        if self.found.capped:
            most = self._scene.output.most_energy
            return f"more would cost over {most:g} times the energy of plain time reversal"
        if self.found.uncut_level[number] > place.level * 10 ** (0.1 * MISSED_DB):
            return "the bank's actuators cannot do more"
        length_s = self.taps / self._rate_hz
        if changes_place(place.path) or any(changes_place(source.path) for source in self._scene.sources):
            return f"filters are {length_s:.2g} s long, in which places and sources move: the filters' length"
        return f"filters end {self.tail / self._rate_hz:.2g} s after their focus: the filters' length"

    @property
    def _rate_hz(self) -> float:
        return float(self.bank.sample_rate_hz)

    def solve(self) -> None:
        """Find the multipliers from the foci of some moments."""
        scene, plan, sampled = self._scene, self.plan, self._sampled
        moments, lasts = self._moments, self._lasts
        emissions = [source.emission for source in sampled.sources]
        sounding = np.array([_sounding(emission, plan.knots)[moments] for emission in emissions])
        green: dict[tuple[int, int], tuple[RealArray, int]] = {}
        for number, nodes in enumerate(self._nodes):
            for m in np.flatnonzero(sounding[number]).tolist():
                parts = zip(nodes.rows[m].tolist(), nodes.weights[m].tolist(), strict=True)
                row = np.sum([weight * self._measured(row) for row, weight in parts if weight], axis=0)
                green[number, m] = row, int(nodes.nearest[m])
        energy = sum(np.square(np.abs(np.fft.rfft(row, self._length, axis=1))).sum(axis=0) for row, _ in green.values())
        # Bins with less of a row's energy than this, relative to the largest, are left to time reversal.
        self._bins = np.flatnonzero(energy > 1e-12 * np.max(energy))
        cross = self._emitted(emissions)
        whole = np.maximum(sounding @ lasts, 1)
        made = []
        for m, knot in enumerate(moments.tolist()):
            together = np.flatnonzero(sounding[:, m]).tolist()
            rows, place = plan.rows_at(knot)
            foci, applies = [], np.zeros((len(together), len(plan.places)), dtype=bool)
            for index, source in enumerate(together):
                own, (row, by) = int(plan.of_source[source, knot]), green[source, m]
                applies[index, plan.sets[own][2]] = True
                foci.append(Focus(self._spectrum_of(row), *self._quiet(own), self.sigma(by), source))
            gains = self.weigh(np.array([green[source, m][1] for source in together]))[0]
            gains = gains * np.sqrt(lasts[m] / whole[together])
            alone = np.eye(len(together))[..., None]  # of spectra only, each source counts by itself
            chosen = cross[np.ix_(together, together)] if cross.ndim == 3 else alone * cross[together, None]
            made.append(Moment(foci, chosen * np.outer(gains, gains)[..., None], self._spectra(rows), place, applies))
        # Of sources at one place, or that never sound together, none is kept quiet at the other.
        self._kept = np.flatnonzero(np.any([moment.applies.any(axis=0) for moment in made], axis=0))
        level = np.array([place.level for place in plan.places])
        self.found = find_multipliers(made, level, most_energy=scene.output.most_energy, cut=self._cut)
        behind = [[self._behind(one) for one in own] for own in filters_of(made, self.found.of_place)]
        left = energies_of(made, behind).place / max(self.found.focus, 1e-300)
        self.long_enough = self.found.capped or bool((left <= level * 10 ** (-0.1 * BELOW_DB)).all())

    def _emitted(self, emissions: Sequence[Emission]) -> Complex128Array:
        """Cross spectra (sources, sources, bins) of what the sources emit, of many only the spectra, (sources, bins).

        As far as responses can meet: of correlations, the lags within the transform.
        """
        signals, begins = [], []
        for emission, source in zip(emissions, self._sampled.sources, strict=True):
            signal = emission.signal if isinstance(emission, ContinuousEmission | PointEmission) else source.signal
            repeats = len(emission.focus_sample) if isinstance(emission, PointEmission) else 1
            kept = signal[:MAX_SIGNAL_SAMPLES]
            share = float(np.square(signal).sum()) / max(float(np.square(kept).sum()), 1e-300)
            signals.append(kept * np.sqrt(share * repeats))
            begins.append(emission.first_sample)
        ends = [begin + len(signal) for begin, signal in zip(begins, signals, strict=True)]
        # Of more sources that sound together the spectra only, not the cross spectra.
        coherent = len(signals) <= 16 and max(ends) - min(begins) <= MAX_SIGNAL_SAMPLES
        span = max(ends) - min(begins) if coherent else max(len(signal) for signal in signals)
        samples = fast_length(2 * max(span, self._length))
        shift = [begin - min(begins) if coherent else 0 for begin in begins]
        spectra = [np.fft.rfft(np.pad(signal, (at, 0)), samples) for signal, at in zip(signals, shift, strict=True)]
        if not coherent:
            return np.stack([self._near(spectrum * spectrum.conj(), samples) for spectrum in spectra])
        return np.stack([[self._near(spectrum * other.conj(), samples) for other in spectra] for spectrum in spectra])

    def _near(self, spectrum: Complex128Array, samples: int) -> Complex128Array:
        """A cross spectrum at this transform's bins, of its correlation's lags within half the transform."""
        lags = np.fft.irfft(spectrum, samples)
        half = self._length // 2
        kept = np.zeros(self._length)
        kept[:half], kept[self._length - half :] = lags[:half], lags[samples - half :]
        both = np.where((self._bins == 0) | (2 * self._bins == self._length), 1.0, 2.0)
        return np.asarray(np.fft.rfft(kept)[self._bins] * both)

    def _cut(self, filters: Complex128Array) -> Complex128Array:
        in_time = self._in_time(filters)
        in_time[:, self.tail + 1 : self._length - (self.bank.taps - 1)] = 0.0
        return self._spectrum_of(in_time)

    def _behind(self, filters: Complex128Array) -> Complex128Array:
        """The part of filters that the tail leaves out; what is half a transform later comes before the drive."""
        in_time, first = self._in_time(filters), self._length - (self.bank.taps - 1)
        in_time[:, : self.tail + 1] = 0.0
        in_time[:, (self.tail + 1 + first) // 2 :] = 0.0
        return self._spectrum_of(in_time)

    def _in_time(self, spectra: Complex128Array) -> Float64Array:
        whole = np.zeros((spectra.shape[1], self._length // 2 + 1), dtype=np.complex128)
        whole[:, self._bins] = spectra.T
        return np.fft.irfft(whole, self._length, axis=1)

    def _spectrum_of(self, green: RealArray) -> Complex128Array:
        return np.ascontiguousarray(np.fft.rfft(green, self._length, axis=1)[:, self._bins].T)

    def _transform(self, row: int) -> Complex128Array:
        return self._spectrum_of(self._quiet_reader.read(row))

    def _spectra(self, rows: Int64Array) -> Complex128Array:
        if not len(rows):
            return np.zeros((len(self._bins), 0, self.bank.actuators), dtype=np.complex128)
        return np.stack([self._quiet_spectrum(row) for row in rows.tolist()], axis=1)

    def _stack(self, number: int) -> tuple[Complex128Array, Int64Array]:
        _, rows, place = self.plan.sets[number]
        return self._spectra(rows), place


def _instants(scene: Scene, sampled: SampledScene, plan: QuietPlan) -> tuple[Int64Array, Int64Array]:
    """Knots of the plan from which the multipliers are found, and for how many knots each stands.

    Where all rests, one for each set of sources that sound together and rows that they keep quiet; else of each source
    some, evenly chosen.
    """
    sounding = np.array([_sounding(source.emission, plan.knots) for source in sampled.sources])
    if not any(changes_place(path) for path in paths_of(scene, plan.places)):
        state = np.where(sounding, plan.of_source, -1)[:, sounding.any(axis=0)]
        _, first, count = np.unique(state, axis=1, return_index=True, return_counts=True)
        longest = np.argsort(-count, kind="stable")[:MAX_STATES]
        return np.flatnonzero(sounding.any(axis=0))[first[longest]], count[longest]
    chosen: set[int] = set()
    for own in sounding:
        knots = np.flatnonzero(own)
        # Instants of a scene that moves from which the multipliers are found.
        places = np.linspace(0, len(knots) - 1, 2 * min(4, len(knots)) + 1)[1::2]
        chosen |= set(knots[places.round().astype(int)].tolist())
    return np.array(sorted(chosen), dtype=np.int64), np.ones(len(chosen), dtype=np.int64)


def _sounding(emission: Emission, knots: Int64Array) -> BoolArray:
    """Whether a source sounds between each knot and the next one, (knots,)."""
    step = knots[1] - knots[0] if len(knots) > 1 else emission.stop_sample
    return np.asarray((knots < emission.stop_sample) & (knots + step > emission.first_sample))
