"""Rows of a bank judged against their neighbours: which differ, and in what.

Every row is predicted from its neighbours (`wavefocus.calibration.neighbour_prediction`), or, where the grid is too
coarse for that, from all other rows by waves (`wavefocus.calibration.coarse_grid.left_out_rows`). By how much
predictions miss is learned from the neighbourhood itself, frequency by frequency: noise, a coarse grid, the rim and the
field of a near actuator then raise the limit, and where a prediction explains too little nothing is judged.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration import BoolArray, Complex128Array, Float64Array, Int64Array
from wavefocus.calibration.blas import one_blas_thread
from wavefocus.calibration.coarse_grid.left_out_rows import RowsByWaves, waves_of_rows
from wavefocus.calibration.neighbour_difference import (
    EXPLAINED,
    NeighbourDifference,
    cause_of,
    relative_norm,
    swapped,
    together,
)
from wavefocus.calibration.neighbour_prediction import Gains, RowsPredicted, common_gains
from wavefocus.calibration.numerics import transform_at

if TYPE_CHECKING:
    from wavefocus.calibration.coarse_grid.rim_waves import WavesFound

LINEAR_FREQUENCIES, OCTAVE_FREQUENCIES = 16, 16
LEARNED_FROM = 12
"""Nearest neighbours from whose errors the expected error of a prediction is taken."""
NEAREST, RANK = 8, 3
"""A row that differs does so far more than the third worst of its eight nearest neighbours."""
MIN_DIFFERENCE = 0.02
"""Relative to the row; smaller differences are not looked for."""
LENIENCY_OF_WAVES, MIN_DIFFERENCE_BY_WAVES = 2.5, 0.04
"""Waves miss more at the far edge than what is learned nearer to the actuator: up to 12 times the mean square there."""
MIN_SHARE_BY_WAVES = 0.01
"""Smaller differences, relative to the median level of the actuator's rows, are not looked for: faint rows are mostly
what the waves leave of loud ones."""
MIN_PREDICTION_ERROR = 0.002
"""No prediction is taken to be better than this."""
MISSES, FACTOR = 6.0, 30.0
"""Limits of the mean square of the errors and of the common factor's square over their expectations; on clean banks
of the virtual rig they are 1.6 and 8 at most."""
SOURCE_SPACINGS, SOURCE_SPACINGS_OF_WAVES = 4.0, 2.0
"""Nearer to an actuator than so many grid spacings, the field is not that of waves from elsewhere, nor quite that of
the actuator's own wave."""
UNSURE = 0.06
"""Rows whose level is not predicted within this are not judged."""
MAX_ROUNDS = 40
SEARCHES = 3
MAX_RENEWED, MAX_RENEWED_SHARE = 30_000, 0.25
"""Predictions that are renewed at most (half a minute), and so many more per row. One differing row needs 30, a
position that was measured elsewhere some thousands; rows that do not belong together need a hundred each."""
RENEWED_BY_WAVES = 30
"""All of an actuator's rows are renewed at once by waves, which takes as long as so many."""
MIN_COARSE_MM, COARSE, COARSE_QUANTILE = 5.0, 0.3, 0.1
"""On grids coarser than this, a nominal gel's half wavelength at 480 Hz, waves predict where nine tenths of the rows
miss so much of the band's upper quarter when neighbours predict them."""
MAX_OUT = 0.5
"""Where more than this share of the rows differ, none is judged: it is not the rows that are wrong."""
MIN_ROWS = 3
"""So many rows of a position make a whole that can differ by one cause."""
GAIN_SIGMAS = 8.0
"""A common factor on a position's rows is one that differs from 1 by so many of its standard deviations."""
PLACES = tuple((radius, 12) for radius in (0.125, 0.25, 0.5, 0.75, 1.0, 1.5))
"""Circles in grid spacings, and directions, on which a mirror that points elsewhere is looked for."""
PLACES_BY_WAVES = tuple((number / 8, 6 * number) for number in range(1, 13))
"""The same where the grid is coarse: an eighth of a wavelength apart."""


@dataclass(frozen=True, slots=True)
class NeighbourResult:
    """All that differs in a bank.

    differences: By position.
    judged, bool (positions, actuators): Rows that could be judged.
    incoherent: Whether so many rows contradict their neighbours that the search for the wrong ones was given up; then
        none is judged.
    """

    differences: tuple[NeighbourDifference, ...]
    judged: BoolArray
    incoherent: bool = False


class RowsAtFrequencies:
    """Fourier transforms of rows at some frequencies of a band.

    positions, actuators, taps: Size of the bank.
    sample_rate_hz: Its rate in Hz.
    band_hz: Its band; by default up to 0.45 of the rate.

    frequency_hz, float64 (frequencies,): Ascending: as many evenly spaced as by octaves.
    values, complex128 (positions, actuators, frequencies): Zeros where nothing was set.
    """

    def __init__(
        self, positions: int, actuators: int, taps: int, sample_rate_hz: float, band_hz: tuple[float, float] | None
    ) -> None:
        low_hz, high_hz = (0.0, 0.45 * sample_rate_hz) if band_hz is None else band_hz
        high_hz = min(0.97 * high_hz, 0.48 * sample_rate_hz)
        low_hz = min(max(1.2 * low_hz, 1.5 * sample_rate_hz / taps, high_hz / 1000.0), 0.5 * high_hz)
        octaves = np.geomspace(low_hz, high_hz, OCTAVE_FREQUENCIES + 2)[1:-1]
        self.frequency_hz: Float64Array = np.sort(
            np.concatenate([np.linspace(low_hz, high_hz, LINEAR_FREQUENCIES), octaves])
        )
        self._rate_hz = sample_rate_hz
        self.values: Complex128Array = np.zeros((positions, actuators, len(self.frequency_hz)), dtype=np.complex128)

    def set(self, position: int, green: NDArray[np.floating]) -> None:
        """Take a position's rows, (actuators, taps)."""
        peak = float(np.abs(green).max(initial=0.0))
        if not 0 < peak < np.inf:
            self.values[position] = 0.0
            return
        self.values[position] = transform_at((green / peak).astype(np.float32), self.frequency_hz, self._rate_hz) * peak


class NeighbourJudge:
    """Judges rows of a bank against their neighbours.

    position_mm, float64 (positions, 2): Grid in millimetres.
    actuator_mm, float64 (actuators, 2): Actuators in millimetres, NaN where unknown.
    spectra: The rows.
    usable, bool (positions,): Rows that are predicted from and judged.
    modelled, bool (positions,): Rows that waves predict and judge where the grid is too coarse for neighbours and the
        actuators' places are known; those off the grid, too. That takes 5 to 10 s of processor time more. By default
        only neighbours judge.
    waves: Gives the waves of rows that are right, in a third of that time if they were found before; None for none. By
        default they are found from the rows that are judged.

    judged, bool (positions, actuators): Rows that can be judged.
    """

    def __init__(
        self,
        position_mm: Float64Array,
        actuator_mm: Float64Array,
        spectra: RowsAtFrequencies,
        usable: BoolArray,
        modelled: BoolArray | None = None,
        waves: Callable[[], WavesFound | None] | None = None,
    ) -> None:
        values, self._frequency_hz = spectra.values, spectra.frequency_hz
        there = (np.abs(values).max(axis=(1, 2), initial=0.0) > 0) & np.isfinite(position_mm).all(axis=1)
        usable, modelled = usable & there, there & (False if modelled is None else modelled)
        # In the largest value's unit, so that a bank in any unit fits.
        whole = np.abs(values[usable | modelled]).max(initial=0.0)
        self._values = values / whole if whole > 0 else values
        self._position_mm = position_mm
        self._actuator_mm = actuator_mm
        self._predict_by(RowsPredicted(position_mm, self._values, self._frequency_hz, usable))
        self._modelled, self._finds_waves = modelled, waves is None
        if modelled.any() and self._too_coarse():
            self._predict_by_waves(waves() if waves else self._waves_of(modelled))

    def _predict_by(self, rows: RowsPredicted | RowsByWaves) -> None:
        """Begin anew with predictions of all rows."""
        self._rows = rows
        self._neighbours = rows.neighbours
        self._all = np.array(sorted(self._neighbours), dtype=np.int64)
        shape = self._values.shape
        self._out: BoolArray = np.zeros(shape[:2], dtype=bool)
        self.judged: BoolArray = np.zeros(shape[:2], dtype=bool)
        self._suspect: BoolArray = np.zeros(shape[:2], dtype=bool)
        self._tried: BoolArray = np.zeros(shape[:2], dtype=bool)
        self._renewed, self._most_renewed = 0, MAX_RENEWED + MAX_RENEWED_SHARE * shape[0] * shape[1]
        self._gain: dict[int, float] = {}
        self._left_out: dict[int, BoolArray] = {}
        if not len(self._all):
            return
        self._near_field = self._near_field_of(self._actuator_mm)
        level = np.linalg.norm(self._values, axis=2)
        usual_level = np.median(level[self._all], axis=0)
        self._faintness: Float64Array = usual_level / np.maximum(level, 1e-9 * usual_level + np.finfo(np.float64).tiny)
        self._users: dict[int, list[int]] = {}
        for position, around in self._neighbours.items():
            for row in around[1:].tolist():
                self._users.setdefault(row, []).append(position)
        near = [np.resize(self._neighbours[position][1:], LEARNED_FROM) for position in self._all.tolist()]
        self._near: Int64Array = np.zeros((shape[0], LEARNED_FROM), dtype=np.int64)
        self._near[self._all] = near
        self._errors, variance = rows.errors()
        self._variance_of_all, self._variance = variance, variance.copy()
        self._typical: Float64Array = np.zeros(shape)
        self._misses: Float64Array = np.full(shape[:2], np.nan)
        self._weight: Float64Array = np.full(shape[:2], np.nan)
        self._factor: Complex128Array = np.full(shape[:2], np.nan + 0j)
        strength = np.abs(self._errors) ** 2 / self._variance
        # Where neighbours lie on one side only, errors are as uncertain as predictions are.
        one_sided = np.log(variance[self._all] / np.median(variance[self._all], axis=0)).mean(axis=(1, 2))
        self._one_sided: Float64Array = np.ones((shape[0], 1))
        self._one_sided[self._all, 0] = np.exp(0.5 * np.maximum(one_sided, 0.0))
        self._common = np.maximum(np.nanmedian(strength[self._all], axis=0), np.finfo(np.float64).tiny)
        self._learn(self._all)

    def _waves_of(self, rows: BoolArray) -> WavesFound | None:
        return waves_of_rows(self._position_mm, self._actuator_mm, self._values, self._frequency_hz, rows)

    def _predict_by_waves(self, found: WavesFound | None) -> bool:
        """Begin anew with predictions by waves; False, and nothing changes, where none fit."""
        rows = self._position_mm, self._actuator_mm, self._values, self._frequency_hz, self._modelled
        with suppress(np.linalg.LinAlgError):
            if found is not None:
                self._predict_by(RowsByWaves(*rows, found))
                return True
        return False

    @property
    def by_waves(self) -> bool:
        """Whether rows are predicted by waves from the actuators and the rim, from all other positions."""
        return isinstance(self._rows, RowsByWaves)

    def find(self) -> NeighbourResult:
        """Find all rows that differ, the worst of each neighbourhood first, so that no row is blamed for another.

        What a wrong row makes of its neighbours' predictions hides it among them. So whatever is suspect is left out
        of all predictions first, and judged when no suspect is left among its neighbours.
        """
        if len(self._all):
            with one_blas_thread():
                self._search()
                sound: BoolArray = np.asarray(~self._out.any(axis=1))
                # Wrong rows had a part in the waves that were found.
                spoiled = self.by_waves and self._finds_waves and not sound.all()
                if spoiled and self._predict_by_waves(self._waves_of(self._modelled & sound)):
                    self._search()
        if self._renewed > self._most_renewed or self._out.sum() > MAX_OUT * len(self._all) * self._out.shape[1]:
            return NeighbourResult((), np.zeros_like(self.judged), incoherent=True)
        rows = {
            int(position): np.flatnonzero(self._out[position]) for position in np.flatnonzero(self._out.any(axis=1))
        }
        differences = [difference for position, out in rows.items() for difference in self._named(position, out)]
        return NeighbourResult(tuple(differences), self.judged)

    def _search(self) -> None:
        self._suspect[self._all] = self._differing(self._all, strict=False)
        if self._suspect.any():
            self._leave_out_by_gain()
        sure = self._out.copy()
        for _ in range(SEARCHES):
            for _ in range(MAX_ROUNDS):
                tried = self._worst()
                if self._renewed > self._most_renewed:
                    return
                if not tried.any():
                    break
                self._tried |= tried
                self._leave_out(tried)
                self._let_back(self._out & ~sure & ~self._next_to_suspects())
            self._let_back(self._out & ~sure)
            # A row that was let back while another wrong one was in use is tried once more.
            self._tried = self._out.copy()
            sure = self._out.copy()

    def _leave_out_by_gain(self) -> None:
        """Leave out positions whose rows all have one wrong factor, found together however near each other they are."""
        if isinstance(self._rows, RowsByWaves):
            return
        for _ in range(SEARCHES):
            # The wrong ones found so far no longer count in what predictions usually miss.
            gains = common_gains(self._rows.patches, self._rows.coefficients, self._values, self._typical, self.judged)
            wrong = self._wrong_by_gain(gains)
            found = set(wrong) - set(self._gain)
            self._gain |= {position: float(gains.value[position]) for position in wrong}
            if not found:
                break
            new = np.isin(np.arange(len(self._out)), sorted(found))
            self._leave_out(new[:, None] & self.judged)
        self._tried |= self._out

    def _wrong_by_gain(self, gains: Gains) -> list[int]:
        """Positions whose factors explain their errors; next to one that is wrong otherwise, factors mean nothing."""
        enough = (np.abs(gains.value - 1.0) > MIN_DIFFERENCE) & (gains.sigmas > GAIN_SIGMAS)
        enough &= self.judged.sum(axis=1) >= MIN_ROWS
        wrong: list[int] = []
        spoiled: set[int] = set()
        for position in sorted(np.flatnonzero(enough).tolist(), key=lambda row: -gains.sigmas[row]):
            if position in spoiled:
                continue
            if gains.explained[position] > EXPLAINED:
                wrong.append(position)
            else:
                spoiled.update(self._users.get(position, ()))
        return wrong

    # -- how much predictions miss --------------------------------------------------------------

    def _too_coarse(self) -> bool:
        """Whether positions are far apart and neighbours predict next to nothing of the band's upper quarter."""
        if not len(self._all) or self._rows.spacing_mm <= MIN_COARSE_MM:
            return not len(self._all)
        upper = slice(3 * len(self._frequency_hz) // 4, None)
        there = np.linalg.norm(self._values[self._all, :, upper], axis=2)
        relative = np.linalg.norm(self._errors[self._all, :, upper], axis=2) / np.maximum(
            there, np.finfo(np.float64).tiny
        )
        # Few wrong rows spoil many predictions, of which only the best are looked at.
        return bool(np.quantile(relative, COARSE_QUANTILE) > COARSE)

    def _near_field_of(self, actuator_mm: Float64Array) -> Float64Array:
        """Part of a row that is not of waves from elsewhere, on an arbitrary scale, (positions, actuators)."""
        power = np.square(np.abs(self._values)).sum(axis=2)
        loudest = self._position_mm[np.argsort(-power, axis=0)[:3]]  # (3, actuators, 2)
        guess = np.median(loudest, axis=0)
        source_mm = np.where(np.isfinite(actuator_mm), actuator_mm, guess)
        far = np.hypot(*(self._position_mm[:, None] - source_mm).transpose(2, 0, 1))
        # Waves hold the actuators' own.
        reach = (
            (SOURCE_SPACINGS_OF_WAVES if self.by_waves else SOURCE_SPACINGS)
            * self._rows.spacing_mm
            / np.maximum(far, 1e-3 * self._rows.spacing_mm)
        )
        return np.asarray(np.square(reach))

    def _learn(self, positions: Int64Array) -> None:
        """From the errors of their neighbourhoods: how much each prediction should miss, and how much it does."""
        for first in range(0, len(positions), 256):
            some = positions[first : first + 256]
            near = self._near[some]
            strength = np.abs(self._errors[near]) ** 2 / self._variance[near]
            strength[self._out[near]] = np.nan
            known = np.isfinite(strength).all()
            typical = (np.median if known else _nanmedian)(strength, axis=1) / np.log(2.0)
            typical = np.where(np.isfinite(typical), typical, self._common)
            smooth = typical.copy()
            smooth[..., 1:-1] = 0.25 * (typical[..., :-2] + typical[..., 2:]) + 0.5 * typical[..., 1:-1]
            errors, values = self._errors[some], self._values[some]
            typical = np.maximum(smooth * self._variance[some], np.square(MIN_PREDICTION_ERROR * np.abs(values)))
            typical = np.maximum(typical, np.finfo(np.float64).tiny)
            predicted = values - errors
            weight = (np.square(np.abs(predicted)) / typical).sum(axis=2)
            self._typical[some] = typical
            self._misses[some] = (np.square(np.abs(errors)) / typical).mean(axis=2)
            self._weight[some] = weight
            self._factor[some] = (predicted.conj() * values / typical).sum(axis=2) / np.maximum(weight, 1e-300)
            self.judged[some] = weight > 0.5 / UNSURE**2

    def _differing(self, positions: Int64Array, *, strict: bool) -> BoolArray:
        """Which rows differ, or, less strictly, may differ, (positions, actuators)."""
        nearest = self._near[positions][:, :NEAREST]
        misses, weight = self._misses[positions], self._weight[positions]
        # With neighbours left out, what no model of waves covers grows faster than what the kernel expects.
        fewer = np.maximum((self._variance[positions] / self._variance_of_all[positions]).mean(axis=2), 1.0)
        leniency, share = (LENIENCY_OF_WAVES, MIN_SHARE_BY_WAVES) if self.by_waves else (1.0, 0.0)
        least = (MIN_DIFFERENCE_BY_WAVES if self.by_waves else MIN_DIFFERENCE) + share * self._faintness[positions]
        least = least * fewer * (1.0 + self._near_field[positions] * fewer**3)
        factor = self._factor[positions] - 1.0
        # A wrong row may hide that its neighbours can be judged.
        judged = self.judged[positions] if strict else np.isfinite(misses)
        off = np.abs(factor)
        by_factor = np.square(np.abs(self._factor - 1.0)) * self._weight
        usual = self._usual(self._misses, nearest) if strict else np.ones_like(misses)
        usual_factor = self._usual(by_factor, nearest) if strict else np.ones_like(misses)
        usual, usual_factor = usual * self._one_sided[positions], usual_factor * self._one_sided[positions]
        usual, usual_factor = np.maximum(usual, leniency), np.maximum(usual_factor, leniency)
        found = (misses > MISSES * usual) & (misses * len(self._frequency_hz) > np.square(least) * weight)
        found |= (by_factor[positions] > FACTOR * usual_factor) & (off > least)
        # All of a position by one factor: the median over its rows shows less than each of them could.
        sure = self.judged[positions]
        factor = np.where(sure, factor, np.nan)
        middle = np.abs(_nanmedian(factor.real, axis=1) + 1j * _nanmedian(factor.imag, axis=1))
        count = np.maximum(sure.sum(axis=1), 1)
        spread = _nanmedian(np.where(sure, np.sqrt(usual_factor / weight), np.nan), axis=1)
        whole = (count >= MIN_ROWS) & (middle > _nanmedian(np.where(sure, least, np.nan), axis=1))
        whole &= middle * np.sqrt(count) > np.sqrt(FACTOR) * spread
        found = (found | whole[:, None]) & judged
        mostly = (count >= MIN_ROWS) & (2 * found.sum(axis=1) > count)
        return np.asarray(found | (mostly[:, None] & judged))

    def _usual(self, figure: Float64Array, nearest: Int64Array) -> Float64Array:
        """The third largest of the neighbours' figures, 1 at least."""
        around = np.where(self._out[nearest], 0.0, np.nan_to_num(figure[nearest]))
        return np.asarray(np.maximum(np.sort(around, axis=1)[:, -RANK], 1.0))

    # -- the worst first ----------------------------------------------------------------------------

    def _worst(self) -> BoolArray:
        """Of the suspect rows, those that miss most in their neighbourhood, (positions, actuators)."""
        suspect = self._suspect & ~self._tried & ~self._out
        some = np.flatnonzero(suspect.any(axis=1))
        energy = np.zeros(suspect.shape)
        strength = np.abs(self._errors[some]) ** 2 / self._variance[some] / self._common
        energy[some] = strength.sum(axis=2)
        whole = suspect.sum(axis=1) > 0.5 * max(suspect.shape[1], 2 * MIN_ROWS)
        total = np.where(whole, np.log1p(energy).sum(axis=1), -np.inf)
        energy[~suspect] = 0.0
        chosen = np.zeros_like(suspect)
        for position in some.tolist():
            around = self._neighbours[position][1:]
            if whole[position]:
                largest = bool(total[position] >= total[around].max())
                chosen[position] = ~self._tried[position] & largest
            elif not whole[around].any():
                chosen[position] = suspect[position] & (energy[position] >= energy[around].max(axis=0))
        return chosen

    def _next_to_suspects(self) -> BoolArray:
        """Rows that are left out and still have a suspect among the neighbours that predict them."""
        suspect = self._suspect & ~self._tried
        spoiled = np.zeros_like(suspect)
        for position in np.flatnonzero(self._out.any(axis=1)).tolist():
            spoiled[position] = suspect[self._neighbours[position][1:]].any(axis=0)
        return spoiled

    def _leave_out(self, tried: BoolArray) -> None:
        self._out |= tried
        self._renew(np.flatnonzero(tried.any(axis=1)))

    def _let_back(self, tried: BoolArray) -> None:
        """Use those rows again that agree, now that they and other suspects are left out of the predictions."""
        positions = np.flatnonzero(tried.any(axis=1))
        if not len(positions):
            return
        back = np.zeros_like(self._out)
        back[positions] = self._out[positions] & tried[positions] & ~self._differing(positions, strict=True)
        if back.any():
            self._out &= ~back
            self._renew(np.flatnonzero(back.any(axis=1)))

    def _renew(self, changed: Int64Array) -> None:
        """Predict again what was predicted from some positions' rows, without those that are left out."""
        if isinstance(self._rows, RowsByWaves):
            self._renew_by_waves(self._rows)
            return
        predicted = {user for position in changed.tolist() for user in self._users.get(position, ())}
        predicted.update(changed.tolist())
        for position in sorted(predicted):
            rows = self._neighbours[position]
            out = self._out[rows]
            out[0] = False
            changed_for = (out != self._left_out.get(position, np.zeros_like(out))).any(axis=0)
            self._left_out[position] = out
            for pattern in {column.tobytes() for column in out.T[changed_for]}:
                left_out = np.frombuffer(pattern, dtype=bool)
                actuators = np.flatnonzero(changed_for & (out == left_out[:, None]).all(axis=0))
                self._renewed += 1
                errors, variance = self._rows.error_without(position, rows[left_out], actuators)
                self._errors[position, actuators], self._variance[position, actuators] = errors, variance
        learned = set(predicted)
        for position in predicted:
            learned.update(self._users.get(position, ()))
        again = np.array(sorted(learned), dtype=np.int64)
        self._learn(again)
        self._suspect[again] = self._differing(again, strict=False)

    def _renew_by_waves(self, rows: RowsByWaves) -> None:
        for actuator, out in enumerate(self._out.T):
            before = self._left_out.get(actuator, np.zeros_like(out))
            if (out != before).any():
                self._left_out[actuator] = out.copy()
                self._renewed += RENEWED_BY_WAVES
                found = rows.errors_without(actuator, np.flatnonzero(out))
                self._errors[:, actuator], self._variance[:, actuator] = found
        self._learn(self._all)
        self._suspect[self._all] = self._differing(self._all, strict=False)

    # -- what differs ---------------------------------------------------------------------------------

    def _named(self, position: int, out: Int64Array) -> Iterable[NeighbourDifference]:
        values, errors = self._values[position], self._errors[position]
        predicted, typical = values - errors, self._typical[position]
        judged = np.flatnonzero(self.judged[position] | self._out[position])
        if len(out) > 1 and 2 * len(out) > len(judged):
            cause = cause_of(values[judged], predicted[judged], typical[judged], self._frequency_hz)
            if cause is None:
                cause = self._place(position, judged)
            if cause is None and position in self._gain:
                gain = self._gain[position]
                level_db = 20.0 * float(np.log10(max(abs(gain), 1e-10)))
                cause = {"kind": "level" if gain > 0 else "polarity", "level_db": level_db}
            if cause is not None:
                relative = relative_norm(errors[judged], predicted[judged])
                whole = len(out) == len(judged)
                return [NeighbourDifference(position, tuple(judged.tolist()), relative=relative, whole=whole, **cause)]  # type: ignore[arg-type]
        found: list[NeighbourDifference] = []
        for actuator in out.tolist():
            other = swapped(actuator, values, predicted, typical)
            row = values[actuator], predicted[actuator], typical[actuator]
            cause = cause_of(*row, self._frequency_hz, [other])
            cause = cause or {"kind": "other"}
            relative = relative_norm(errors[actuator], predicted[actuator])
            found.append(NeighbourDifference(position, (actuator,), relative=relative, **cause))  # type: ignore[arg-type]
        return together(found, whole=len(out) == len(judged))

    def _place(self, position: int, actuators: Int64Array) -> dict[str, object] | None:
        """The place whose rows a position has instead of its own."""
        values, typical = self._values[position, actuators], self._typical[position, actuators]
        differs = float((np.square(np.abs(self._errors[position, actuators])) / typical).sum())
        others = np.array([other for other in self._all.tolist() if other != position and not self._out[other].any()])
        best, place = np.inf, None
        for first in range(0, len(others), 256):
            some = others[first : first + 256]
            missed = np.square(np.abs(self._values[some][:, actuators] - values)) / typical
            left = missed.sum(axis=(1, 2))
            if left.min() < best:
                best, place = float(left.min()), self._position_mm[some[int(left.argmin())]]
        offset_mm = self._rows.spacing_mm * _places_around(PLACES_BY_WAVES if self.by_waves else PLACES)
        wrong = self._out.copy()
        wrong[position] = True
        right = np.where(wrong[..., None], self._values - self._errors, self._values)
        around = self._rows.at(position, offset_mm, right)[:, actuators]
        left = (np.square(np.abs(around - values)) / typical).sum(axis=(1, 2))
        if left.min() < best:
            best, place = float(left.min()), self._position_mm[position] + offset_mm[int(left.argmin())]
        if place is None or best > (1.0 - EXPLAINED) * differs:
            return None
        return {"kind": "elsewhere", "place_mm": (float(place[0]), float(place[1]))}


def _places_around(rings: Iterable[tuple[float, int]]) -> Float64Array:
    """Places (n, 2) on circles, each of a radius and a number of directions."""
    turns = [radius * np.exp(2j * np.pi * np.arange(count) / count) for radius, count in rings]
    places = np.concatenate(turns)
    return np.stack([places.real, places.imag], axis=1)


def _nanmedian(values: Float64Array, axis: int) -> Float64Array:
    """As numpy's, without a warning where there is nothing but NaN."""
    ordered = np.sort(values, axis=axis)
    count = np.isfinite(ordered).sum(axis=axis, keepdims=True)
    middle = [np.clip(index, 0, None) for index in ((count - 1) // 2, count // 2)]
    found = 0.5 * sum(np.take_along_axis(ordered, index, axis) for index in middle)
    return np.asarray(np.squeeze(found, axis))
