"""Scenes with quiet places: rows that focus and are quiet elsewhere take the place of the bank's own.

A filter w of `wavefocus.rendering.drive.quiet_filters` is longer than the Green's functions that it is made of. It is
computed at the frequencies of a transform of twice its length, and kept from -(L - 1) samples, where the drive begins,
to `TAIL_S` after its focus. So its reversal in time is a row of L + tail samples, and the block accumulator makes
drives of such rows as it does of the bank's. The drives begin where those of other scenes do, and end a tail later.
What is cut costs level at the quiet places, which are asked for less in return; the response at the focus at its
instant stays as it is, since no tap of a Green's function meets what is cut.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, lru_cache

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.config.scene import Regularisation
from wavefocus.rendering.arrays import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.device import fast_length
from wavefocus.rendering.drive.quiet_filters import (
    Focus,
    Moment,
    Multipliers,
    find_multipliers,
    focusing,
    least_energy,
    of_rows,
    reversed_power,
)
from wavefocus.rendering.drive.windows import Events
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import GreenSource, RealArray, RowReader, to_single
from wavefocus.rendering.scene.emission import ContinuousEmission, Emission, PointEmission
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.quiet_places import PlaceRows, QuietPlan, paths_of, place_at, plan_quiet
from wavefocus.rendering.scene.sampling import SampledScene
from wavefocus.storage.drive_file import QuietTrack

TAIL_S = 0.05
"""Length of the filters after the focus; what is cut there is -40 dB of them (docs/explanation/quiet-places.md)."""
MAX_STATES = 64
MOMENTS = 4
"""Instants of a scene that moves from which the multipliers are found."""
FAINT = 1e-12
"""Bins with less of a row's energy than this, relative to the largest, are left to time reversal."""
MAX_SIGNAL_SAMPLES = 2**21
MAX_COHERENT = 16
"""Of more sources that sound together the spectra only, not the cross spectra."""
SPECTRA_BYTES = 256 * 2**20
KEY = 2**21


MISSED_DB = 0.5
"""Level above the one asked for from which it is said."""
TRACK_INSTANTS, MAX_TRACK_INSTANTS = 32, 1000
"""Instants at which a place that moves is kept in drive files, and those of all places together."""


@dataclass(frozen=True, slots=True, eq=False)
class QuietFigures:
    """Figures of the quiet places of a scene.

    tracks: The places, with the levels that the filters reach.
    plain_db, float64 (places,): Levels of plain time reversal.
    multiplier, float64 (places,): Of the equations in `wavefocus.rendering.drive.quiet_filters`, for rows in the bank's
        unit.
    energy: Of the drives over plain time reversal's.
    warnings: Levels that are not reached, and places that a source passes.
    """

    tracks: tuple[QuietTrack, ...]
    plain_db: Float64Array
    multiplier: Float64Array
    energy: float
    warnings: tuple[str, ...]


def quiet_scene(scene: Scene, bank: GreenSource, sampled: SampledScene) -> tuple[SampledScene, QuietRows]:
    """The scene as the accumulator takes it, and its rows.

    Raises InputError: a quiet place is at a focus, off the grid or not measured.
    """
    place_rows = PlaceRows(bank, sampled.interpolation)
    plan = plan_quiet(scene, bank, sampled, place_rows)
    tail = max(1, round(TAIL_S * float(bank.sample_rate_hz)))
    moments, lasts = _instants(scene, sampled, plan)
    at = [
        sampled.interpolation.nodes(
            place_at(source.path, source.speed_mm_s, source.start_s, plan.knots[moments], float(bank.sample_rate_hz))
        )
        for source in scene.sources
    ]
    rows = QuietRows(scene, sampled, bank, place_rows, plan, tail)
    foci = [list(zip(nodes.rows, nodes.weights, nodes.nearest.tolist(), strict=True)) for nodes in at]
    rows.solve(scene, moments, lasts, foci)
    sources = [
        replace(source, emission=QuietEmission(source.emission, plan, index, rows), nodes=2 * source.nodes)
        for index, source in enumerate(sampled.sources)
    ]
    return replace(sampled, sources=sources, samples=sampled.samples + tail), rows


class QuietEmission:
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
        rows = self._rows.numbers(before, made.rows, made.regularised_by)
        if (before == after).all():
            return replace(made, rows=rows)
        share = np.where(before == after, 0.0, along - low)[:, None]
        following = self._rows.numbers(after, made.rows, made.regularised_by)
        weights = np.concatenate([made.weights * (1.0 - share), made.weights * share], axis=1)
        return replace(made, rows=np.concatenate([rows, following], axis=1), weights=weights)


class QuietRows(BankRows):
    """Rows that focus like a row of the bank and are quiet elsewhere, by numbers that `numbers` gives.

    found: The multipliers, once `solve` found them.
    """

    found: Multipliers
    _bins: Int64Array

    def __init__(
        self,
        scene: Scene,
        sampled: SampledScene,
        bank: GreenSource,
        place_rows: PlaceRows,
        plan: QuietPlan,
        tail: int,
    ) -> None:
        regularisation: Regularisation = scene.regularisation
        super().__init__(sampled.interpolation.rows_of(bank), regularisation, sampled.naming)
        self.plan, self._sampled, self._tail = plan, sampled, tail
        self._most_energy = scene.output.most_energy
        self._saturates = bool(regularisation.saturation or regularisation.saturation_absolute)
        self._numbers: dict[int, int] = {}
        self._keys: list[tuple[int, int, int]] = []
        self._length = fast_length(2 * (bank.taps + tail))
        self._quiet_reader = RowReader(place_rows.rows)
        self._interpolation = place_rows.name
        self._row_error = place_rows.error([source.signal for source in sampled.sources])

    @property
    def taps(self) -> int:
        return self.bank.taps + self._tail

    def numbers(self, sets: Int64Array, rows: Int64Array, regularised_by: Int64Array) -> Int64Array:
        """Numbers of the rows that focus like `rows` (n, k) with sets of the plan, (n,), as (n, k)."""
        by = regularised_by + 1 if self._saturates else np.zeros_like(regularised_by)
        key = (sets[:, None] * KEY + rows) * KEY + by[:, None]
        different, inverse = np.unique(key, return_inverse=True)
        for key in different.tolist():
            if key not in self._numbers:
                self._numbers[key] = len(self._keys)
                self._keys.append((key // KEY // KEY, key // KEY % KEY, key % KEY - 1))
        numbers = np.array([self._numbers[key] for key in different.tolist()], dtype=np.int64)
        return np.asarray(numbers[inverse].reshape(rows.shape))

    def read(self, row: int, *, single: bool = False) -> RealArray:
        """The row of a number, (actuators, taps), over two to the bank's exponent."""
        number, focus_row, by = self._keys[row]
        green = self._measured(focus_row)
        own = self.plan.sets[number]
        sigma = self.sigma(by) if by >= 0 else None
        made = np.zeros((len(green), self.taps))
        made[:, self._tail :] = green
        focus = Focus(self._spectrum_of(green), *self._quiet(number), sigma)
        z, d = least_energy(focus, of_rows(self.found.of_place, own.place))
        filters = z * focusing(reversed_power(focus), d, self.found.slack, self._power[own.source])[:, None]
        # The accumulator multiplies by sigma; what is left of the bins without energy is the row itself.
        change = np.conj(filters / (1.0 if sigma is None else sigma)) - focus.row
        turn = np.exp(-2j * np.pi * self._tail / self._length * self._bins)
        made += self._in_time(change * turn[:, None])[:, : self.taps]
        return to_single(made) if single else made

    def figures(self) -> QuietFigures:
        """The places with their levels."""
        plan, found = self.plan, self.found
        instants = min(TRACK_INSTANTS, max(2, MAX_TRACK_INSTANTS // len(plan.places)))
        reached_db, plain_db = (10.0 * np.log10(np.maximum(level, 1e-30)) for level in (found.level, found.plain_level))
        tracks, warnings = [], list(plan.warnings)
        # What is wrong with a row is alike in no two actuators, so that their drives do not focus on it.
        true_db = 10.0 * np.log10(max(self._row_error**2 * found.energy / self.bank.actuators, 1e-30))
        if true_db > max(place.level_db for place in plan.places) - MISSED_DB:
            warnings.append(
                f"between the grid's positions, the responses at quiet places are wrong by about"
                f" {100 * self._row_error:.0f} %, so that these are no quieter than about {true_db:.0f} dB; use"
                " interpolation 'auto', or measure a finer grid"
            )
        for place, level_db in zip(plan.places, reached_db.tolist(), strict=True):
            moves = place.path.length_mm > 0
            knots = plan.knots if moves else plan.knots[:1]
            sample = knots[evenly_spread(len(knots), instants)]
            at_mm = place.at(sample, float(self.bank.sample_rate_hz)).round(6)
            source = -1 if place.source is None else place.source
            tracks.append(
                QuietTrack(
                    place.words,
                    sample,
                    at_mm,
                    place.radius_mm,
                    place.level_db,
                    round(level_db, 3),
                    source,
                    self._interpolation,
                )
            )
            if level_db > place.level_db + MISSED_DB:
                why = (
                    f"more would cost over {self._most_energy:g} times the energy of plain time reversal"
                    if found.capped
                    else "the bank's actuators cannot do more"
                )
                warnings.append(f"{place.words} reaches {level_db:.1f} dB of {place.level_db:g} dB asked; {why}")
        unit = np.ldexp(1.0, -2 * self._reader.exponent)
        return QuietFigures(tuple(tracks), plain_db, found.of_place * unit, found.energy, tuple(warnings))

    def solve(
        self,
        scene: Scene,
        moments: Int64Array,
        lasts: Int64Array,
        foci: Sequence[Sequence[tuple[Int64Array, Float64Array, int]]],
    ) -> None:
        """Find the multipliers from the foci of some moments.

        moments, int64 (moments,): Knots of the plan; `lasts` says for how many knots each stands.
        foci: Of each source and moment: rows, their weights, and the regularising row.
        """
        emissions = [source.emission for source in self._sampled.sources]
        sounding = np.array([_sounding(emission, self.plan.knots)[moments] for emission in emissions])
        green = {
            (source, m): sum(weight * self._measured(row) for row, weight
                             in zip(rows.tolist(), weights.tolist(), strict=True) if weight)
            for source, own in enumerate(foci) for m, (rows, weights, _) in enumerate(own)
            if sounding[source, m]
        }  # fmt: skip
        energy = sum(np.square(np.abs(np.fft.rfft(row, self._length, axis=1))).sum(axis=0) for row in green.values())
        self._bins = np.flatnonzero(energy > FAINT * np.max(energy))
        row_bytes = 16 * len(self._bins) * self.bank.actuators
        self._quiet_spectrum = lru_cache(max(64, SPECTRA_BYTES // row_bytes))(self._transform)
        self._quiet = lru_cache(4)(self._stack)
        stack = cache(self._stack)  # foci that keep the same rows quiet share the array, and its solution
        cross = self._emitted(scene, emissions)
        whole = np.maximum(sounding @ lasts, 1)
        made = []
        for m, knot in enumerate(moments.tolist()):
            together = np.flatnonzero(sounding[:, m]).tolist()
            rows, place = self.plan.rows_at(knot)
            quiet = self._spectra(rows)
            one_foci, applies = [], np.zeros((len(together), len(self.plan.places)), dtype=bool)
            for index, source in enumerate(together):
                number = int(self.plan.of_source[source, knot])
                own = self.plan.sets[number]
                applies[index, own.place] = True
                by = foci[source][m][2]
                one_foci.append(Focus(self._spectrum_of(green[source, m]), *stack(number), self.sigma(by), source))
            gains = self.weigh(np.array([foci[source][m][2] for source in together]))[0]
            gains = gains * np.sqrt(lasts[m] / whole[together])
            chosen = cross[np.ix_(together, together)] if cross.ndim == 3 else _diagonal(cross[together])
            made.append(Moment(one_foci, chosen * np.outer(gains, gains)[..., None], quiet, place, applies))
        self._power = cross.real if cross.ndim == 2 else np.einsum("jjf->jf", cross).real
        self.found = find_multipliers(
            made,
            np.array([place.level for place in self.plan.places]),
            response_error=scene.regularisation.response_error,
            most_energy=self._most_energy,
            cut=self._cut,
        )

    def _emitted(self, scene: Scene, emissions: Sequence[Emission]) -> Complex128Array:
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
        coherent = len(signals) <= MAX_COHERENT and max(ends) - min(begins) <= MAX_SIGNAL_SAMPLES
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
        in_time[:, self._tail + 1 : self._length - (self.bank.taps - 1)] = 0.0
        return np.ascontiguousarray(np.fft.rfft(in_time, axis=1)[:, self._bins].T)

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
        own = self.plan.sets[number]
        return self._spectra(own.rows), own.place


def _instants(scene: Scene, sampled: SampledScene, plan: QuietPlan) -> tuple[Int64Array, Int64Array]:
    """Knots of the plan from which the multipliers are found, and for how many knots each stands.

    Where all rests, one for each set of sources that sound together and rows that they keep quiet; else of each source
    some, evenly chosen.
    """
    sounding = np.array([_sounding(source.emission, plan.knots) for source in sampled.sources])
    if not any(path.length_mm > 0 for path in paths_of(scene, plan.places)):
        state = np.where(sounding, plan.of_source, -1)[:, sounding.any(axis=0)]
        _, first, count = np.unique(state, axis=1, return_index=True, return_counts=True)
        longest = np.argsort(-count, kind="stable")[:MAX_STATES]
        return np.flatnonzero(sounding.any(axis=0))[first[longest]], count[longest]
    chosen: set[int] = set()
    for own in sounding:
        knots = np.flatnonzero(own)
        places = np.linspace(0, len(knots) - 1, 2 * min(MOMENTS, len(knots)) + 1)[1::2]
        chosen |= set(knots[places.round().astype(int)].tolist())
    return np.array(sorted(chosen), dtype=np.int64), np.ones(len(chosen), dtype=np.int64)


def _sounding(emission: Emission, knots: Int64Array) -> BoolArray:
    """Whether a source sounds between each knot and the next one, (knots,)."""
    step = knots[1] - knots[0] if len(knots) > 1 else emission.stop_sample
    return np.asarray((knots < emission.stop_sample) & (knots + step > emission.first_sample))


def _diagonal(spectra: Complex128Array) -> Complex128Array:
    whole = np.zeros((len(spectra), *spectra.shape), dtype=np.complex128)
    whole[np.arange(len(spectra)), np.arange(len(spectra))] = spectra
    return whole
