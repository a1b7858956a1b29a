"""The cheapest interpolation that serves: nearest on positions, else the kernel, else waves; and the public one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from wavefocus.calibration.evidence import MOST
from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.greens.interpolation.base import (
    Interpolation,
    InterpolationChoice,
    OffGridError,
    grid_position_mm,
    interpolation_method,
    near,
    scene_points,
)
from wavefocus.rendering.greens.interpolation.errors import BANDS, MAX_POINTS, EmittedSpectrum, bank_band_hz
from wavefocus.rendering.greens.interpolation.on_grid import Nearest
from wavefocus.rendering.greens.interpolation.path_nodes import REACH_SPACINGS
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.source import GreenSource, RowReader, usable
from wavefocus.rendering.scene.model import Scene
from wavefocus.storage.argument_types import real_array
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.reader import DamagedError

KERNEL_ERROR = 0.02
"""Left-out error in the scene's band below which waves, which take minutes, are not asked."""
ON_POSITION = 1e-6
"""Distance from a position, in grid spacings, up to which a place is on it."""


def scene_choice(scene: Scene, bank: GreenSource) -> Interpolation:
    """The cheapest method that serves a scene; as of `choose_interpolation`.

    Of a path that leaves the grid "nearest", by which the path point is named where it is sampled.
    """
    rate_hz, points_mm, grid = float(bank.sample_rate_hz), scene_points(scene, 4096), PositionGrid(bank.position_mm)
    try:
        near(grid, points_mm, REACH_SPACINGS)
        signals = [source.amplitude * source.signal.samples(rate_hz) for source in scene.sources]
        return choose_interpolation(bank, points_mm, signals)
    except OffGridError:
        return Nearest(PositionGrid(grid_position_mm(bank)))


def choose_interpolation(
    bank: GreenSource, points_mm: Float64Array, signals: Sequence[Float64Array] = ()
) -> Interpolation:
    """The cheapest method that serves at points, float64 (n, 2), for what is emitted; `choice` says from what.

    "nearest" where every point is a position; "kernel" where its left-out error in the emitted band is below 2 %; else
    whichever of "waves" and "kernel" errs less; "nearest" where neither can be used, or is right by chance only.

    signals: What is emitted, at the bank's rate; by default the whole band counts alike.

    Raises InputError: no method can be used.
    """
    unsuited: dict[str, str | InputError] = dict(getattr(bank, "import_facts", {}).get("unsuited", {}))
    nearest = _usable("nearest", bank, points_mm, unsuited)
    if nearest is not None and _on_positions(bank, points_mm):
        nearest.choice = InterpolationChoice("positions", {"nearest": 0.0}, {})
        return nearest
    points_mm = points_mm[evenly_spread(len(points_mm), MAX_POINTS)]
    frequency_hz, emitted = emitted_bands(bank, signals)
    found: dict[str, tuple[Interpolation, float, str]] = {}
    for name in ("kernel", "waves"):
        if (method := _usable(name, bank, points_mm, unsuited)) is not None:
            estimate = method.estimate(bank, points_mm, frequency_hz)
            error = float(np.sqrt(emitted @ np.square(np.median(estimate.relative, axis=1))))
            found[name] = method, error, estimate.judged_by
            if error < KERNEL_ERROR:
                break
    method, error, judged_by = min(found.values(), key=lambda one: one[1], default=(nearest, np.inf, "nothing"))
    if method is not None and error < MOST:  # more of what is there is found than missed
        method.choice = InterpolationChoice(judged_by, {name: one[1] for name, one in found.items()}, _words(unsuited))
        return method
    if nearest is None:
        raise next((one for one in unsuited.values() if isinstance(one, InputError)), InputError(f"{unsuited}"))
    errors = {name: one[1] for name, one in found.items()}
    nearest.choice = InterpolationChoice(judged_by, {"nearest": float("nan")} | errors, _words(unsuited))
    return nearest


def emitted_bands(bank: GreenSource, signals: Sequence[Float64Array]) -> tuple[Float64Array, Float64Array]:
    """Bands over what is emitted, and the share of each; without signals over the bank's band, all alike."""
    spectrum, band_hz = EmittedSpectrum(signals, float(bank.sample_rate_hz)), bank_band_hz(bank)
    frequency_hz = spectrum.bands_hz(band_hz, BANDS)
    emitted = spectrum.shares(frequency_hz, band_hz)
    return frequency_hz, emitted / emitted.sum() if emitted.sum() > 0 else np.full(len(emitted), 1.0 / len(emitted))


def _usable(
    name: str, bank: GreenSource, points_mm: Float64Array, unsuited: dict[str, str | InputError]
) -> Interpolation | None:
    """A method that can interpolate at the points; else None, and why not in `unsuited`."""
    if name in unsuited:
        return None
    try:
        method = interpolation_method(name).over(bank, points_mm)
        method.nodes(points_mm)
    except DamagedError:
        raise
    except InputError as error:
        unsuited[name] = error
        return None
    return method


def _words(unsuited: dict[str, str | InputError]) -> dict[str, str]:
    return {
        name: f"a point of a path {reason}" if isinstance(reason, OffGridError) else str(reason)
        for name, reason in unsuited.items()
    }


def _on_positions(bank: GreenSource, points_mm: Float64Array) -> bool:
    grid = PositionGrid(grid_position_mm(bank))
    rows, distance_mm = grid.nearest(points_mm)
    return bool((distance_mm <= ON_POSITION * grid.spacing_mm).all() and usable(bank)[rows].all())


@dataclass(frozen=True, slots=True, eq=False)
class Interpolated:
    """Green's functions at places between a bank's positions, and how wrong they are.

    method: ``"nearest"``, ``"bilinear"``, ``"kernel"`` or ``"waves"``.
    green, float64 (places, actuators, taps): In the bank's unit.
    frequency_hz, float64 (frequencies,).
    expected_error, bound, float64 (places, actuators, frequencies): Root mean square of the error that is expected of
        the spectra ``sum_k g[k] exp(-2j pi f k / rate)``, and its bound, in the bank's unit; NaN where there is none.
    bound_words: The share of places, actuators and frequencies that the bound holds, or why there is none.
    """

    method: str
    green: Float64Array
    frequency_hz: Float64Array
    expected_error: Float64Array
    bound: Float64Array
    bound_words: str


def interpolated(
    bank: GreenSource, places_mm: ArrayLike, method: str = "auto", frequency_hz: ArrayLike | None = None
) -> Interpolated:
    """Green's functions at places (n, 2).

    method: As of scenes.
    frequency_hz: At which errors are stated; by default six over the bank's band.

    Raises InputError: a place is off the grid, or the bank does not allow the method.
    """
    points_mm = real_array("places_mm", places_mm)
    if points_mm.ndim != 2 or points_mm.shape[1] != 2 or not len(points_mm):
        raise InputError(f"places_mm has shape {points_mm.shape}; expected (places, 2), at least one place")
    hz = emitted_bands(bank, ())[0] if frequency_hz is None else np.atleast_1d(real_array("frequency_hz", frequency_hz))
    if hz.ndim != 1 or not len(hz) or not ((hz > 0) & (hz <= 0.5 * float(bank.sample_rate_hz))).all():
        raise InputError(f"frequency_hz is {hz.tolist()}; allowed are frequencies up to half the bank's rate")
    auto = method == "auto"
    kind = choose_interpolation(bank, points_mm) if auto else interpolation_method(method).over(bank, points_mm)
    nodes, reader = kind.nodes(points_mm), RowReader(kind.rows_of(bank))
    green = np.zeros((len(points_mm), bank.actuators, bank.taps))
    for place, (own, weights) in enumerate(zip(nodes.rows.tolist(), nodes.weights.tolist(), strict=True)):
        for row, weight in zip(own, weights, strict=True):
            if weight:
                green[place] += weight * reader.read(row)
    shape = len(hz), len(points_mm), bank.actuators
    try:
        found = kind.estimate(bank, points_mm, hz)
        expected, bound, words = found.expected, found.bound, found.bound_words
    except InputError as error:
        expected, bound, words = np.full(shape, np.nan), np.full(shape, np.nan), f"no bound: {error}"
    return Interpolated(kind.name, green, hz, expected.transpose(1, 2, 0), bound.transpose(1, 2, 0), words)
