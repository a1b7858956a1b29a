"""Causes of a scan that differs from its prediction.

A predicted response is a sum over actuators, ``Y(x) = sum_i G_i(x) F_i`` at each frequency, so each cause changes it in
a way that follows from bank and drive: one factor and delay per actuator, two drives exchanged, one speed of the waves,
one affine error of the mirror. Differences count in units of what is allowed: the noise, and 1 % of each response.

A cause is named if it explains 95 % of the excess, that is of the squared difference beyond noise, if what it leaves is
within the tolerance of the verification, and if no other cause explains as much within 2 %. Else nothing is named.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.crosstalk import Crosstalk
from wavefocus.calibration.evidence import CERTAIN_SHARE, MOST, SILENT, TOLERANCE
from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.verify.mirror_error import (
    MIN_SPACINGS,
    BankAsField,
    MirrorFit,
    affine_value,
    displaced,
    displacement_mm,
)
from wavefocus.rendering.verify.results import ActuatorFigures, Sentinel, Symptom, SymptomCode
from wavefocus.rendering.verify.superposition import (
    MIN_DB,
    MIN_DELAY_S,
    TIE,
    ActuatorErrors,
    Block,
    Blocks,
    block_of,
    energy,
    fitted_errors,
    grouped_errors,
    sentinel_block,
    squares_left,
)

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.rendering.verify.comparison import FieldComparison

MAX_ROWS, MIN_ROWS, MIRROR_ROWS = 48, 4, 36
_MAX_SENTINEL_ACTUATORS = 128
"""The sentinel's equations grow with the square of the number of actuators."""
MAX_CAUSES = 3
_SPEEDS = (-0.08, -0.06, -0.04, -0.03, -0.02, -0.01, 0.0, 0.01, 0.02, 0.03, 0.04, 0.06, 0.08)
_MIN_SPEED = TOLERANCE / (4 * 2 * np.pi)
"""Smaller changes, 0.2 %, are not named: four wavelengths away they make an error that a verification allows."""


@dataclass(frozen=True, slots=True)
class _State:
    """Blocks with the causes found so far put right.

    change: Share by which waves are faster than in the bank.
    displaced: Whether the mirror's error is put right.
    """

    blocks: Blocks
    errors: ActuatorErrors
    change: float = 0.0
    displaced: bool = False

    @property
    def left(self) -> float:
        """Sum of squares of the differences, in units of what is allowed."""
        return squares_left(self.blocks)

    @property
    def noise(self) -> float:
        """Part of the noise in it."""
        return sum(block.noise for block in self.blocks)

    @property
    def size(self) -> float:
        """Sum of squares of the responses."""
        return sum(energy(block.response) for block in self.blocks)

    @property
    def responses(self) -> int:
        """Number of responses, which is the sum of squares that is allowed beside the noise."""
        return sum(len(block.response) for block in self.blocks)


@dataclass(frozen=True, slots=True)
class _Cause:
    """A cause, the sum of squares that it leaves, and the state with it put right; without symptoms it is too small."""

    symptoms: tuple[Symptom, ...]
    left: float
    apply: Callable[[], _State]


def diagnose(
    fields: FieldComparison,
    bank: GreenSource,
    sentinel: Sentinel | None = None,
    *,
    error_limit: float,
    model_error: float,
    nonlinear_share: float | None = None,
) -> tuple[tuple[Symptom, ...], tuple[ActuatorFigures, ...]]:
    """Name the causes of a difference between scan and prediction.

    fields: Both fields at some frequencies.
    bank: What the prediction is made of.
    sentinel: The bank's sentinel position measured again, each actuator by itself: causes are found in it that the
        scene hardly shows.
    error_limit: Largest error that passes: of the whole, and of what the causes leave.
    model_error: Error without the noise's part.
    nonlinear_share: Share of the squared difference that is not there when the scene is played quieter; None where it
        was not.

    Returns what is wrong, the largest cause first, and each actuator against the bank, none where the error is not
    explained.
    """
    search = _Search(fields, bank, sentinel)
    if nonlinear_share is not None and nonlinear_share >= CERTAIN_SHARE and model_error > error_limit:
        percent = 100.0 * model_error * float(np.sqrt(nonlinear_share))
        return (Symptom("nonlinear", (), percent, nonlinear_share),), ()
    state, found = search.state, _chain(search, error_limit)
    if found:
        pairs = zip(found, _shares(state, found), strict=True)
        symptoms = (replace(symptom, explained=share) for cause, share in pairs for symptom in cause.symptoms)
        return tuple(symptoms), _actuator_figures(found[-1].apply())
    if model_error <= error_limit or state.left - state.noise <= state.responses:
        return (), _actuator_figures(state)
    few = (cause.left for cause in search.first if 0 < len(cause.symptoms) <= MAX_CAUSES)
    # Share of the scan that the prediction resembles, after the cause that explains most.
    alike = float(np.clip(1.0 - min([state.left, *few]) / state.size, 0.0, 1.0))
    if alike < MOST:
        # Something heavy on a stiff plate looks the same.
        return (Symptom("wrong_bank", (), fields.correlation_median, 1.0 - alike, certain=False),), ()
    return (Symptom("unexplained", explained=0.0, certain=False),), ()


def _chain(search: _Search, error_limit: float) -> list[_Cause]:
    """At most three causes, one after the other, that explain enough together; none where they do not."""
    first, found = search.state, list[_Cause]()
    state, left, named = first, first.left - first.noise, 0

    def is_enough() -> bool:
        return left <= (1.0 - CERTAIN_SHARE) * (first.left - first.noise) and left <= error_limit**2 * first.size

    while left > first.responses and named < MAX_CAUSES:
        causes = list(search.causes(state)) if found else search.first
        cause = _only(causes, state, MAX_CAUSES - named)
        # A cause behind those that explain enough must explain as much of what they leave.
        if cause is None or (found and is_enough() and cause.left - first.noise > (1.0 - CERTAIN_SHARE) * left):
            break
        found, state = [*found, cause], cause.apply()
        left, named = cause.left - first.noise, named + len(cause.symptoms)
    return found if found and is_enough() and min(_shares(first, found)) >= CERTAIN_SHARE else []


def _only(causes: list[_Cause], state: _State, most: int) -> _Cause | None:
    """The cause of at most so many symptoms that leaves least, if none leaves as little within 2 % of the excess."""
    causes = sorted((cause for cause in causes if 0 < len(cause.symptoms) <= most), key=lambda cause: cause.left)
    if not causes:
        return None
    tie = TIE * (state.left - state.noise)
    return None if len(causes) > 1 and causes[1].left - causes[0].left < tie else causes[0]


def _shares(first: _State, found: list[_Cause]) -> list[float]:
    """What each cause takes off, of what the others leave."""
    left = np.array([first.left, *(cause.left for cause in found)])
    taken, beyond = left[:-1] - left[1:], left[-1] - first.noise
    return [float(np.clip(part / max(part + max(beyond, 0.0), 1e-12), 0.0, 1.0)) for part in taken]


class _Search:
    """What all causes are looked for in: some of the compared positions, and the sentinel position."""

    def __init__(self, fields: FieldComparison, bank: GreenSource, sentinel: Sentinel | None) -> None:
        self._bank, spectra = bank, fields.spectra
        most = int(np.clip((64 << 20) // (4 * bank.actuators * bank.taps), MIN_ROWS, MAX_ROWS))
        chosen = evenly_spread(len(fields.position_index), most)
        rows = fields.position_index[chosen]
        blocks: Blocks = (
            block_of(
                np.stack([np.asarray(bank.green(int(row)), np.float32) for row in rows]),
                np.arange(len(rows)),
                spectra.frequency_hz,
                bank.sample_rate_hz,
                spectra.drive[None],
                spectra.scanned[chosen].astype(np.complex128),
                spectra.noise[chosen],
            ),
        )
        self._rows: list[Int64Array] = [rows]
        if sentinel is not None and bank.actuators <= _MAX_SENTINEL_ACTUATORS:
            self._rows.append(np.array([sentinel.position]))
            blocks = (*blocks, sentinel_block(sentinel, bank))
        self.state = _State(blocks, ActuatorErrors(np.ones(bank.actuators), np.zeros(bank.actuators)))

    @cached_property
    def first(self) -> list[_Cause]:
        """The causes of the whole difference."""
        return list(self.causes(self.state))

    def causes(self, state: _State) -> Iterator[_Cause]:
        """The best cause of each kind."""
        yield _actuator_cause(state)
        if self._bank.actuators > 1:
            yield _exchange(state)
        if state.change == 0.0 and not state.displaced:
            yield _speed_cause(state, lambda: self._surface.dispersion if self._surface.usable else 1.0)
        if not state.displaced and self._surface.usable:
            yield self._mirror(state)

    @cached_property
    def _surface(self) -> BankAsField:
        return BankAsField(self._bank)

    def _mirror(self, state: _State) -> _Cause:
        block = state.blocks[0].some(MIRROR_ROWS, len(state.blocks[0].frequency_hz))
        chosen = evenly_spread(len(self._rows[0]), MIRROR_ROWS)
        fit = MirrorFit(self._surface, block, self._rows[0][chosen], state.change)
        affine, left = fit.best()
        moved_mm = displacement_mm(affine, self._surface.place_mm[self._rows[0]])
        far_mm = float(np.sqrt(np.mean(np.square(moved_mm).sum(axis=1))))
        named = np.isfinite(left) and far_mm >= MIN_SPACINGS * self._surface.spacing_mm
        symptom = Symptom("mirror", (), affine_value(affine), affine=tuple(map(tuple, affine.tolist())))

        def apply() -> _State:
            pairs = zip(state.blocks, self._rows, strict=True)
            blocks = tuple(displaced(self._surface, affine, block, rows, state.change) for block, rows in pairs)
            return replace(state, blocks=blocks, displaced=True)

        return _Cause((symptom,) if named else (), left * state.left if named else np.inf, apply)


def _actuator_cause(state: _State) -> _Cause:
    """Levels, polarities and delays of actuators, as few different ones as explain the difference."""
    free = fitted_errors(state.blocks)
    errors = grouped_errors(state.blocks, free, float(state.responses))
    blocks = errors.applied(state.blocks)
    together = ActuatorErrors(state.errors.factor * errors.factor, state.errors.late_s + errors.late_s)
    corrected = replace(state, blocks=blocks, errors=together)
    if state.change and not np.any(errors.factor == 1.0):
        # A change of speed brings a change of all levels with it: the one nearest to none is its own.
        nearest = np.abs(errors.factor[np.argmin(np.abs(errors.level_db))])
        errors = ActuatorErrors(errors.factor / nearest, errors.late_s)
    return _Cause(_actuator_symptoms(errors), corrected.left, lambda: corrected)


def _actuator_symptoms(errors: ActuatorErrors) -> tuple[Symptom, ...]:
    """One symptom for actuators of one change; empty where all are as in the bank."""
    groups: dict[tuple[SymptomCode, float], list[int]] = {}

    def note(code: SymptomCode, value: float, apart: float, index: int) -> None:
        alike = (key for key in groups if key[0] == code and abs(key[1] - value) < apart)
        groups.setdefault(next(alike, (code, value)), []).append(index)

    for index, (factor, late_s) in enumerate(zip(errors.factor.tolist(), errors.late_s.tolist(), strict=True)):
        level_db = float(errors.level_db[index])
        if abs(factor) < SILENT:
            note("silent", -200.0, 1.0, index)
            continue
        if factor < 0.0:
            note("polarity", level_db + 0.0, MIN_DB, index)
        elif abs(level_db) >= MIN_DB:
            note("level", level_db, MIN_DB, index)
        if abs(late_s) >= MIN_DELAY_S:
            note("delay", 1e3 * late_s, 1e3 * MIN_DELAY_S, index)
    everyone = len(errors.factor)
    return tuple(
        Symptom(code, () if len(members) == everyone > 1 else tuple(members), value)
        for (code, value), members in groups.items()
    )


def _exchange(state: _State) -> _Cause:
    """The pair of actuators whose exchange takes off most."""
    actuators = state.blocks[0].green.shape[1]
    reduction = np.full((actuators, actuators), -np.inf)
    for first in range(actuators - 1):
        total = np.zeros(actuators - first - 1)
        for block in state.blocks:
            change = (block.green[:, first, None] - block.green[:, first + 1 :]) * (
                block.drive[:, first, None] - block.drive[:, first + 1 :]
            )
            total -= 2.0 * np.einsum("rk,rak->a", block.difference.conj(), change).real
            total -= np.einsum("rak,rak->a", change.conj(), change).real
        reduction[first, first + 1 :] = total
    pair = tuple(int(index) for index in np.unravel_index(np.argmax(reduction), reduction.shape))
    blocks = tuple(block.exchanged(*pair) for block in state.blocks)
    return _Cause(
        (Symptom("swapped", pair),), state.left - float(reduction[pair]), lambda: replace(state, blocks=blocks)
    )


def _speed_cause(state: _State, dispersion: Callable[[], float]) -> _Cause:
    """Waves that are faster or slower, with a factor on all responses.

    dispersion: Gives the exponent of the wave number over the frequency, by which a change of the waves' times is one
        of their speed at a frequency.
    """
    from scipy.optimize import minimize_scalar  # slow to load

    some = tuple(block.some(8, 64) for block in state.blocks)
    left = [_with_speed(some, change)[0] for change in _SPEEDS]
    middle = int(np.clip(np.argmin(left), 1, len(_SPEEDS) - 2))
    bounds = _SPEEDS[middle - 1], _SPEEDS[middle + 1]
    found = minimize_scalar(
        lambda change: _with_speed(some, float(change))[0], bounds=bounds, method="bounded", options={"xatol": 2e-4}
    )
    change = float(found.x)
    left_everywhere, blocks = _with_speed(state.blocks, change)
    speed = (1.0 + change) ** dispersion() - 1.0 if abs(change) >= _MIN_SPEED else 0.0
    symptoms = (Symptom("speed", value=100.0 * speed),) if abs(speed) >= _MIN_SPEED else ()
    return _Cause(symptoms, left_everywhere, lambda: replace(state, blocks=blocks, change=change))


def _with_speed(blocks: Blocks, change: float) -> tuple[float, Blocks]:
    """The sum of squares that a change of speed leaves with the best factor, and the blocks with both put right."""
    changed = [block.faster(change) for block in blocks]
    predicted = [block.response - block.difference for block in changed]
    own = sum(energy(values) for values in predicted)
    pairs = zip(predicted, changed, strict=True)
    matched = sum(float((values.conj() * block.response).sum().real) for values, block in pairs)
    # A softer surface moves more: the change of all levels that a change of speed may bring with it.
    factor = float(np.clip(matched / own, 0.8, 1.25)) if own > 0.0 else 1.0
    louder: list[Block] = [replace(block, drive=factor * block.drive) for block in changed]
    return squares_left(tuple(louder)), tuple(louder)


def _actuator_figures(state: _State) -> tuple[ActuatorFigures, ...]:
    """Level and delay of each actuator against the bank; None where a change of 0.4 dB would hardly show.

    That is, where it changes the sum of squares by less than the 95 % quantile of chi-squared, two degrees of freedom.
    """
    rest = fitted_errors(state.blocks)
    errors = ActuatorErrors(state.errors.factor * rest.factor, state.errors.late_s + rest.late_s)
    seen = sum(np.einsum("rak,rak->a", block.parts.conj(), block.parts).real for block in state.blocks)
    shows = seen * (10.0 ** (MIN_DB / 20.0) - 1.0) ** 2 >= -2 * np.log(1 - CERTAIN_SHARE)
    return tuple(
        ActuatorFigures(float(errors.level_db[index]), 1e6 * float(errors.late_s[index]))
        if shows[index]
        else ActuatorFigures(None, None)
        for index in range(len(errors.factor))
    )


def crosstalk_symptom(found: Crosstalk, fields: FieldComparison, marker_v: Float64Array | None) -> Symptom:
    """The symptom of a leak that was measured by itself, and the share of the excess that it explains.

    The same at all positions, a scan has the leaking marker, and a prediction from a bank that was measured with the
    leak has the sum of the drives.

    found: Level and delay of the leak.
    marker_v, float64 (samples,): What the loopback played in the scan; None for a leak that only the bank has.
    """
    spectra = fields.spectra
    late = np.exp(-2j * np.pi * spectra.frequency_hz * found.delay_s)
    pulses = [late * spectra.drive.sum(axis=0)]
    if marker_v is not None:
        turns = np.outer(spectra.frequency_hz, np.arange(marker_v.size) / fields.sample_rate_hz)
        pulses.append(late * (np.exp(-2j * np.pi * turns) @ marker_v))
    difference = (spectra.scanned - spectra.predicted).astype(np.complex128)
    excess = float(np.sum(np.abs(difference) ** 2)) - float(np.nansum(spectra.noise))
    # Real factors: a leak is a share. The mean over the positions is all that it can change.
    mean = difference.mean(axis=0)
    basis = np.stack([np.concatenate([pulse.real, pulse.imag]) for pulse in pulses], axis=1)
    wanted = np.concatenate([mean.real, mean.imag])
    fitted = basis @ np.linalg.lstsq(basis, wanted, rcond=None)[0]
    gained = len(difference) * (float(wanted @ wanted) - float(np.sum((wanted - fitted) ** 2)))
    explained = float(np.clip(gained / excess, 0.0, 1.0)) if excess > 0.0 else 0.0
    certain = explained >= CERTAIN_SHARE
    return Symptom("crosstalk", (), found.level_db, explained, certain, delay_s=found.delay_s)


def with_crosstalk(symptoms: tuple[Symptom, ...], leak: Symptom) -> tuple[Symptom, ...]:
    """All symptoms: one that explains enough takes the place of guesses, else it stands behind the others."""
    if leak.certain:
        return (leak, *(symptom for symptom in symptoms if symptom.certain and symptom.code != "wrong_bank"))
    return (*symptoms, leak)
