"""Data of the paper's figures, computed from a bank."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.scene import Output, Regularisation
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field import metrics
from wavefocus.rendering.field.foci import FOCUS_RADIUS_MM
from wavefocus.rendering.field.prediction import Prediction, predict
from wavefocus.rendering.field.wave_figures import PathSpectrum, path_spectrum
from wavefocus.rendering.greens.regularisation import row_weights, saturation_threshold
from wavefocus.rendering.greens.source import GreenArray, usable
from wavefocus.rendering.report.canvas import ReportSurface
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Line, Path, Point, Strokes
from wavefocus.rendering.scene.signals import Impulse, Noise
from wavefocus.storage.drive_file import Drive

Float32Array = NDArray[np.float32]
Float64Array = NDArray[np.float64]
Int64Array = NDArray[np.int64]
FloatArray = NDArray[np.float32] | NDArray[np.float64]

SATURATION = 0.3
"""C of eq. (14) over the bank's median rms; the paper does not say its own."""
CLEAR_MM = 20.0
LINE = Line((-58.0, 0.0), (62.0, 0.0))
"""Six points 24 mm apart, each on a position."""


@dataclass(slots=True)
class Paper:
    """Bank and rig of the figures, and our numbers: text, and whether it is as the paper's (None: it states none)."""

    bank: GreenArray
    rig: VirtualRig
    quick: bool
    found: dict[str, tuple[str, bool | None]] = field(default_factory=dict)

    def surface(self, *paths_mm: Float64Array) -> ReportSurface:
        """Content of every map."""
        return ReportSurface.of(self.bank, paths_mm, self.rig.settings.outline.line(400))


def row_at(bank: GreenArray, x_mm: float, y_mm: float) -> int:
    """The measured row nearest to a point."""
    allowed = np.flatnonzero(usable(bank))
    return int(allowed[np.argmin(np.hypot(*(bank.position_mm[allowed] - (x_mm, y_mm)).T))])


def clear_rows(bank: GreenArray, clear_mm: float) -> Int64Array:
    """Measured rows further than some distance from every actuator."""
    gap_mm = np.hypot(*(bank.position_mm[:, None] - bank.actuator_mm).transpose(2, 0, 1)).min(axis=1)
    return np.flatnonzero(usable(bank) & (gap_mm > clear_mm))


def focus_fields(bank: GreenArray, rows: Sequence[int], saturation: float | None) -> Float64Array:
    """Fields at the focus instant of impulses focused at some rows, normalised, (rows, positions).

    At that instant ``y(x) = n sum_i sigma_i sum_k g_i(x)[k] g_i(x0)[k]``: an inner product of bank rows.
    """
    threshold = saturation_threshold(Regularisation(saturation=saturation or 0.0), bank)
    flat = bank.values.reshape(bank.positions, -1)
    fields = np.empty((len(rows), bank.positions))
    for place, row in enumerate(rows):
        green = bank.values[row].astype(np.float64)
        sigma, gain = row_weights(green, threshold, normalise=True)
        factors = np.full(bank.actuators, gain) if sigma is None else gain * sigma
        driven = (factors[:, None] * green).astype(np.float32)
        fields[place] = flat @ driven.ravel()
    return fields


def focus_figures(bank: GreenArray, rows: Sequence[int], fields: FloatArray) -> dict[str, Float64Array]:
    """Width, distance of the peak from its place, and artefact level of each focus, (foci,) each.

    Artefacts are further than 15 mm from the focus. NaN where a spot reaches beyond the positions.
    """
    spacing_mm = metrics.grid_spacing_mm(bank.position_mm)
    figures = np.full((3, len(rows)), np.nan)
    for place, (row, values) in enumerate(zip(rows, fields, strict=True)):
        at_mm = bank.position_mm[row]
        spot = metrics.focus_spot(bank.position_mm, values, at_mm, FOCUS_RADIUS_MM, spacing_mm)
        if spot is not None:
            figures[:, place] = spot.width_mm, spot.off_mm, spot.artefact_db
    return dict(zip(("width_mm", "off_mm", "artefact_db"), figures, strict=True))


def fields_at(drive: Drive, bank: GreenArray, samples: Sequence[int]) -> Float32Array:
    """Predicted field at some samples of scene time, (samples, positions), without keeping the rest."""
    first = round(drive.start_s * drive.sample_rate_hz)
    columns = np.asarray(samples, dtype=np.int64) - first
    found = np.empty((len(columns), bank.positions), dtype=np.float32)
    for begin, responses in Prediction(drive, bank, range(bank.positions)).rows():
        found[:, begin : begin + len(responses)] = responses[:, columns].T
    return found


def impulse_drive(bank: GreenArray, row: int, saturation: float | None = None) -> Drive:
    """Drive that focuses an impulse at a row."""
    x, y = (float(value) for value in bank.position_mm[row])
    return moving_drive(bank, None, Impulse(), 0.0, 0.0, saturation, at_mm=(x, y))


def moving_drive(
    bank: GreenArray,
    path: Path | None,
    signal: Impulse | Noise,
    speed_mm_s: float,
    step_mm: float,
    saturation: float | None = SATURATION,
    at_mm: tuple[float, float] = (0.0, 0.0),
) -> Drive:
    """Drive of a source that emits the signal anew at every path point, between the positions by the kernel."""
    source = Source(path or Point(at_mm), signal, 0.0, speed_mm_s, step_mm, emission="per_point")
    kind = "nearest" if path is None or path is LINE else "kernel"
    scene = Scene("paper", (source,), Regularisation(saturation=saturation or 0.0), Output(interpolation=kind))
    return render_with_report(scene, bank)[0]


def smiling_face(radius_mm: float) -> Strokes:
    """An emoji: a circle, two eyes and a mouth."""

    def arc(x: float, y: float, radius: float, start_deg: float, stop_deg: float) -> Float64Array:
        angle = np.radians(np.linspace(start_deg, stop_deg, 97))
        return radius_mm * (np.array((x, y)) + radius * np.stack([np.cos(angle), np.sin(angle)], axis=1))

    eyes = [arc(side * 0.38, 0.32, 0.13, 90.0, 450.0) for side in (-1.0, 1.0)]
    return Strokes([arc(0.0, 0.0, 1.0, 90.0, 450.0), *eyes, arc(0.0, 0.0, 0.6, 205.0, 335.0)])


@dataclass(frozen=True, slots=True)
class _LineScene:
    """Figure 4C: bursts along a line."""

    drive: Drive
    rows: Int64Array
    fields: Float32Array
    responses: Float64Array


def line_scene(bank: GreenArray, speed_mm_s: float, burst_s: float) -> _LineScene:
    """Six points 24 mm apart, a white burst at each."""
    drive = _bursts(bank, speed_mm_s, burst_s, 3)
    impulses = moving_drive(bank, LINE, Impulse(), speed_mm_s, 24.0)
    fields = fields_at(impulses, bank, impulses.focus_sample.tolist())
    return _LineScene(drive, drive.focus_position, fields, _at_points(drive, bank))


def line_spectrum(bank: GreenArray, speed_mm_s: float, burst_s: float, seeds: int) -> PathSpectrum:
    """Spectra at the points of `line_scene`, for several bursts: from 20 ms before each to 70 ms after."""
    found = []
    for seed in range(seeds):
        drive = _bursts(bank, speed_mm_s, burst_s, seed)
        first = drive.focus_sample - round((drive.start_s + 0.02) * drive.sample_rate_hz)
        samples = round((0.09 + burst_s) * drive.sample_rate_hz)
        found.append(path_spectrum(_at_points(drive, bank), drive.sample_rate_hz, first, samples))
    return PathSpectrum(found[0].frequency_hz, np.concatenate([one.magnitude for one in found]))


def _bursts(bank: GreenArray, speed_mm_s: float, burst_s: float, seed: int) -> Drive:
    return moving_drive(bank, LINE, Noise((20.0, 500.0), burst_s, seed), speed_mm_s, 24.0)


def _at_points(drive: Drive, bank: GreenArray) -> Float64Array:
    return np.asarray(predict(drive, bank, drive.focus_position.tolist()).field, dtype=np.float64)
