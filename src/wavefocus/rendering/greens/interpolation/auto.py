"""The interpolation of least expected error in a scene's band."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Self

import numpy as np

from wavefocus.config.interpolations import INTERPOLATIONS
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import (
    Interpolation,
    Nodes,
    OffGridError,
    interpolation_method,
    scene_points,
)
from wavefocus.rendering.greens.interpolation.error_bands import InterpolationChoice
from wavefocus.rendering.greens.interpolation.error_estimates import left_out_errors
from wavefocus.rendering.greens.interpolation.errors import BANDS, EMITTED_SHARE, EmittedSpectrum, bank_band_hz
from wavefocus.rendering.greens.interpolation.kernel import KernelInterpolation
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.interpolation.row_values import RowValues
from wavefocus.rendering.greens.interpolation.waves import WavesInterpolation
from wavefocus.rendering.greens.source import GreenSource, usable_checks
from wavefocus.rendering.scene.model import Scene
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.reader import DamagedError

MIN_CHECKS = 3


class AutoInterpolation(Interpolation):
    """Not a method of its own: `over_scene` gives the method whose error is least."""

    name = "auto"

    @classmethod
    def over(cls, bank: GreenSource, around_mm: Float64Array) -> Self:
        raise InputError("interpolation is 'auto', which is chosen for a scene; name a method instead")

    @classmethod
    def over_scene(cls, scene: Scene, bank: GreenSource) -> Interpolation:
        rate_hz = float(bank.sample_rate_hz)
        signals = [source.amplitude * source.signal.samples(rate_hz) for source in scene.sources]
        return choose_interpolation(bank, scene_points(scene), signals)

    @classmethod
    def needed_rows(cls, grid: PositionGrid, rows: set[int], points_mm: Float64Array, step_mm: float) -> set[int]:
        """All, as for "waves"."""
        return WavesInterpolation.needed_rows(grid, rows, points_mm, step_mm)

    def nodes(self, points_mm: Float64Array) -> Nodes:
        raise NotImplementedError


def choose_interpolation(bank: GreenSource, points_mm: Float64Array, signals: Sequence[Float64Array]) -> Interpolation:
    """The method of least expected error at points, float64 (n, 2), for what is emitted; `choice` says from what.

    Left-out positions judge where the grid resolves the waves (wave number times spacing at most pi in the emitted
    band), else the bank's check positions.

    Raises InputError: no method can be used.
    """
    methods, unsuited = _usable_methods(bank, points_mm)
    spectrum = EmittedSpectrum(signals, float(bank.sample_rate_hz))
    frequency_hz = spectrum.bands_hz(bank_band_hz(bank), BANDS)
    emitted = spectrum.shares(frequency_hz, bank_band_hz(bank))
    emitted = emitted / emitted.sum() if emitted.sum() > 0 else np.full(len(emitted), 1.0 / len(emitted))
    checks = np.flatnonzero(usable_checks(bank))
    if _resolved(methods, frequency_hz[emitted >= EMITTED_SHARE]):
        judged_by = "left-out positions"
        errors = {name: _left_out(bank, method, methods, points_mm, frequency_hz) for name, method in methods.items()}
    elif len(checks) >= MIN_CHECKS:
        judged_by = "check positions"
        errors = {name: _at_checks(bank, method, checks, frequency_hz) for name, method in methods.items()}
    else:
        judged_by = "nothing"
        errors = {name: np.full(len(frequency_hz), np.nan) for name in methods}
    overall = {name: float(np.sqrt(np.sum(emitted * np.square(error)))) for name, error in errors.items()}
    judged = {name: error for name, error in overall.items() if np.isfinite(error)}
    chosen = min(judged, key=lambda name: judged[name]) if judged else next(n for n in PREFERRED if n in methods)
    method = methods[chosen]
    method.choice = InterpolationChoice(judged_by, overall, unsuited)
    return method


PREFERRED = ("waves", "kernel", "bilinear", "nearest")
"""Methods in the order in which they are taken where nothing judges."""


def _usable_methods(bank: GreenSource, points_mm: Float64Array) -> tuple[dict[str, Interpolation], dict[str, str]]:
    """Methods that can interpolate at the points, and why the others cannot."""
    methods: dict[str, Interpolation] = {}
    unsuited: dict[str, str] = {}
    imported = getattr(bank, "import_facts", {}).get("unsuited", {})
    last: InputError | None = None
    for name in INTERPOLATIONS:
        if name == AutoInterpolation.name:
            continue
        try:
            if name in imported:
                raise InputError(f"the bank was imported: {imported[name]}")
            method = interpolation_method(name).over(bank, points_mm)
            method.nodes(points_mm)
        except OffGridError as error:
            unsuited[name], last = f"a point of a path {error}", error
        except DamagedError:
            raise
        except InputError as error:
            unsuited[name], last = str(error), error
        else:
            methods[name] = method
    if not methods and last is not None:
        raise last
    return methods, unsuited


def _resolved(methods: dict[str, Interpolation], frequency_hz: Float64Array) -> bool:
    waves, kernel = methods.get("waves"), methods.get("kernel")
    if isinstance(waves, WavesInterpolation):
        model = waves.waves.model
        return bool(np.interp(frequency_hz, model.frequency_hz, model.resolved).max() <= 1.0)
    if isinstance(kernel, KernelInterpolation):
        wavenumber = np.abs(kernel.waves.at(frequency_hz).wavenumber_rad_mm)
        return bool(wavenumber.max() * kernel.neighbourhoods.spacing_mm <= np.pi)
    return True


def _left_out(
    bank: GreenSource,
    method: Interpolation,
    methods: dict[str, Interpolation],
    points_mm: Float64Array,
    frequency_hz: Float64Array,
) -> Float64Array:
    if isinstance(method, WavesInterpolation):
        return method.error_bands(points_mm, frequency_hz).median
    kernel = methods.get("kernel")
    if not isinstance(kernel, KernelInterpolation):
        return np.full(len(frequency_hz), np.nan)
    nodes = None if method is kernel else method.nodes(points_mm)
    return left_out_errors(kernel, points_mm, nodes, RowValues(bank, frequency_hz)).median


def _at_checks(
    bank: GreenSource, method: Interpolation, checks: Int64Array, frequency_hz: Float64Array
) -> Float64Array:
    """Median error of a method at the check positions, (frequencies,); NaN where fewer than three lie on its grid."""
    measured = RowValues(bank, frequency_hz).of(checks)
    values = RowValues(method.rows_of(bank), frequency_hz)
    found = []
    for place, point_mm in enumerate(np.asarray(bank.position_mm, dtype=np.float64)[checks]):
        try:
            nodes = method.nodes(point_mm[None])
        except OffGridError:
            continue
        used = nodes.weights[0] != 0
        made = np.einsum("n,fna->fa", nodes.weights[0][used], values.of(nodes.rows[0][used]))
        there = measured[:, place]
        found.append(np.linalg.norm(made - there, axis=1) / np.maximum(np.linalg.norm(there, axis=1), 1e-300))
    if len(found) < MIN_CHECKS:
        return np.full(len(frequency_hz), np.nan)
    return np.asarray(np.median(found, axis=0))
