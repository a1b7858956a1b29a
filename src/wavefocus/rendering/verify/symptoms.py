"""Causes of a scan that differs from its prediction.

A predicted response is a sum over actuators, ``Y(x) = sum_i G_i(x) F_i`` at each frequency, so each cause changes it in
a way that follows from bank and drive. The cause that leaves least of the difference is named if it explains enough of
it. Differences count in units of what is allowed: the noise, and 1 % of each position's response.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.optimize

from wavefocus.calibration.numerics import evenly_spread, parabola_vertex
from wavefocus.rendering.arrays import Complex128Array, Float64Array, Int64Array
from wavefocus.rendering.verify.actuator_errors import ActuatorErrors, joint_errors, solved
from wavefocus.rendering.verify.distortion import driven_powers, fit_distortion, response_powers
from wavefocus.rendering.verify.mirror_error import (
    ALL,
    ROTATION,
    SCALE,
    SHIFT,
    InterpolatedBank,
    MirrorError,
    MirrorFit,
)
from wavefocus.rendering.verify.results import CERTAIN_SHARE, ActuatorFigures, Sentinel, Symptom, SymptomCode
from wavefocus.rendering.verify.row_shift import find_shifts
from wavefocus.rendering.verify.superposition import (
    Block,
    Blocks,
    block_of,
    energy,
    sentinel_block,
    transforms,
    with_total,
)

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.rendering.verify.comparison import FieldComparison

MAX_ROWS, MIN_ROWS, MIRROR_ROWS = 48, 4, 36
MEDIUM_ROWS, MEDIUM_FREQUENCIES = 8, 64
ROWS_BYTES = 64 << 20
MEDIUM_FACTORS = (0.8, 1.25)
"""A softer surface moves more: the change of all levels that a change of speed or damping may bring with it."""
MAX_SENTINEL_ACTUATORS = 128
"""The sentinel's equations grow with the square of the number of actuators."""
MIN_REDUCTION = 6.0
"""A cause takes off so much of the sum of squares, in units of what is allowed at one position."""
MIN_SHARE = 0.1
"""And this share of the whole: what is smaller is found when the larger cause is put right."""
TOGETHER_SHARE, MANY_SHARE = 0.95, 0.98
"""Several causes, or one change of any actuators, must explain more, different changes of actuators even more: enough
numbers fit anything. Real ones explain 0.99 and more (``wavefocus bench symptoms``)."""
TIE, MIN_TIE, TIE_LEFT = 0.02, 0.5, 1.3
"""Two causes tie if their reductions differ by less than this share or number of units, and what they leave by less
than this factor."""
EXACT = ("level", "polarity", "silent", "delay", "swapped", "speed")
EXACT_SHARE = 0.97
"""Causes whose effect follows exactly from the bank must explain this share, or all but what is allowed."""
SPEED_SHARE = 0.995
"""A mass on a stiff plate lowers its modes nearly as slower waves do: it was seen to explain 0.992."""
NEXT_TO_NOTHING = 0.003
MAX_CAUSES = 3
MIN_DB, MIN_DELAY_S, MIN_SPEED = 0.5, 1e-4, 0.01
"""Smaller causes are not named while the error is within its limit: 1 dB, 0.2 ms and 2 % are, whatever the noise."""
SILENT_DB = -20.0
LATEST_S = 0.02
SPEEDS = (-0.08, -0.06, -0.04, -0.03, -0.02, -0.01, 0.0, 0.01, 0.02, 0.03, 0.04, 0.06, 0.08)
DECAYS = (-0.2, -0.1, -0.05, -0.02, 0.0, 0.02, 0.05, 0.1, 0.2, 0.4)
"""Changes of the decay tried: imaginary over real frequency, at the middle of the frequencies."""


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """Causes found, and the state of each actuator."""

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

    @property
    def noise(self) -> float:
        """Part of the noise in it."""
        return sum(block.noise for block in self.blocks)

    @property
    def responses(self) -> int:
        """Number of responses."""
        return sum(len(block.response) for block in self.blocks)

    def driven(self, factor: Float64Array, late_s: Float64Array) -> _State:
        """The state with levels and delays of actuators put right."""
        blocks = tuple(
            block.driven(factor[:, None] * np.exp(-2j * np.pi * np.outer(late_s, block.frequency_hz)))
            for block in self.blocks
        )
        return _State(blocks, self.factor * factor, self.late_s + late_s)


@dataclass(frozen=True, slots=True)
class _Cause:
    """A cause, the sum of squares that it takes off, and what follows from it.

    symptoms: Several where one calculation finds several, each with its share where it knows it.
    named: Whether it is large enough to be named where the error is within its limit.
    enough: Share of the excess that it must explain.
    plain: One number describes it.
    """

    reduction: float
    symptoms: tuple[Symptom, ...]
    apply: Callable[[], _State]
    named: bool = True
    enough: float = CERTAIN_SHARE
    plain: bool = True


def diagnose(
    fields: FieldComparison,
    bank: GreenSource,
    sentinel: Sentinel | None = None,
    *,
    error_limit: float,
    model_error: float,
    nonlinear_share: float | None = None,
) -> Diagnosis:
    """Name the causes of a difference between scan and prediction.

    fields: Both fields at some frequencies.
    bank: What the prediction is made of.
    sentinel: The bank's sentinel position measured again, each actuator by itself: causes are found in it that the
        scene hardly shows.
    error_limit: Largest error that passes; beyond it causes of any size are named, and what remains unexplained.
    model_error: Error without the noise's part.
    nonlinear_share: Share of the squared difference that is not there when the scene is played quieter; None where it
        was not.
    """
    search = _Search(fields, bank, sentinel, nonlinear_share)
    state = search.state
    excess = max(state.left - state.noise, 1e-12)
    # Where the prediction is far louder than the scan, to take it away explains nothing of the scan.
    whole = min(excess, sum(energy(block.response) for block in state.blocks))
    remaining = excess
    within = fields.error <= error_limit
    found = [_Found(search.shifts.symptoms, 1.0, CERTAIN_SHARE)] if search.shifts.symptoms else []
    for _ in range(2 * MAX_CAUSES):
        cause = _best(list(search.causes(state)), state.left)
        if cause is None or cause.reduction < max(MIN_REDUCTION, MIN_SHARE * excess) or len(found) == MAX_CAUSES:
            break
        if cause.named or not within:
            symptoms = tuple(search.in_speeds(symptom) for symptom in cause.symptoms)
            share = (min(remaining, whole) - min(max(remaining - cause.reduction, 0.0), whole)) / whole
            exact = all(symptom.code in EXACT for symptom in symptoms)
            enough = min(EXACT_SHARE, 1.0 - search.state.responses / whole) if exact else CERTAIN_SHARE
            if any(symptom.code == "speed" for symptom in symptoms):
                enough = SPEED_SHARE
            found.append(_Found(symptoms, share, max(cause.enough, enough)))
        remaining -= cause.reduction
        state = cause.apply()
    if certain := _certain(found):
        return Diagnosis(certain, _actuator_figures(state))
    if model_error <= error_limit or (not found and state.left <= max(state.noise, state.responses)):
        return Diagnosis((), _actuator_figures(state))
    unlike = _clipped(state.left / sum(energy(block.response) for block in search.state.blocks))
    if unlike >= CERTAIN_SHARE:
        # Something heavy on a stiff plate looks the same.
        return Diagnosis((Symptom("wrong_bank", (), fields.correlation_median, unlike, certain=False),), ())
    guesses = [
        replace(symptom, explained=_clipped(first.share), certain=False)
        for first in found[:1]
        for symptom in first.symptoms
    ]
    return Diagnosis((Symptom("unexplained", explained=0.0, certain=False), *guesses), ())


@dataclass(frozen=True, slots=True)
class _Found:
    """A cause found, the share of the excess that it takes off, and the share that it must."""

    symptoms: tuple[Symptom, ...]
    share: float
    enough: float


def _certain(found: list[_Found]) -> tuple[Symptom, ...]:
    """The symptoms that are certain, each with its share of what the others leave; none if they explain too little.

    A cause that explains enough by itself is certain, and others if they explain enough of what it leaves; several that
    explain enough only together are certain if each of them is needed.
    """
    alone = bool(found) and found[0].share >= found[0].enough
    kept = found[:1] if alone else found
    for cause in found[1:] if alone else []:
        if cause.share >= CERTAIN_SHARE * (1.0 - sum(other.share for other in kept)):
            kept = [*kept, cause]
    total = sum(cause.share for cause in kept)
    shares = [cause.share / max(1.0 - total + cause.share, 1e-12) for cause in kept]
    needed = max((TOGETHER_SHARE, *(cause.enough for cause in kept)))
    if not kept or min(shares) < CERTAIN_SHARE or not (alone or total >= needed):
        return ()
    return tuple(
        replace(symptom, explained=_clipped(share if symptom.explained is None else symptom.explained))
        for cause, share in zip(kept, shares, strict=True)
        for symptom in cause.symptoms
    )


def _clipped(share: float) -> float:
    return float(np.clip(share, 0.0, 1.0))


class _Search:
    """What all causes are looked for in: some of the compared positions, and the sentinel position."""

    def __init__(
        self, fields: FieldComparison, bank: GreenSource, sentinel: Sentinel | None, nonlinear_share: float | None
    ) -> None:
        self._spectra, self._bank, self._nonlinear_share = fields.spectra, bank, nonlinear_share
        self.shifts = find_shifts(fields, bank, self._predicted)
        rows = self.shifts.bank_rows(fields.position_index)
        usable = np.flatnonzero(rows >= 0)
        most = int(np.clip(ROWS_BYTES // (4 * bank.actuators * bank.taps), MIN_ROWS, MAX_ROWS))
        self._chosen = usable[evenly_spread(len(usable), most)]
        self._rows: list[Int64Array] = [rows[self._chosen]]
        blocks: Blocks = (self._block(self._chosen, self._rows[0]),)
        if sentinel is not None and bank.actuators <= MAX_SENTINEL_ACTUATORS:
            row = self.shifts.row_at.get(sentinel.position, sentinel.position)
            if row >= 0:
                self._rows.append(np.array([row]))
                blocks = (*blocks, sentinel_block(sentinel, np.asarray(bank.green(row), np.float32), bank))
        self.state = _State(blocks, np.ones(bank.actuators), np.zeros(bank.actuators))

    def _predicted(self, row: int) -> Complex128Array:
        green = transforms(np.asarray(self._bank.green(row)), self._spectra.frequency_hz, self._bank.sample_rate_hz)
        return np.asarray(np.einsum("ak,ak->k", green, self._spectra.drive))

    def _block(self, chosen: Int64Array, rows: Int64Array) -> Block:
        spectra = self._spectra
        return block_of(
            np.stack([np.asarray(self._bank.green(int(row)), np.float32) for row in rows]),
            np.arange(len(rows)),
            spectra.frequency_hz,
            self._bank.sample_rate_hz,
            spectra.drive[None],
            spectra.scanned[chosen].astype(np.complex128),
            spectra.noise[chosen],
        )

    def causes(self, state: _State) -> Iterator[_Cause]:
        """Every cause that could be, the plainest first."""
        plain, joint = list(actuator_causes(state)), list(_joint_causes(state))
        yield from plain
        if state.left <= max(state.responses, 2.0 * state.noise):
            return  # nothing of the size of what follows is left
        # What leaves next to nothing cannot be bettered.
        excess = (1.0 - NEXT_TO_NOTHING) * (state.left - state.noise)
        if not any(cause.reduction > excess for cause in (*plain, *joint) if cause.plain):
            others = [*medium_causes(state), *self._mirror_causes(state), *self._distortion_causes(state)]
            yield from others
            # Changes of all actuators can imitate one of the plate or the mirror; a few numbers that do as well count.
            if any(cause.reduction > EXACT_SHARE * (state.left - state.noise) for cause in others if cause.plain):
                joint = [cause for cause in joint if cause.plain]
        yield from joint

    def in_speeds(self, symptom: Symptom) -> Symptom:
        """A speed of the waves' times as a speed at one frequency, which on a plate that bends is its square root."""
        if symptom.code != "speed" or symptom.value is None or not self._surface.usable:
            return symptom
        return replace(symptom, value=100.0 * ((1.0 + symptom.value / 100.0) ** self._surface.dispersion - 1.0))

    @cached_property
    def _surface(self) -> InterpolatedBank:
        return InterpolatedBank(self._bank)

    def _mirror_causes(self, state: _State) -> Iterator[_Cause]:
        if state is not self.state or len(self._bank.position_mm) < 2 or not self._surface.usable:
            return
        chosen = evenly_spread(len(self._rows[0]), MIRROR_ROWS)
        some, rows = state.blocks[0].some(MIRROR_ROWS), self._rows[0][chosen]
        fit = MirrorFit(self._surface, some, rows)
        plain: list[tuple[MirrorError, float]] = [fit.best(free) for free in (SHIFT, ROTATION, SCALE)]
        all_of_them = fit.best(ALL)
        for error, left in (*plain, all_of_them):
            yield self._mirror_cause(state, fit, error, left)

    def _mirror_cause(self, state: _State, fit: MirrorFit, error: MirrorError, left: float) -> _Cause:
        def apply() -> _State:
            pairs = zip(state.blocks, self._rows, strict=True)
            return replace(state, blocks=tuple(fit.applied(error, block, rows) for block, rows in pairs))

        # Where the field is not known, nothing can be explained: what is, counts.
        reduction = (1.0 - left) * state.left if np.isfinite(left) else 0.0
        return _Cause(reduction, _mirror_symptoms(fit, error, left), apply)

    def _distortion_causes(self, state: _State) -> Iterator[_Cause]:
        spectra, block, measured = self._spectra, state.blocks[0], self._nonlinear_share
        if measured is not None and measured < CERTAIN_SHARE:
            return  # played quieter, the difference stays
        if measured is not None and state is self.state:
            left = block.with_response(block.response - measured * block.difference)
            value = 100.0 * float(np.sqrt(measured * energy(block.difference) / energy(block.response)))
            measured_blocks = (left, *state.blocks[1:])
            yield _Cause(
                measured * energy(block.difference),
                (Symptom("nonlinear", (), value),),
                lambda: replace(state, blocks=measured_blocks),
            )
        for powers in (
            response_powers(block, spectra.predicted_powers[:, self._chosen]),
            driven_powers(block, spectra.drive_powers),
        ):
            corrected, share = fit_distortion(block, powers)
            blocks = (corrected, *state.blocks[1:])
            reduction = energy(block.difference) - energy(corrected.difference)
            symptom = Symptom("nonlinear", (), 100.0 * share)
            yield _Cause(reduction, (symptom,), lambda blocks=blocks: replace(state, blocks=blocks))  # type: ignore[misc]


def _mirror_symptoms(fit: MirrorFit, error: MirrorError, left: float) -> tuple[Symptom, ...]:
    """The parts of the mirror's error; each explains a share of what the others leave."""
    distance_mm = float(np.hypot(*error.shift_mm))
    parts = {
        "shifted": (replace(error, shift_mm=(0.0, 0.0)), distance_mm),
        "rotated": (replace(error, rotation_rad=0.0), float(np.degrees(error.rotation_rad))),
        "scaled": (replace(error, scale=1.0, stretch=0.0, shear=0.0), 100.0 * (error.scale - 1.0)),
    }
    codes: tuple[SymptomCode, ...] = ("shifted", "rotated", "scaled")
    symptoms = []
    for code in codes:
        without, value = parts[code]
        if without == error:
            continue
        explained = _clipped(1.0 - left / max(fit.left(without), 1e-12))
        if explained >= CERTAIN_SHARE:
            shift_mm = error.shift_mm if code == "shifted" else None
            symptoms.append(Symptom(code, (), value, explained, shift_mm=shift_mm))
    return tuple(symptoms) or (Symptom("shifted", (), distance_mm, shift_mm=error.shift_mm),)


def wave_speed(sentinel: Sentinel, bank: GreenSource) -> float | None:
    """Change of the wave speed in % that explains most of the sentinel's change; None where it explains little."""
    if bank.actuators > MAX_SENTINEL_ACTUATORS:
        return None
    block = sentinel_block(sentinel, np.asarray(bank.green(sentinel.position), np.float32), bank)
    state = _State((block,), np.ones(bank.actuators), np.zeros(bank.actuators))
    cause = _best([*actuator_causes(state), *medium_causes(state)], state.left)
    if cause is None or cause.symptoms[0].code != "speed" or cause.reduction < CERTAIN_SHARE * state.left:
        return None
    return cause.symptoms[0].value


def _best(causes: list[_Cause], whole: float) -> _Cause | None:
    """The cause that takes off most of the whole; of kinds that do about as well, the first, which is the plainest."""
    if not causes:
        return None
    most = max(cause.reduction for cause in causes)
    least = max(most - max(TIE * abs(most), MIN_TIE), whole - TIE_LEFT * max(whole - most, 0.0) - MIN_TIE)
    first = next(cause for cause in causes if cause.reduction >= least)
    kind = _kind(first)
    return max((cause for cause in causes if _kind(cause) == kind), key=lambda cause: cause.reduction)


def _kind(cause: _Cause) -> list[tuple[SymptomCode, int]]:
    return [(symptom.code, len(symptom.actuators)) for symptom in cause.symptoms]


def actuator_causes(state: _State) -> Iterator[_Cause]:
    """Level, polarity or delay of one actuator or of all, and two that are exchanged."""
    actuators = len(state.factor)
    parts = [with_total(block.parts) for block in state.blocks]
    differences = [block.difference for block in state.blocks]
    own = sum(np.einsum("rak,rak->a", part.conj(), part).real for part in parts)
    matched = sum(
        np.einsum("rak,rk->a", part.conj(), difference).real
        for part, difference in zip(parts, differences, strict=True)
    )
    members = [*([index] for index in range(actuators)), list(range(actuators))]
    for index, of in enumerate(members[: actuators + (actuators > 1)]):
        if own[index] > 0.0:
            yield _level(state, of, matched[index] ** 2 / own[index], 1.0 + matched[index] / own[index])
    for index, (late_s, reduction) in enumerate(_delays(state.blocks, parts, differences, own, matched)):
        yield _delay(state, members[index], reduction, late_s)
    if state.left > state.responses:  # else nothing of this size is left
        yield from _exchanges(state, differences)


def _level(state: _State, of: list[int], reduction: float, factor: float) -> _Cause:
    each = np.ones(len(state.factor))
    each[of] = factor
    symptom = _level_symptom(() if len(of) == len(each) > 1 else tuple(of), factor)
    named = symptom.code != "level" or abs(symptom.value or 0.0) >= MIN_DB
    return _Cause(reduction, (symptom,), lambda: state.driven(each, np.zeros(len(each))), named)


def _level_symptom(actuators: tuple[int, ...], factor: float) -> Symptom:
    level_db = 20.0 * float(np.log10(max(abs(factor), 1e-10)))
    code: SymptomCode = "silent" if level_db < SILENT_DB else "polarity" if factor < 0.0 else "level"
    return Symptom(code, actuators, level_db)


def _delay(state: _State, of: list[int], reduction: float, late_s: float) -> _Cause:
    each_s = np.zeros(len(state.factor))
    each_s[of] = late_s
    symptom = Symptom("delay", () if len(of) == len(each_s) > 1 else tuple(of), 1e3 * late_s)
    return _Cause(reduction, (symptom,), lambda: state.driven(np.ones(len(each_s)), each_s), abs(late_s) >= MIN_DELAY_S)


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
        offset = parabola_vertex(*column[peak - 1 : peak + 2])
        found.append((float(delays_s[peak] + offset * finest_s), float(column[peak])))
    return found[: len(own) - (len(own) == 2)]


def _exchanges(state: _State, differences: list[Complex128Array]) -> Iterator[_Cause]:
    """The pair of actuators whose exchange takes off most."""
    actuators = len(state.factor)
    reduction = np.full((actuators, actuators), -np.inf)
    for first in range(actuators - 1):
        total = np.zeros(actuators - first - 1)
        for block, difference in zip(state.blocks, differences, strict=True):
            change = (block.green[:, first, None] - block.green[:, first + 1 :]) * (
                block.drive[:, first, None] - block.drive[:, first + 1 :]
            )
            total -= 2.0 * np.einsum("rk,rak->a", difference.conj(), change).real
            total -= np.einsum("rak,rak->a", change.conj(), change).real
        reduction[first, first + 1 :] = total
    if actuators > 1:
        pair = tuple(int(index) for index in np.unravel_index(np.argmax(reduction), reduction.shape))

        def apply() -> _State:
            return replace(state, blocks=tuple(block.exchanged(*pair) for block in state.blocks))

        yield _Cause(float(reduction[pair]), (Symptom("swapped", pair),), apply)


def medium_causes(state: _State) -> Iterator[_Cause]:
    """Waves that are faster or slower, or vibrations that decay faster or slower: per second, or per period."""

    def faster(change: float, frequency_hz: Float64Array) -> Float64Array:
        return frequency_hz / (1.0 + change)

    speed, left, speed_state = _fitted(state, SPEEDS, faster)
    yield _Cause(state.left - left, (Symptom("speed", value=100.0 * speed),), speed_state, abs(speed) >= MIN_SPEED)
    middle_hz = float(np.median(state.blocks[0].frequency_hz))

    def per_second(change: float, frequency_hz: Float64Array) -> Complex128Array:
        return np.asarray(frequency_hz - 1j * change * middle_hz)

    def per_period(change: float, frequency_hz: Float64Array) -> Complex128Array:
        return np.asarray(frequency_hz * (1.0 - 1j * change))

    for mapped in (per_second, per_period):
        decay, left, decay_state = _fitted(state, DECAYS, mapped)
        yield _Cause(state.left - left, (Symptom("damping", value=2.0 * np.pi * middle_hz * decay),), decay_state)


Mapping_ = Callable[[float, Float64Array], Float64Array | Complex128Array]


def _fitted(state: _State, changes: tuple[float, ...], mapped: Mapping_) -> tuple[float, float, Callable[[], _State]]:
    """The change of frequencies, with a factor on all responses, that leaves least at some positions.

    Returns the change, what it leaves at all positions, and the state with it put right.
    """

    def at(blocks: Blocks, change: float) -> tuple[float, float]:
        """Sum of squares that is left, and the factor."""
        changed = [block.at(mapped(change, block.frequency_hz)) for block in blocks]
        predicted = [block.response - block.difference for block in changed]
        own = sum(energy(values) for values in predicted)
        matched = sum(
            float((values.conj() * block.response).sum().real) for values, block in zip(predicted, changed, strict=True)
        )
        factor = float(np.clip(matched / own, *MEDIUM_FACTORS)) if own > 0.0 else 1.0
        return sum(energy(block.response) for block in changed) - factor * (2.0 * matched - factor * own), factor

    some = tuple(block.some(MEDIUM_ROWS, MEDIUM_FREQUENCIES) for block in state.blocks)
    left = [at(some, change)[0] for change in changes]
    middle = int(np.clip(np.argmin(left), 1, len(changes) - 2))
    best = float(
        scipy.optimize.minimize_scalar(
            lambda change: at(some, float(change))[0],
            bounds=(changes[middle - 1], changes[middle + 1]),
            method="bounded",
            options={"xatol": 2e-4},
        ).x
    )
    left_everywhere, factor = at(state.blocks, best)

    def apply() -> _State:
        blocks = tuple(block.at(mapped(best, block.frequency_hz)) for block in state.blocks)
        actuators = len(state.factor)
        return replace(state, blocks=blocks).driven(np.full(actuators, factor), np.zeros(actuators))

    return best, left_everywhere, apply


def _joint_causes(state: _State) -> Iterator[_Cause]:
    """Levels, polarities and delays of any actuators, by the joint solution over all."""
    errors = joint_errors(state.blocks)
    if errors is None:
        return
    corrected = state.driven(errors.factor, errors.late_s)
    plain = len(np.unique(errors.changes, axis=0)) == 1
    reduction = state.left - corrected.left
    enough = TOGETHER_SHARE if plain else MANY_SHARE
    yield _Cause(reduction, _actuator_symptoms(errors), lambda: corrected, enough=enough, plain=plain)


def _actuator_symptoms(errors: ActuatorErrors) -> tuple[Symptom, ...]:
    """One symptom for actuators of one change; where there are many changes, one for each code, with the median."""
    by_code: dict[SymptomCode, list[Symptom]] = {}
    for code, values in (("factor", errors.factor), ("delay", errors.late_s)):
        for value in np.unique(values[values != (code == "factor")]):
            members = tuple(np.flatnonzero(values == value).tolist())
            members = () if len(members) == len(values) else members
            symptom = (
                _level_symptom(members, value) if code == "factor" else Symptom("delay", members, 1e3 * float(value))
            )
            by_code.setdefault(symptom.code, []).append(symptom)
    if sum(map(len, by_code.values())) > MAX_CAUSES:
        by_code = {code: [_merged(symptoms)] for code, symptoms in by_code.items()}
    return tuple(symptom for symptoms in by_code.values() for symptom in symptoms)


def _merged(symptoms: list[Symptom]) -> Symptom:
    actuators = sorted(actuator for symptom in symptoms for actuator in symptom.actuators)
    return replace(
        symptoms[0], actuators=tuple(actuators), value=float(np.median([symptom.value for symptom in symptoms]))
    )


def _actuator_figures(state: _State) -> tuple[ActuatorFigures, ...]:
    """Level and delay of each actuator against the bank; None where a change of 0.5 dB would hardly show."""
    level, late_s = solved(state.blocks)
    seen = sum(np.einsum("rak,rak->a", block.parts.conj(), block.parts).real for block in state.blocks)
    shows = seen * (10.0 ** (MIN_DB / 20.0) - 1.0) ** 2 >= MIN_REDUCTION
    factor = state.factor * (1.0 + level)
    levels_db = 20.0 * np.log10(np.maximum(np.abs(factor), 1e-10))
    return tuple(
        ActuatorFigures(
            float(levels_db[index]) if shows[index] else None,
            1e6 * float(state.late_s[index] + late_s[index]) if shows[index] else None,
        )
        for index in range(len(factor))
    )
