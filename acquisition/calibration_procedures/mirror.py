"""The mirror map: the beam is brought onto marks on the surface, one after the other."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from acquisition.calibration_procedures.operator import By, Here, JogView, Operator, To
from acquisition.roles import asking
from acquisition.setup import Setup
from calibration.errors import InputError
from calibration.mirror_fit import LEAST_MARKS, MirrorFit, fit_mirror_map
from calibration.mirror_map import MirrorMap

Place = tuple[float, float]


@dataclass(frozen=True, slots=True)
class MirrorFigures:
    """The marks, the angles at which the beam was on them, and the map through them."""

    place_mm: NDArray[np.float64]
    angles_mrad: NDArray[np.float64]
    fit: MirrorFit

    @property
    def worst_mm(self) -> float:
        """By how much the map misses the mark that it misses most."""
        return float(self.fit.residual_mm.max())

    def suspect(self) -> int:
        """The mark, from 0, that is most likely to be wrong: the others agree best without it.

        One mark that is off bends the map towards itself, and others then seem further off. With five marks or
        fewer the others always agree, so there the mark that is missed most is suspected.
        """
        if len(self.place_mm) <= LEAST_MARKS + 1:
            return int(np.argmax(self.fit.residual_mm))
        without = [_rms_without(self.place_mm, self.angles_mrad, mark) for mark in range(len(self.place_mm))]
        return int(np.argmin(without))


def _rms_without(place_mm: NDArray[np.float64], angles_mrad: NDArray[np.float64], mark: int) -> float:
    try:
        return fit_mirror_map(np.delete(place_mm, mark, axis=0), np.delete(angles_mrad, mark, axis=0)).rms_mm
    except InputError:  # without it, the others decide nothing
        return float("inf")


def default_marks_mm(length_mm: float, width_mm: float) -> tuple[Place, ...]:
    """Seven places on a stadium that pin the map down well: the corners of a rectangle, its ends and its middle."""
    x_mm, y_mm = 0.32 * length_mm, 0.3 * width_mm
    return ((0.0, 0.0), (x_mm, y_mm), (-x_mm, y_mm), (-x_mm, -y_mm), (x_mm, -y_mm), (0.4 * length_mm, 0.0),
            (-0.4 * length_mm, 0.0))  # fmt: skip


def measure_mirror(setup: Setup, marks_mm: Sequence[Place], limit_mrad: float, operator: Operator) -> MirrorFigures:
    """Let the operator bring the beam onto each mark, and fit the map.

    Each mark is approached with the map known so far: the rig's own, moved to meet the marks done, and from
    the fifth mark on a fit through them.

    Parameters
    ----------
    setup : Setup
        The rig, with a first guess of the map.
    marks_mm : sequence of (float, float)
        Where the marks lie on the surface, four or more.
    limit_mrad : float
        Largest angle that the mirror may be sent to.
    operator : Operator
        Jogs the beam and says when it is there.

    Raises
    ------
    InputError
        Marks that no map can be fitted through.
    InstrumentError
        Of the mirror.
    """
    found: list[Place] = []
    for index, place_mm in enumerate(marks_mm):
        start = _approach(setup.mirror_map, marks_mm[:index], found, place_mm)
        at_mrad = (float(np.clip(start[0], -limit_mrad, limit_mrad)), float(np.clip(start[1], -limit_mrad, limit_mrad)))
        _point(setup, at_mrad)
        note = ""
        while True:
            step = operator.jog(JogView(index + 1, len(marks_mm), place_mm, at_mrad, note))
            match step:
                case Here():
                    break
                case By():
                    wanted = (at_mrad[0] + step.x_mrad, at_mrad[1] + step.y_mrad)
                case To():
                    wanted = (step.x_mrad, step.y_mrad)
            note = ""
            if max(map(abs, wanted)) > limit_mrad:
                note = f"({wanted[0]:.3f}, {wanted[1]:.3f}) mrad is beyond the limit of {limit_mrad:g} mrad: not moved"
                continue
            at_mrad = wanted
            _point(setup, at_mrad)
        found.append(at_mrad)
    return fitted_marks(marks_mm, found)


def fitted_marks(marks_mm: Sequence[Place], angles_mrad: Sequence[Place]) -> MirrorFigures:
    """Fit the map through marks whose angles are known.

    Raises
    ------
    InputError
        Marks that no map can be fitted through.
    """
    place, angles = np.array(marks_mm, dtype=np.float64), np.array(angles_mrad, dtype=np.float64)
    return MirrorFigures(place, angles, fit_mirror_map(place, angles))


def _approach(first_guess: MirrorMap, done_mm: Sequence[Place], done_mrad: Sequence[Place], place_mm: Place) -> Place:
    """Where the beam is likely to meet a mark, from the marks done so far."""
    if len(done_mm) >= LEAST_MARKS:
        try:
            return _angles(fitted_marks(done_mm, done_mrad).fit.mirror_map, place_mm)
        except InputError:  # marks on a line so far: the guess will do
            pass
    x_mrad, y_mrad = _angles(first_guess, place_mm)
    off = [
        (there[0] - guess[0], there[1] - guess[1])
        for there, guess in zip(done_mrad, (_angles(first_guess, mark) for mark in done_mm), strict=True)
    ]
    x_off, y_off = np.mean(off, axis=0) if off else (0.0, 0.0)
    return x_mrad + float(x_off), y_mrad + float(y_off)


def _angles(mirror_map: MirrorMap, place_mm: Place) -> Place:
    x_mrad, y_mrad = mirror_map.angles_mrad(*place_mm)
    return float(x_mrad), float(y_mrad)


def _point(setup: Setup, at_mrad: Place) -> None:
    with asking("mirror"):
        setup.instruments.mirror.move_to(*at_mrad)
        setup.instruments.mirror.wait_settled(setup.settle_timeout_s)
