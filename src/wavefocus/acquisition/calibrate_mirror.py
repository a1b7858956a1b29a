"""Calibrating the mirror: from marks on the surface, where the operator jogs the beam, to the map of its angles."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from msgspec.structs import replace

from wavefocus.acquisition.grid import read_rows
from wavefocus.acquisition.setup import SETTLE_S, Setup, naming_role
from wavefocus.calibration.mirror_map import MIN_MARKS, MirrorMap, MirrorMapFit, fit_mirror_map
from wavefocus.config.messages.rig_checks import Answer, AskJog, MapView
from wavefocus.storage.errors import InputError, WavefocusError


class NotMeasuredError(WavefocusError):
    """What was to be calibrated cannot be measured as things are; the message says what to do."""


VIBROMETER, SUM, BOTH = "vibrometer", "sum", "both"


def output(channel: int) -> str:
    """The word for an output of the player, plugged into the response input."""
    return f"output {channel}"


class Operator(ABC):
    """A person with two hands; every method returns when it is done.

    source: What is plugged into the response input; empty until it is done.
    plug: Plugs the response input of a virtual rig along with it.
    """

    source = VIBROMETER
    plug: Callable[[str], object] | None = None

    def connect(self, source: str) -> None:
        """Have something plugged into the response input.

        source: ``"vibrometer"``, ``"output K"`` (output K of the player), ``"sum"`` (the summing box that all outputs
            for actuators are plugged into) or ``"both"`` (the loopback, which the reference input gets too).
        """
        self.source = ""
        self.plug_in(source)
        if self.plug is not None:
            self.plug(source)
        self.source = source

    @abstractmethod
    def report(self, line: str) -> None:
        """Read a line."""

    @abstractmethod
    def plug_in(self, source: str) -> None:
        """Plug something into the response input."""

    @abstractmethod
    def jog(self, view: AskJog) -> Answer:
        """Say how the beam is to move next (``by`` or ``to``), or that it is ``here``."""

    @abstractmethod
    def judge(self, view: MapView) -> Answer:
        """Look at the residuals of a mirror map: ``keep`` it, ``redo`` a mark, or ``drop`` it."""

    @abstractmethod
    def again(self, problem: str) -> bool:
        """Look for what is wrong; True to try once more, False to leave this out."""


Place = tuple[float, float]
PLACES = ["x_mm", "y_mm"]
PLACES_AND_ANGLES = [*PLACES, "x_mrad", "y_mrad"]
MAX_MARKS = 1000


def read_fiducials(path: Path) -> tuple[tuple[Place, ...], tuple[Place, ...] | None]:
    """Read marks from a CSV file with the header ``x_mm,y_mm`` or ``x_mm,y_mm,x_mrad,y_mrad``.

    Returns places in millimetres, and angles in milliradians or None where the file has none.
    Raises InputError: too few marks or too many, and as `wavefocus.acquisition.grid.read_rows`.
    """
    names, rows = read_rows(path, PLACES, PLACES_AND_ANGLES)
    if not MIN_MARKS <= len(rows) <= MAX_MARKS:
        raise InputError(f"{path}: has {len(rows)} marks; a mirror map needs at least 4, and at most {MAX_MARKS}")
    places = tuple((mark[0], mark[1]) for _, mark in rows)
    return places, tuple((mark[2], mark[3]) for _, mark in rows) if names == PLACES_AND_ANGLES else None


def suspect_mark(fit: MirrorMapFit) -> int:
    """The mark, from 0, that is most likely to be wrong: the others agree best without it.

    One mark that is off bends the map towards itself, and others then seem further off. With five marks or fewer the
    others always agree, so there the mark that is missed most is suspected.
    """
    marks = len(fit.place_mm)
    if marks <= MIN_MARKS + 1:
        return int(np.argmax(fit.residual_mm))

    def rms_without(mark: int) -> float:
        try:
            return fit_mirror_map(*(np.delete(each, mark, axis=0) for each in (fit.place_mm, fit.angles_mrad))).rms_mm
        except InputError:  # without it, the others decide nothing
            return float("inf")

    return min(range(marks), key=rms_without)


def measure_mirror(
    setup: Setup, marks_mm: Sequence[Place], limit_mrad: float, operator: Operator, limit_mm: float
) -> MirrorMapFit:
    """Let the operator bring the beam onto each mark, and fit the map.

    Each mark is approached with the map so far: the rig's own, moved to meet the marks done, and from
    the fifth mark on a fit through them. The operator judges what comes of it and may meet a mark once more.

    setup: The rig, with a first guess of the map.
    marks_mm: Where the marks lie on the surface, four or more.
    limit_mrad: Largest angle that the mirror may be sent to.
    operator: Jogs the beam and says when it is there.
    limit_mm: Largest residual that is reported as good enough.

    Raises InputError: marks that no map can be fitted through. NotMeasuredError: the operator leaves the map, or has
    moved the beam at too few marks. InstrumentError: of the mirror.
    """
    found: list[Place] = []
    moved: set[int] = set()

    def meet(mark: int, start: Place) -> Place:
        view = AskJog(mark + 1, len(marks_mm), marks_mm[mark], start)
        at_mrad, is_moved = _met(setup, view, limit_mrad, operator)
        if is_moved:
            moved.add(mark)
        return at_mrad

    for mark, place_mm in enumerate(marks_mm):
        found.append(meet(mark, _approach(setup.mirror_map, marks_mm[:mark], found, place_mm)))
    while True:
        fitted: MirrorMapFit | InputError | NotMeasuredError
        try:
            fitted = fit_mirror_map(marks_mm, found)
        except InputError as wrong:
            fitted = wrong
        if len(moved) < MIN_MARKS:  # the present map put the beam at the others, and would only be found again
            fitted = NotMeasuredError(
                f"Move the beam onto at least {MIN_MARKS} marks. It was moved at {len(moved)} of {len(marks_mm)}; if "
                "the spot was on every mark as it stood, the present map is right"
            )
        judged = operator.judge(_view(marks_mm, fitted, limit_mm))
        if judged.answer == "drop":
            raise NotMeasuredError("its map was looked at and left")
        if judged.answer == "redo":
            found[judged.mark - 1] = meet(judged.mark - 1, found[judged.mark - 1])
        elif isinstance(fitted, Exception):
            raise fitted
        else:
            return fitted


def _met(setup: Setup, view: AskJog, limit_mrad: float, operator: Operator) -> tuple[Place, bool]:
    """Let the operator bring the beam onto one mark: where the mirror stands then, and whether it was moved for it."""
    x_mrad, y_mrad = np.clip(view.at_mrad, -limit_mrad, limit_mrad).tolist()
    view, moved = replace(view, at_mrad=(x_mrad, y_mrad)), False
    _point(setup, view.at_mrad)
    while True:
        step = operator.jog(view)
        if step.answer == "here":
            return view.at_mrad, moved
        wanted = (step.x_mrad, step.y_mrad)
        if step.answer == "by":
            wanted = (view.at_mrad[0] + step.x_mrad, view.at_mrad[1] + step.y_mrad)
        if max(map(abs, wanted)) > limit_mrad:
            note = f"({wanted[0]:.3f}, {wanted[1]:.3f}) mrad is beyond the limit of {limit_mrad:g} mrad: not moved"
            view = replace(view, note=note)
            continue
        view, moved = replace(view, at_mrad=wanted, note=""), moved or step != Answer("by")
        _point(setup, wanted)


def _view(marks_mm: Sequence[Place], figures: MirrorMapFit | Exception, limit_mm: float) -> MapView:
    if isinstance(figures, Exception):
        return MapView(tuple(marks_mm), (), np.nan, np.nan, limit_mm, 0, str(figures))
    suspect, problem = suspect_mark(figures) + 1, ""
    if figures.worst_mm > limit_mm:
        problem = (
            f"the map misses a mark by {figures.worst_mm:.2f} mm, more than the {limit_mm:g} mm allowed: most likely "
            f"mark {suspect} is wrong; check its place and jog the beam onto it again"
        )
    off_mm = tuple((float(x_mm), float(y_mm)) for x_mm, y_mm in figures.off_mm)
    return MapView(tuple(marks_mm), off_mm, figures.rms_mm, figures.worst_mm, limit_mm, suspect, problem)


def _approach(first_guess: MirrorMap, done_mm: Sequence[Place], done_mrad: Sequence[Place], place_mm: Place) -> Place:
    """Where the beam is likely to meet a mark, from the marks done so far."""
    if len(done_mm) >= MIN_MARKS:
        try:
            return _angles(fit_mirror_map(done_mm, done_mrad).mirror_map, place_mm)
        except InputError:  # marks on a line so far: the guess will do
            pass
    x_mrad, y_mrad = _angles(first_guess, place_mm)
    if not done_mm:
        return x_mrad, y_mrad
    x_off, y_off = np.mean(np.array(done_mrad) - [_angles(first_guess, mark) for mark in done_mm], axis=0).tolist()
    return x_mrad + x_off, y_mrad + y_off


def _angles(mirror_map: MirrorMap, place_mm: Place) -> Place:
    x_mrad, y_mrad = mirror_map.angles_mrad(*place_mm)
    return float(x_mrad), float(y_mrad)


def _point(setup: Setup, at_mrad: Place) -> None:
    with naming_role("mirror"):
        setup.mirror.move_to(*at_mrad)
        setup.mirror.wait_settled(SETTLE_S)
