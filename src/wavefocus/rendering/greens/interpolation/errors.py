"""Error of the bank between its positions by frequency; the cheapest interpolation that serves; the public one."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from wavefocus.calibration.evidence import MOST
from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import BoolArray, Float64Array
from wavefocus.rendering.greens.interpolation.base import (
    GridInterpolation,
    Interpolation,
    InterpolationChoice,
    Nearest,
    OffGridError,
    bank_grid,
    interpolation_method,
    near,
    scene_points,
)
from wavefocus.rendering.greens.interpolation.path_nodes import REACH_SPACINGS
from wavefocus.rendering.greens.source import GreenSource, RowReader, usable
from wavefocus.rendering.scene.model import Scene
from wavefocus.storage.argument_types import real_array
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.reader import DamagedError

MAX_POINTS = 128
SIGNAL_BLOCK, SIGNAL_BLOCKS = 4096, 6
_BANDS = 6
EDGE_SHARE = 5e-3
"""Energy at either end of the emitted spectrum that the bands need not reach."""


@dataclass(frozen=True, slots=True)
class InterpolationErrors:
    """Estimated error of the interpolated Green's functions along the scene's paths.

    The error at a point and frequency is the L2 norm over the actuators of what is wrong, over that of what is
    there.

    found_by: ``"left-out positions"``: error of the kernel regression at positions that are left out of it, scaled
        to the points by its own variance; of other kinds with the difference to that regression. ``"check positions"``,
        ``"left-out positions"`` of waves: their deviations, as these judge them.
    frequency_hz, float64 (bands,): Centres of bands.
    emitted, float64 (bands,): Share of what the sources emit into the band and the bank passes; they sum to 1.
    median, worst, float64 (bands,): Relative error over the points.
    choice: What the interpolation was chosen from; None where the scene names it.
    """

    kind: str
    found_by: str
    frequency_hz: Float64Array
    emitted: Float64Array
    median: Float64Array
    worst: Float64Array
    choice: InterpolationChoice | None = None

    @property
    def overall(self) -> float:
        """Median error of all bands together: root mean square, weighted by what is emitted."""
        return float(np.sqrt(np.sum(self.emitted * np.square(self.median))))

    @property
    def largest(self) -> tuple[float, float]:
        """Frequency and median error of the worst band that the scene uses."""
        # Bands with less of the scene's energy do not count.
        used = np.flatnonzero(self.emitted >= 0.01)
        band = int(used[np.argmax(self.median[used])]) if len(used) else int(np.argmax(self.emitted))
        return float(self.frequency_hz[band]), float(self.median[band])

    @property
    def words(self) -> str:
        """One sentence: the method, its error, what says so, and what it was chosen from."""
        frequency_hz, error = self.largest
        sentence = (
            f"interpolation {self.kind!r}: expected error {_percent(self.overall)} in the scene's band, up to"
            f" {_percent(error)} at {frequency_hz:.3g} Hz (median along the paths, by {self.found_by})"
        )
        if self.choice is None:
            return sentence
        others = [
            f"{name!r} {_percent(found)}" for name, found in self.choice.errors.items()
            if name != self.kind and np.isfinite(found)
        ]  # fmt: skip
        return f"{sentence}; chosen by {self.choice.judged_by}{' before ' + ', '.join(others) if others else ''}"

    @property
    def facts(self) -> dict[str, object]:
        """As JSON has it."""
        bands = {
            "frequency_hz": self.frequency_hz.tolist(),
            "emitted": self.emitted.tolist(),
            "median": self.median.tolist(),
            "worst": self.worst.tolist(),
        }
        facts = {"method": self.kind, "judged_by": self.found_by, "expected_error": self.overall, "bands": bands}
        if self.choice is None:
            return facts
        errors = {name: found if np.isfinite(found) else None for name, found in self.choice.errors.items()}
        return facts | {
            "chosen_by": self.choice.judged_by, "compared": errors, "unsuited": dict(self.choice.unsuited),
        }  # fmt: skip


def judged_errors(
    scene: Scene, bank: GreenSource, kind: Interpolation, signals: Sequence[Float64Array]
) -> tuple[InterpolationErrors | None, list[str]]:
    """Estimate the error along a scene's paths, and warn of one worth saying.

    Returns None where every point lies on a position, or the bank has too few of them.
    """
    errors = errors_at(bank, kind, scene_points(scene), signals)
    return errors, [] if errors is None else _remarks(errors, kind)


def errors_at(
    bank: GreenSource, kind: Interpolation, points_mm: Float64Array, signals: Sequence[Float64Array]
) -> InterpolationErrors | None:
    """The errors at points (n, 2), for what is emitted; None as of `judged_errors`."""
    if isinstance(kind, GridInterpolation) and not _between(kind, points_mm):
        return None
    points_mm = points_mm[evenly_spread(len(points_mm), MAX_POINTS)]
    spectrum, band_hz = _EmittedSpectrum(signals, float(bank.sample_rate_hz)), _bank_band_hz(bank)
    frequency_hz = spectrum.bands_hz(band_hz, _BANDS)
    try:
        found = kind.estimate(bank, points_mm, frequency_hz)
    except DamagedError:
        raise
    except InputError:
        return None  # a point that is off the grid is named where it is rendered
    largest = float(np.abs(found.values).max(initial=0.0)) or 1.0  # squares of a bank in any unit are finite
    emitted = spectrum.shares(frequency_hz, band_hz) * np.square(np.abs(found.values / largest)).sum(axis=(1, 2))
    total = float(emitted.sum())
    if not (total > 0 and np.isfinite(total)):
        return None
    relative = found.relative
    return InterpolationErrors(
        kind.name, found.judged_by, frequency_hz, emitted / total, np.median(relative, axis=1),
        relative.max(axis=1), kind.choice,
    )  # fmt: skip


def _remarks(errors: InterpolationErrors, kind: Interpolation) -> list[str]:
    frequency_hz, error = errors.largest
    remedy = (
        "use 'auto', or measure a finer grid"
        if isinstance(kind, GridInterpolation) and errors.choice is None
        else "measure a finer grid, or lower the band"
    )
    said = []
    # Half a band below the lowest and above the highest that the scene uses.
    lowest_hz, highest_hz = errors.frequency_hz[[0, -1]]
    half = max((highest_hz / lowest_hz) ** (0.5 / max(len(errors.frequency_hz) - 1, 1)), 2.0 ** (1.0 / 6.0))
    if doubtful := [f"{hz:.3g}" for hz in kind.doubtful_hz if lowest_hz / half <= hz <= highest_hz * half]:
        at = ", ".join(doubtful)
        said.append(f"the bank says little of the waves at {at} Hz; their wave numbers follow from the others")
    # A render states an error from 5 % on.
    if error > 0.05:
        said.append(
            f"interpolation {errors.kind!r} between the grid positions is wrong by about {_percent(error)} at"
            f" {frequency_hz:.3g} Hz (median along the paths); {remedy}"
        )
    return said


def _between(kind: GridInterpolation, points_mm: Float64Array) -> bool:
    _, distance_mm = kind.grid.nearest(points_mm)
    return bool(kind.grid.spacing_mm > 0 and (distance_mm > 1e-3 * kind.grid.spacing_mm).any())


def _percent(share: float) -> str:
    return f"{100 * share:.2g} %" if share < 1 else f"{100 * share:.0f} %"


def _bank_band_hz(bank: GreenSource) -> tuple[float, float]:
    """Band in which the bank says something."""
    nyquist_hz = 0.5 * float(bank.sample_rate_hz)
    low_hz, high_hz = bank.band_hz if bank.band_hz is not None else (0.02 * nyquist_hz, nyquist_hz)
    high_hz = min(high_hz, 0.99 * nyquist_hz)
    return min(max(low_hz, float(bank.sample_rate_hz) / bank.taps), high_hz), high_hz


class _EmittedSpectrum:
    """Energy spectrum of what a scene's sources emit."""

    def __init__(self, signals: Sequence[Float64Array], rate_hz: float) -> None:
        self._power = np.zeros(SIGNAL_BLOCK // 2 + 1)
        self._bins_hz = np.fft.rfftfreq(SIGNAL_BLOCK, 1.0 / rate_hz)
        window = np.hanning(SIGNAL_BLOCK + 1)[:-1]
        for signal in signals:
            # Cut from a longer signal, blocks fade in and out: else their edges pass for high frequencies.
            short = len(signal) <= SIGNAL_BLOCK
            last = max(len(signal) - SIGNAL_BLOCK, 0)
            for begin in evenly_spread(last + 1, SIGNAL_BLOCKS).tolist():
                part = signal[begin : begin + SIGNAL_BLOCK]
                peak = float(max(part.max(), -part.min()))
                if peak > 0:
                    shaped = part / peak if short else window * (part / peak)
                    self._power += np.square(np.abs(np.fft.rfft(shaped, SIGNAL_BLOCK))) * min(peak, 1e100) ** 2

    def bands_hz(self, within_hz: tuple[float, float], count: int) -> Float64Array:
        """Centres of bands over what is emitted within a band; over all of that band where nothing is."""
        inside = self._inside(within_hz)
        low_hz, high_hz = within_hz
        upto = np.cumsum(self._power[inside])
        if len(upto) and upto[-1] > 0:
            first, last = np.searchsorted(upto, [EDGE_SHARE * upto[-1], (1.0 - EDGE_SHARE) * upto[-1]])
            bins_hz = self._bins_hz[inside]
            low_hz, high_hz = (float(bins_hz[min(int(edge), len(bins_hz) - 1)]) for edge in (first, last))
        low_hz = max(low_hz, within_hz[0], 1e-3 * high_hz)
        if high_hz <= low_hz * 2.0 ** (1.0 / 6.0):
            return np.array([high_hz])
        edges_hz = np.geomspace(low_hz, high_hz, count + 1)
        return np.asarray(np.sqrt(edges_hz[1:] * edges_hz[:-1]))

    def shares(self, frequency_hz: Float64Array, within_hz: tuple[float, float]) -> Float64Array:
        """Energy within a band, each bin given to the nearest frequency, (bands,)."""
        inside = self._inside(within_hz)
        edges_hz = np.sqrt(frequency_hz[1:] * frequency_hz[:-1])
        place = np.searchsorted(edges_hz, self._bins_hz[inside])
        return np.bincount(place, self._power[inside], minlength=len(frequency_hz)).astype(np.float64)

    def _inside(self, within_hz: tuple[float, float]) -> BoolArray:
        half_bin_hz = 0.5 * float(self._bins_hz[1])
        return (self._bins_hz >= within_hz[0] - half_bin_hz) & (self._bins_hz <= within_hz[1] + half_bin_hz)


_KERNEL_ERROR = 0.02
"""Left-out error in the scene's band below which waves, which take minutes, are not asked."""
ON_POSITION = 1e-6
"""Distance from a position, in grid spacings, up to which a place is on it."""


def scene_choice(scene: Scene, bank: GreenSource) -> Interpolation:
    """The cheapest method that serves a scene; as of `choose_interpolation`.

    Of a path that leaves the grid "nearest", by which the path point is named where it is sampled.
    """
    rate_hz, points_mm, grid = float(bank.sample_rate_hz), scene_points(scene, 4096), bank_grid(bank)
    try:
        near(grid, points_mm, REACH_SPACINGS)
        signals = [source.amplitude * source.signal.samples(rate_hz) for source in scene.sources]
        return choose_interpolation(bank, points_mm, signals)
    except OffGridError:
        return Nearest(grid)


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
    frequency_hz, emitted = _emitted_bands(bank, signals)
    found: dict[str, tuple[Interpolation, float, str]] = {}
    for name in ("kernel", "waves"):
        if (method := _usable(name, bank, points_mm, unsuited)) is not None:
            estimate = method.estimate(bank, points_mm, frequency_hz)
            error = float(np.sqrt(emitted @ np.square(np.median(estimate.relative, axis=1))))
            found[name] = method, error, estimate.judged_by
            if error < _KERNEL_ERROR:
                break
    method, error, judged_by = min(found.values(), key=lambda one: one[1], default=(nearest, np.inf, "nothing"))
    errors = {name: one[1] for name, one in found.items()}
    if method is None or not error < MOST:  # more of what is there is missed than found
        method, errors = nearest, {"nearest": float("nan")} | errors
    if method is None:
        raise next((one for one in unsuited.values() if isinstance(one, InputError)), InputError(f"{unsuited}"))
    method.choice = InterpolationChoice(judged_by, errors, _words(unsuited))
    return method


def _emitted_bands(bank: GreenSource, signals: Sequence[Float64Array]) -> tuple[Float64Array, Float64Array]:
    """Bands over what is emitted, and the share of each; without signals over the bank's band, all alike."""
    spectrum, band_hz = _EmittedSpectrum(signals, float(bank.sample_rate_hz)), _bank_band_hz(bank)
    frequency_hz = spectrum.bands_hz(band_hz, _BANDS)
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
    grid = bank_grid(bank)
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
    if not np.isfinite(points_mm).all():
        raise InputError("places_mm holds NaN or infinity; allowed are places in millimetres")
    near(bank_grid(bank), points_mm, REACH_SPACINGS)
    hz = (
        _emitted_bands(bank, ())[0] if frequency_hz is None else np.atleast_1d(real_array("frequency_hz", frequency_hz))
    )
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
