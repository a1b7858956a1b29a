"""Refinement of a grid: after the regular positions, those where the expected error between positions is largest.

The model of `wavefocus.calibration.coarse_grid` is fitted to what the bank holds, and states the relative error that
it expects at any point. Points of a fine lattice are taken from the largest expected error down, no two closer than a
share of the grid's spacing, and are added to the bank; when they are measured, the model is fitted again. It ends when
all of the surface is below `refine_to`, or `refine_positions` are used up. Everything follows from the bank, so that a
campaign that is stopped anywhere goes on as one that is not.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from wavefocus.acquisition.grid import surface_grid
from wavefocus.calibration import Complex128Array, Float64Array, Int64Array
from wavefocus.calibration.coarse_grid.rim_waves import MIN_POSITIONS, RimWaves, grid_spacing_mm
from wavefocus.calibration.numerics import transform_at
from wavefocus.campaign.blueprint import Blueprint, bank_configuration
from wavefocus.campaign.extension import grow
from wavefocus.campaign.sidecar_files import expected_path, read_expected_errors
from wavefocus.console import say
from wavefocus.rendering.number_text import percent
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import write_whole
from wavefocus.storage.point_status import usable

FREQUENCIES = 6
"""So many, evenly spaced over the band, state the expected error."""
EDGE = 0.1
"""The band's outer tenths are left alone: there a sweep is faint."""
LATTICE_SHARE = 1 / 3
"""Spacing of the points that may be added, over the grid's."""
MAX_POINTS = 5000
ROUND = 24
"""Positions that are added before the model is fitted again."""
APART = 0.75
"""Least distance of two positions of one round, over the grid's spacing: one makes the other's error small."""


@dataclass(frozen=True, slots=True)
class ErrorMap:
    """Expected relative errors between the positions of a bank.

    points_mm, float64 (points, 2): A lattice over the surface.
    error, float64 (points,): L2 over the actuators and the frequencies, over that of the transfer functions.
    """

    points_mm: Float64Array
    error: Float64Array

    @property
    def largest(self) -> float:
        """Largest expected error."""
        return float(self.error.max(initial=0.0))


def expected_errors(bank: Bank) -> ErrorMap:
    """State the error that is expected between a bank's positions, over its surface.

    Raises InputError: places of actuators are unknown, or too few positions are measured.
    """
    configuration = bank_configuration(bank)
    grid, outline = configuration.run.grid, configuration.rig.surface.outline
    rows = measured_rows(bank)
    if len(rows) < MIN_POSITIONS or not np.isfinite(bank.actuator_mm).all():
        raise InputError(
            f"{bank.path}: grid.refine_to needs at least {MIN_POSITIONS} measured positions, and the place of every "
            f"actuator; {len(rows)} positions are measured"
        )
    position_mm, check = bank.position_mm[rows], bank.check[rows]
    frequency_hz, transfer = bank_transfer(bank, rows)
    model = RimWaves.fit(
        frequency_hz, position_mm[~check], bank.actuator_mm, transfer[:, ~check], position_mm[check],
        transfer[:, check],
    )  # fmt: skip
    spacing_mm = LATTICE_SHARE * grid_spacing_mm(position_mm)
    points_mm = surface_grid(outline, grid.margin_mm, max(spacing_mm, np.sqrt(outline.area_mm2 / MAX_POINTS)))
    return ErrorMap(points_mm, relative_errors(model, points_mm, model.values(points_mm)))


def measured_rows(bank: Bank) -> Int64Array:
    """Rows that the model may be fitted to."""
    return np.flatnonzero(usable(bank.status))


def bank_transfer(bank: Bank, rows: Int64Array) -> tuple[Float64Array, Complex128Array]:
    """Frequencies in Hz that state the expected error, and transfer functions, (frequencies, rows, actuators)."""
    low_hz, high_hz = bank.band_hz or (0.0, bank.sample_rate_hz / 2)
    edge_hz = EDGE * (high_hz - low_hz)
    frequency_hz = np.linspace(low_hz + edge_hz, high_hz - edge_hz, FREQUENCIES)
    transfer = np.stack([transform_at(bank.green(int(row)), frequency_hz, bank.sample_rate_hz) for row in rows])
    return frequency_hz, transfer.transpose(2, 0, 1).astype(np.complex128)


def relative_errors(model: RimWaves, points_mm: Float64Array, values: Complex128Array) -> Float64Array:
    """Error that a model expects at points, (points,), as of `ErrorMap`.

    values, complex128 (frequencies, points, actuators): The transfer functions there.
    """
    there = np.linalg.norm(values, axis=(0, 2))
    missed = np.linalg.norm(model.deviations(points_mm, range(len(model.frequency_hz))), axis=(0, 2))
    return np.asarray(missed / np.maximum(np.hypot(there, missed), 1e-300))


def worst_points(found: ErrorMap, position_mm: Float64Array, refine_to: float, most: int) -> Float64Array:
    """At most so many points above an expected error, the largest first, apart from each other and all positions."""
    apart_mm = APART * grid_spacing_mm(position_mm)
    near_mm: Float64Array = np.asarray(cKDTree(position_mm).query(found.points_mm)[0])
    chosen: list[Float64Array] = []
    for index in np.argsort(-found.error, kind="stable").tolist():
        place_mm = found.points_mm[index]
        if len(chosen) == most or found.error[index] <= refine_to:
            break
        if near_mm[index] > LATTICE_SHARE * apart_mm and all(
            np.hypot(*(place_mm - other)) >= apart_mm for other in chosen
        ):
            chosen.append(place_mm)
    return np.array(chosen, np.float64).reshape(-1, 2)


def refine(path: Path, blueprint: Blueprint) -> Blueprint | None:
    """Add the next positions to a finished bank, if its run asks for any; None where nothing is to be added.

    The bank is replaced as a whole. Raises InputError: the expected error cannot be stated.
    """
    grid = blueprint.configuration.run.grid
    with open_bank(path) as bank:
        if grid.refine_to is None or (bank.status == 0).any():
            return None
        regular = grid.regular_positions or bank.positions
        left = grid.refine_positions - (bank.positions - regular)
        found = expected_errors(bank)
        _keep_map(path, found, bank.positions - regular)
        reached = f"{path}: the expected error between positions is at most {percent(found.largest)}"
        if found.largest <= grid.refine_to:
            say(f"{reached}: refined enough")
            return None
        added_mm = worst_points(found, bank.position_mm, grid.refine_to, min(left, ROUND))
    if not len(added_mm):
        why = "grid.refine_positions are used up" if left <= 0 else "no point is far enough from the positions"
        say(f"{reached}, more than refine_to = {percent(grid.refine_to)}: {why}")
        return None
    say(f"{reached}; {len(added_mm)} positions are added where it is largest")
    return grow(path, blueprint, added_mm, regular)


def _keep_map(bank: Path, found: ErrorMap, added: int) -> None:
    """Keep the map before the first refinement, and the latest, beside the bank; a full disk ends nothing."""
    path = expected_path(bank)
    latest = {"added": added, "points_mm": found.points_mm.round(3).tolist(), "error": found.error.round(5).tolist()}
    before = read_expected_errors(bank).get("before", latest) if added else latest
    try:
        write_whole(path, json.dumps({"format": "wavefocus-expected-error", "before": before, "after": latest}) + "\n")
    except (OSError, InputError) as failure:
        say(f"{path} cannot be written ({failure}); the campaign goes on without it")
