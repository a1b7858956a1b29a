"""Causes of a scan that differs from its prediction: levels, delays, swapped actuators, shifted rows, wave speed.

A predicted response is a sum over actuators, ``Y(x) = sum_i G_i(x) F_i`` at each frequency, so each cause changes it in
a way that follows from bank and drive. The cause that leaves least of the difference is named, then the next one.
Differences count in units of what is allowed: the noise, and 1 % of each position's response.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from wavefocus.rendering.arrays import Complex128Array, Float64Array
from wavefocus.rendering.field.focus_figures import evenly
from wavefocus.rendering.verify.results import CERTAIN_SHARE, ActuatorFigures, Sentinel, Symptom, SymptomCode
from wavefocus.rendering.verify.row_shift import Shifts, find_shifts
from wavefocus.rendering.verify.superposition import ALLOWED, Blocks, block_of, energy, sentinel_block, transforms

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.rendering.verify.comparison import FieldComparison

MOST_ROWS, LEAST_ROWS, SPEED_ROWS = 48, 4, 12
ROWS_BYTES = 64 << 20
MOST_SENTINEL_ACTUATORS = 128
"""The sentinel's equations grow with the square of the number of actuators."""
LEAST_REDUCTION = 6.0
"""A cause takes off so much of the sum of squares, in units of what is allowed at one position."""
LEAST_SHARE = 0.1
"""And this share of the whole: what is smaller is found when the larger cause is put right."""
MANY_LEFT = 0.05
"""The levels of many actuators are named together when they leave no more than this share."""
TIE, LEAST_TIE = 0.02, 0.5
"""Causes that take off so little less, as a share or in units of what is allowed, do about as well."""
MOST_CAUSES = 3
LEAST_DB, LEAST_DELAY_S, LEAST_SPEED = 0.5, 1e-4, 0.01
"""Smaller causes are not named while the error is within its limit: 1 dB, 0.2 ms and 2 % are, whatever the noise."""
SILENT_DB = -20.0
LATEST_S = 0.02
SPEEDS = (-0.08, -0.06, -0.04, -0.03, -0.02, -0.01, 0.0, 0.01, 0.02, 0.03, 0.04, 0.06, 0.08)
ALIKE = 0.8
"""With a smaller median correlation, and no cause found, the bank is taken for another plate's."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Causes found, the share of the sum of squares that they explain together, and the state of each actuator."""

    symptoms: tuple[Symptom, ...]
    actuators: tuple[ActuatorFigures, ...]


@dataclass(frozen=True, slots=True)
class _State:
    """Blocks, and what was put right in them: factor and delay of each actuator (A,)."""

    blocks: Blocks
    factor: Float64Array
    late_s: Float64Array

    @property
    def left(self) -> float:
        """Sum of squares of the differences, in units of what is allowed."""
        return sum(energy(block.difference) for block in self.blocks)


@dataclass(frozen=True, slots=True)
class _Cause:
    """A cause, the sum of squares that it takes off, and what follows from it."""

    reduction: float
    symptom: Symptom
    apply: Callable[[], _State]
    named: bool
    """Whether it is large enough to be named where the error is within its limit."""


def diagnose(
    fields: FieldComparison,
    bank: GreenSource,
    sentinel: Sentinel | None = None,
    *,
    error_limit: float,
    model_error: float,
) -> Diagnosis:
    """Name the causes of a difference between scan and prediction.

    fields: Both fields at some frequencies.
    bank: What the prediction is made of.
    sentinel: The bank's sentinel position measured again, each actuator by itself: causes are found in it that the
        scene hardly shows.
    error_limit: Largest error that passes; beyond it causes of any size are named, and what remains unexplained.
    model_error: Error without the noise's part.
    """

    def predicted(row: int) -> Complex128Array:
        green = transforms(np.asarray(bank.green(row)), fields.spectra.frequency_hz, bank.sample_rate_hz)
        return np.asarray(np.einsum("ak,ak->k", green, fields.spectra.drive))

    shifts = find_shifts(fields, bank, predicted)
    state = _state(fields, bank, sentinel, shifts)
    if shifts.between:
        cause = _best(list(_causes(state)))
        if cause is None or cause.reduction < CERTAIN_SHARE * state.left:
            return Diagnosis(shifts.symptoms, ())
        shifts = Shifts()
    if shifts.whole:
        # What looks like a shift may be another cause that explains more.
        other = _state(fields, bank, sentinel, Shifts())
        cause = _best(list(_causes(other)))
        if cause is not None and other.left - cause.reduction < state.left:
            shifts, state = Shifts(), other
    first, start, count = state, state.left, sum(len(block.response) for block in state.blocks)
    within = fields.error <= error_limit
    found: list[Symptom] = list(shifts.symptoms)
    for _ in range(2 * MOST_CAUSES):
        cause = _best(list(_causes(state)))
        if cause is None or cause.reduction < max(LEAST_REDUCTION, LEAST_SHARE * start) or len(found) == MOST_CAUSES:
            break
        if cause.named or not within:
            found.append(replace(cause.symptom, explained=cause.reduction / start))
        state = cause.apply()
    levels_db, left = _levels_together(first)
    uneven = np.abs(levels_db - np.median(levels_db)) >= LEAST_DB
    many = np.count_nonzero(uneven) >= max(2, len(uneven) / 2) and state.left > count
    if many and left < min(start * MANY_LEFT, state.left / 4):
        others = np.flatnonzero(np.abs(levels_db) >= LEAST_DB)
        levels = Symptom("wrong_bank", tuple(others.tolist()), explained=1.0 - left / start)
        return Diagnosis((*shifts.symptoms, levels), _actuator_figures(first))
    if state.left > max((1.0 - CERTAIN_SHARE) * start, count * (error_limit / ALLOWED) ** 2):
        nameless = _unexplained(found, fields.correlation_median) if model_error > error_limit else ()
        return Diagnosis(shifts.symptoms or nameless, ())
    return Diagnosis(_of_what_others_leave(found), _actuator_figures(state))


def _of_what_others_leave(found: list[Symptom]) -> tuple[Symptom, ...]:
    """Symptoms that explain the excess together, each with its share of what the others leave."""
    together = sum(symptom.explained or 0.0 for symptom in found)
    shares = [(symptom.explained or 0.0) / max(1.0 - together + (symptom.explained or 0.0), 1e-12) for symptom in found]
    return tuple(
        replace(symptom, explained=min(share, 1.0), certain=bool(share >= CERTAIN_SHARE))
        for symptom, share in zip(found, shares, strict=True)
    )


def _unexplained(guesses: list[Symptom], correlation: float) -> tuple[Symptom, ...]:
    """The verdict where no cause explains enough, and the best guess."""
    together = sum(guess.explained or 0.0 for guess in guesses)
    if not correlation >= ALIKE:
        share = max(1.0 - together, 0.0)
        return (Symptom("wrong_bank", (), correlation, share, bool(share >= CERTAIN_SHARE)),)
    best = [replace(guess, certain=False) for guess in guesses[:1]]
    return (Symptom("unexplained", explained=0.0, certain=False), *best)


def _state(fields: FieldComparison, bank: GreenSource, sentinel: Sentinel | None, shifts: Shifts) -> _State:
    """The equations of some of the compared positions, and of the sentinel position."""
    spectra, rows = fields.spectra, shifts.bank_rows(fields.position_index)
    usable = np.flatnonzero(rows >= 0)
    chosen = usable[evenly(len(usable), _most_rows(bank))]
    green = np.stack([np.asarray(bank.green(int(row)), np.float32) for row in rows[chosen]])
    scanned = spectra.scanned[chosen].astype(np.complex128)
    own = np.arange(len(chosen))
    drive, noise = spectra.drive[None], spectra.noise[chosen]
    blocks: Blocks = (block_of(green, own, spectra.frequency_hz, bank.sample_rate_hz, drive, scanned, noise),)
    if sentinel is not None and bank.actuators <= MOST_SENTINEL_ACTUATORS:
        row = shifts.row_at.get(sentinel.position, sentinel.position)
        if row >= 0:
            blocks = (*blocks, sentinel_block(sentinel, np.asarray(bank.green(row), np.float32), bank))
    return _State(blocks, np.ones(bank.actuators), np.zeros(bank.actuators))


def wave_speed(sentinel: Sentinel, bank: GreenSource) -> float | None:
    """Change of the wave speed in % that explains most of the sentinel's change; None where it explains little."""
    if bank.actuators > MOST_SENTINEL_ACTUATORS:
        return None
    block = sentinel_block(sentinel, np.asarray(bank.green(sentinel.position), np.float32), bank)
    state = _State((block,), np.ones(bank.actuators), np.zeros(bank.actuators))
    cause = _best(list(_causes(state)))
    if cause is None or cause.symptom.code != "speed" or cause.reduction < CERTAIN_SHARE * state.left:
        return None
    return cause.symptom.value


def _most_rows(bank: GreenSource) -> int:
    return int(np.clip(ROWS_BYTES // (4 * bank.actuators * bank.taps), LEAST_ROWS, MOST_ROWS))


def _best(causes: list[_Cause]) -> _Cause | None:
    """The cause that takes off most; of kinds that do about as well, the first, which is the plainest."""
    if not causes:
        return None
    most = max(cause.reduction for cause in causes)
    first = next(cause for cause in causes if cause.reduction >= most - max(TIE * abs(most), LEAST_TIE))
    kind = first.symptom.code, len(first.symptom.actuators)
    return max(
        (cause for cause in causes if (cause.symptom.code, len(cause.symptom.actuators)) == kind),
        key=lambda cause: cause.reduction,
    )


def _causes(state: _State) -> Iterator[_Cause]:
    """Every cause that could be, the plainest first."""
    actuators = len(state.factor)
    parts = [_with_total(block.parts) for block in state.blocks]
    differences = [block.difference for block in state.blocks]
    own = sum(np.einsum("rak,rak->a", part.conj(), part).real for part in parts)
    matched = sum(
        np.einsum("rak,rk->a", part.conj(), difference).real
        for part, difference in zip(parts, differences, strict=True)
    )
    members = [*([one] for one in range(actuators)), list(range(actuators))]
    for index, of in enumerate(members[: actuators + (actuators > 1)]):
        if own[index] > 0.0:
            yield _level(state, of, matched[index] ** 2 / own[index], 1.0 + matched[index] / own[index])
    for index, (late_s, reduction) in enumerate(_delays(state.blocks, parts, differences, own, matched)):
        yield _delay(state, members[index], reduction, late_s)
    if state.left > sum(len(block.response) for block in state.blocks):  # else nothing of this size is left
        yield from _exchanges(state, differences)
        yield _speed(state)


def _level(state: _State, of: list[int], reduction: float, factor: float) -> _Cause:
    each = np.ones(len(state.factor))
    each[of] = factor
    everyone = len(of) == len(state.factor) > 1
    level_db = 20.0 * float(np.log10(max(abs(factor), 1e-10)))

    def apply() -> _State:
        return replace(
            state, blocks=tuple(block.driven(each[:, None]) for block in state.blocks), factor=state.factor * each
        )

    code: SymptomCode = "silent" if level_db < SILENT_DB else "polarity" if factor < 0.0 else "level"
    symptom = Symptom(code, () if everyone else tuple(of), level_db)
    return _Cause(reduction, symptom, apply, symptom.code != "level" or abs(level_db) >= LEAST_DB)


def _delay(state: _State, of: list[int], reduction: float, late_s: float) -> _Cause:
    each_s = np.zeros(len(state.factor))
    each_s[of] = late_s
    everyone = len(of) == len(state.factor) > 1

    def apply() -> _State:
        blocks = tuple(
            block.driven(np.exp(-2j * np.pi * np.outer(each_s, block.frequency_hz))) for block in state.blocks
        )
        return replace(state, blocks=blocks, late_s=state.late_s + each_s)

    symptom = Symptom("delay", () if everyone else tuple(of), 1e3 * late_s)
    return _Cause(reduction, symptom, apply, abs(late_s) >= LEAST_DELAY_S)


def _delays(
    blocks: Blocks,
    parts: list[Complex128Array],
    differences: list[Complex128Array],
    own: Float64Array,
    matched: Float64Array,
) -> list[tuple[float, float]]:
    """The delay of each part that takes off most, and how much."""
    finest_s = 0.01 / max(float(block.frequency_hz.max()) for block in blocks)
    delays_s = np.arange(-LATEST_S, LATEST_S + finest_s, finest_s)
    agreement = np.zeros((len(delays_s), len(own)))
    for block, part, difference in zip(blocks, parts, differences, strict=True):
        cross = np.einsum("rak,rak->ak", part.conj(), difference[:, None] + part)
        agreement += (np.exp(2j * np.pi * np.outer(delays_s, block.frequency_hz)) @ cross.T).real
    reduction = 2.0 * (agreement - matched - own)
    found = []
    for column in reduction.T:
        inner = column[1:-1]
        peaks = 1 + np.flatnonzero((inner >= column[:-2]) & (inner >= column[2:]))
        if not peaks.size:
            found.append((0.0, 0.0))
            continue
        # A tone has a peak in each period: the smallest delay of those that do as well.
        good = peaks[column[peaks] >= column[peaks].max() - TIE * abs(column[peaks].max())]
        peak = int(good[np.argmin(np.abs(delays_s[good]))])
        before, at, after = column[peak - 1 : peak + 2]
        curvature = before - 2.0 * at + after
        offset = 0.5 * (before - after) / curvature if curvature < 0.0 else 0.0
        found.append((float(delays_s[peak] + offset * finest_s), float(at)))
    return found[: len(own) - (len(own) == 2)]


def _exchanges(state: _State, differences: list[Complex128Array]) -> Iterator[_Cause]:
    """The pair of actuators whose exchange takes off most."""
    actuators = len(state.factor)
    reduction = np.full((actuators, actuators), -np.inf)
    for one in range(actuators - 1):
        total = np.zeros(actuators - one - 1)
        for block, difference in zip(state.blocks, differences, strict=True):
            change = (block.green[:, one, None] - block.green[:, one + 1 :]) * (
                block.drive[:, one, None] - block.drive[:, one + 1 :]
            )
            total -= 2.0 * np.einsum("rk,rak->a", difference.conj(), change).real
            total -= np.einsum("rak,rak->a", change.conj(), change).real
        reduction[one, one + 1 :] = total
    if actuators > 1:
        one, other = (int(index) for index in np.unravel_index(np.argmax(reduction), reduction.shape))

        def apply() -> _State:
            return replace(state, blocks=tuple(block.exchanged(one, other) for block in state.blocks))

        yield _Cause(float(reduction[one, other]), Symptom("swapped", (one, other)), apply, named=True)


def _at_speed(state: _State, speed: float) -> tuple[float, float]:
    """Sum of squares that is left with waves so much faster, and the factor on all responses that fits best."""
    blocks = [block.stretched(speed) for block in state.blocks]
    predicted = [block.response - block.difference for block in blocks]
    own = sum(energy(one) for one in predicted)
    matched = sum(float((one.conj() * block.response).sum().real) for one, block in zip(predicted, blocks, strict=True))
    factor = matched / own if own > 0.0 else 1.0
    return sum(energy(block.response) for block in blocks) - factor * matched, factor


def _best_speed(state: _State) -> tuple[float, float]:
    """Relative change of the wave speed that leaves least at some of the positions, and what it leaves at all."""
    some = replace(state, blocks=tuple(block.some(SPEED_ROWS) for block in state.blocks))
    left = [_at_speed(some, speed)[0] for speed in SPEEDS]
    middle = int(np.clip(np.argmin(left), 1, len(SPEEDS) - 2))
    best = scipy.optimize.minimize_scalar(
        lambda speed: _at_speed(some, float(speed))[0],
        bounds=(SPEEDS[middle - 1], SPEEDS[middle + 1]),
        method="bounded",
        options={"xatol": 2e-4},
    )
    return float(best.x), _at_speed(state, float(best.x))[0]


def _speed(state: _State) -> _Cause:
    speed, left = _best_speed(state)

    def apply() -> _State:
        _, factor = _at_speed(state, speed)
        blocks = tuple(block.stretched(speed).driven(np.full((1, 1), factor)) for block in state.blocks)
        return replace(state, blocks=blocks, factor=state.factor * factor)

    return _Cause(state.left - left, Symptom("speed", value=100.0 * speed), apply, abs(speed) >= LEAST_SPEED)


def _levels_together(state: _State) -> tuple[Float64Array, float]:
    """Level of each actuator in dB where all may differ, and what is left."""
    changes, left = _solved(state, delays=False)
    return 20.0 * np.log10(np.maximum(np.abs(1.0 + changes), 1e-10)), left


def _solved(state: _State, *, delays: bool) -> tuple[Float64Array, float]:
    """Small relative changes of all levels, and of all delays in s, that fit best together; and what is left."""
    actuators = len(state.factor)
    size = 2 * actuators if delays else actuators
    matrix, right, left = np.zeros((size, size)), np.zeros(size), 0.0
    for block in state.blocks:
        parts, difference = block.parts, block.difference
        columns = np.concatenate([parts, -2j * np.pi * block.frequency_hz * parts], axis=1) if delays else parts
        matrix += np.einsum("rak,rbk->ab", columns.conj(), columns, optimize=True).real
        right += np.einsum("rak,rk->a", columns.conj(), difference).real
        left += energy(difference)
    scale = np.sqrt(np.where(np.diag(matrix) > 0.0, np.diag(matrix), 1.0))
    changes = np.linalg.lstsq(matrix / np.outer(scale, scale), right / scale, rcond=1e-6)[0] / scale
    return changes, left - float(changes @ right)


def _actuator_figures(state: _State) -> tuple[ActuatorFigures, ...]:
    """Level and delay of each actuator against the bank; None where a change of 0.5 dB would hardly show."""
    actuators = len(state.factor)
    level, late_s = np.split(_solved(state, delays=True)[0], 2)
    seen = sum(np.einsum("rak,rak->a", block.parts.conj(), block.parts).real for block in state.blocks)
    shows = seen * (10.0 ** (LEAST_DB / 20.0) - 1.0) ** 2 >= LEAST_REDUCTION
    factor = state.factor * (1.0 + level)
    levels_db = 20.0 * np.log10(np.maximum(np.abs(factor), 1e-10))
    return tuple(
        ActuatorFigures(
            float(levels_db[one]) if shows[one] else None,
            1e6 * float(state.late_s[one] + late_s[one]) if shows[one] else None,
        )
        for one in range(actuators)
    )


def _with_total(parts: Complex128Array) -> Complex128Array:
    return np.concatenate([parts, parts.sum(axis=1, keepdims=True)], axis=1)
