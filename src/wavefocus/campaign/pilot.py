"""A pilot run of a few positions, and the grid spacing that it recommends.

The model of `wavefocus.calibration.coarse_grid` finds the plate's wave numbers and how much the rim reflects from some
30 positions. The deviations that it states between positions depend on these and on where is measured, not on what is
measured there: they can be stated for a grid before anything is measured on it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import numpy as np

from wavefocus.calibration import Float64Array
from wavefocus.calibration.coarse_grid.rim_waves import MIN_POSITIONS, RimWaves
from wavefocus.calibration.numerics import on_a_line
from wavefocus.campaign.blueprint import Blueprint, blueprint_of
from wavefocus.campaign.refinement import bank_transfer, measured_rows, relative_errors
from wavefocus.config.outline import Outline
from wavefocus.configuration import configuration_of
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.errors import InputError

PILOT_POSITIONS = 30
MIN_PILOT = 20
"""16 of a plate that reflects were explained by no or by wrong waves."""
SPACINGS_MM = (4.0, 6.0, 8.0, 10.0, 12.0, 16.0, 20.0)
REFINE_TO = 0.05
"""Expected error that a run without ``refine_to`` asks for."""
MAX_LEFT_OUT = 0.5
"""A model that misses a tenth of the left-out positions by more than this share does not explain them."""
SEED, JUDGED_SEED = 1, 2
JUDGED_POINTS = 200
STEP_MM = 1e-3

Reason = Literal["", "too_few_positions", "unknown_actuators", "not_explained", "not_reached"]
REASONS: dict[Reason, str] = {
    "too_few_positions": f"the pilot has fewer than {MIN_PILOT} measured positions, or they lie on one line",
    "unknown_actuators": "the pilot does not say where every actuator is",
    "not_explained": "the model misses left-out positions: it does not fit this plate, or the pilot is too small",
    "not_reached": "no spacing is expected to reach it; what stays is noise, or waves that the model does not have",
}


@dataclass(frozen=True, slots=True)
class SpacingForecast:
    """Forecast of a grid: relative error as of `refinement.ErrorMap`, median and 90 % of the surface, and the time.

    The errors are None where the pilot cannot state them.
    """

    spacing_mm: float
    positions: int
    hours: float
    expected_error: float | None = None
    expected_error_90: float | None = None


@dataclass(frozen=True, slots=True)
class PilotResult:
    """Recommended spacing, the coarsest whose `expected_error_90` is below `refine_to`, and the forecasts.

    positions: Measured positions of the pilot.
    band_hz: Lowest and highest frequency at which errors are stated.
    left_out_error, left_out_error_90: Relative error at a position that is left out, median and 90 % of them.
    reason: Why the finest spacing is recommended, a key of `REASONS`; empty where a forecast is below `refine_to`.
    """

    refine_to: float
    recommended_spacing_mm: float
    forecasts: tuple[SpacingForecast, ...]
    positions: int
    reason: Reason = ""
    band_hz: tuple[float, float] | None = None
    left_out_error: float | None = None
    left_out_error_90: float | None = None


def spread_positions(outline: Outline, margin_mm: float, count: int, seed: int) -> Float64Array:
    """Place positions evenly, but on no lattice, in serpentine order: a Halton sequence, shifted by the seed.

    Returns float64 (count, 2) in millimetres. Raises InputError: the surface has no room inside the margin.
    """
    from scipy.stats import qmc  # takes half a second

    left, bottom, right, top = outline.box_mm
    width_mm, height_mm = right - left - 2 * margin_mm, top - bottom - 2 * margin_mm
    if min(width_mm, height_mm) <= 0:
        raise InputError(f"margin_mm = {margin_mm:g}: leaves no position on the surface")
    unit = (qmc.Halton(2, scramble=False).random(100 * count) + np.random.default_rng(seed).random(2)) % 1.0
    places_mm = np.array((left, bottom)) + margin_mm + unit * (width_mm, height_mm)
    places_mm = np.round(places_mm / STEP_MM) * STEP_MM
    places_mm = places_mm[outline.contains(places_mm, margin_mm)][:count]
    if len(places_mm) < count:
        raise InputError(f"margin_mm = {margin_mm:g}: leaves too little of the surface for {count} positions")
    rows = max(1, round(np.sqrt(count * height_mm / width_mm)))
    row = np.minimum((places_mm[:, 1] - bottom - margin_mm) * rows // height_mm, rows - 1)
    return np.asarray(places_mm[np.lexsort((np.where(row % 2, -1, 1) * places_mm[:, 0], row))])


def pilot_positions(blueprint: Blueprint) -> Float64Array:
    """Positions of a pilot for a run, float64 (30, 2), over its surface inside its margin; always the same ones."""
    configuration = blueprint.configuration
    outline, margin_mm = configuration.rig.surface.outline, configuration.run.grid.margin_mm
    return spread_positions(outline, margin_mm, PILOT_POSITIONS, SEED)


def positions_text(position_mm: Float64Array) -> str:
    """Content of a positions file."""
    return "x_mm,y_mm\n" + "".join(f"{x:.3f},{y:.3f}\n" for x, y in position_mm.tolist())


def pilot_result(
    pilot: Path, blueprint: Blueprint, speed_m_s: float, spacings_mm: Sequence[float] = SPACINGS_MM
) -> PilotResult:
    """State expected errors and times of grids of some spacings for a run, from a pilot bank of the same rig.

    speed_m_s: Of the plate's waves, for the time of second looks.

    Raises InputError: the bank cannot be read, or is of another rig.
    """
    run, outline = blueprint.configuration.run, blueprint.configuration.rig.surface.outline
    target = REFINE_TO if run.grid.refine_to is None else run.grid.refine_to
    grids = _grids(blueprint, spacings_mm, speed_m_s)
    with open_bank(pilot) as bank:
        rows, reason = measured_rows(bank), _unusable(bank, blueprint)
        if reason:
            forecasts = tuple(forecast for _, forecast in grids)
            return PilotResult(target, min(spacings_mm), forecasts, len(rows), reason)
        frequency_hz, transfer = bank_transfer(bank, rows)
        position_mm, actuator_mm = bank.position_mm[rows], bank.actuator_mm
    model = RimWaves.fit(frequency_hz, position_mm, actuator_mm, transfer)
    level = np.maximum(np.linalg.norm(transfer, axis=(0, 2)), 1e-300)
    left_out = np.linalg.norm(model.left_out(transfer), axis=(0, 2)) / level
    points_mm = spread_positions(outline, run.grid.margin_mm, JUDGED_POINTS, JUDGED_SEED)
    values = model.values(points_mm)
    found, recommended = [], None
    for grid_mm, forecast in grids:
        error = relative_errors(measured_at(model, grid_mm), points_mm, values)
        middle, upper = (float(np.quantile(error, share)) for share in (0.5, 0.9))
        found.append(replace(forecast, expected_error=middle, expected_error_90=upper))
        if upper < target:
            recommended = max(forecast.spacing_mm, recommended or 0.0)
    missed, missed_90 = (float(np.quantile(left_out, share)) for share in (0.5, 0.9))
    if missed_90 > MAX_LEFT_OUT:
        reason, recommended = "not_explained", None
    elif recommended is None:
        reason = "not_reached"
    band_hz = float(frequency_hz[0]), float(frequency_hz[-1])
    return PilotResult(
        target, recommended or min(spacings_mm), tuple(found), len(rows), reason, band_hz, missed, missed_90
    )


def measured_at(model: RimWaves, position_mm: Float64Array) -> RimWaves:
    """The model with the deviations that it would state if it were fitted at other positions."""
    level = np.square(np.abs(model.values(position_mm))).mean(axis=0)
    return replace(model, position_mm=position_mm, relative_level=np.maximum(level / level.mean(axis=0), 1e-12))


def _unusable(bank: Bank, blueprint: Blueprint) -> Reason:
    if not np.isfinite(bank.actuator_mm).all():
        return "unknown_actuators"
    own_mm = blueprint.plan.actuator_mm
    if bank.actuator_mm.shape != own_mm.shape or not np.allclose(bank.actuator_mm, own_mm, atol=STEP_MM):
        raise InputError(f"{bank.path}: its actuators are not where those of the run's rig are; it is of another rig")
    position_mm = bank.position_mm[measured_rows(bank)]
    if len(position_mm) < MIN_PILOT or on_a_line(position_mm):
        return "too_few_positions"
    return ""


def _grids(
    blueprint: Blueprint, spacings_mm: Sequence[float], speed_m_s: float
) -> list[tuple[Float64Array, SpacingForecast]]:
    """Positions of the run's grid at some spacings, and what they take; those of too few positions are left out."""
    run, rig = blueprint.configuration.run, blueprint.configuration.rig
    found = []
    for spacing_mm in spacings_mm:
        grid = run.grid.model_copy(update={"spacing_mm": spacing_mm, "positions_file": None, "check_positions": None})
        try:
            configuration = configuration_of(run.model_copy(update={"grid": grid}), rig, None, "grid")
        except InputError:  # the surface has no room for it
            continue
        plan = blueprint_of(configuration).plan
        if plan.positions >= MIN_POSITIONS:
            hours = plan.campaign_s(plan.order, rig.recorder, speed_m_s) / 3600.0
            found.append((plan.position_mm, SpacingForecast(spacing_mm, plan.positions, hours)))
    return found
