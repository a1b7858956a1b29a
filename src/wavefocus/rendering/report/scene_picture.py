"""A scene on the surface: its paths as they are asked for, and as they are snapped to the bank's positions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.greens.regularisation import focus_gains, saturation_threshold
from wavefocus.rendering.greens.source import GreenSource, usable
from wavefocus.rendering.report.canvas import (
    COLOURS,
    FAINT,
    INK,
    Canvas,
    Picture,
    ReportSurface,
    draw_cells,
    draw_surface,
    drawn_in_style,
)
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.sampling import SampledSource, sample_scene
from wavefocus.rendering.verify.record import path_line_mm
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.collections import PolyCollection


# Without black, the colour of outlines; more sources than colours begin anew.
SOURCE_COLOURS = COLOURS[:-1]
MAX_NAMED = 12
MAP_PX = 500
TOP_PX = 26
UNMEASURED = "#d9d9d9"


@dataclass(frozen=True, slots=True)
class _Drawn:
    """One source as it is drawn."""

    source: Source
    line_mm: Float64Array
    points_mm: Float64Array
    focus_s: Float64Array
    rows: Int64Array
    snap_mm: Float64Array


@drawn_in_style
def scene_picture(
    scene: Scene, bank: GreenSource, *, outline_mm: Float64Array | None = None, sampled: Sequence[SampledSource] = ()
) -> Picture:
    """Draw a scene before and after snapping.

    Left: the paths with their sample points, starts and directions, above the bank's positions. Right: the positions
    that the points are snapped to, coloured by n(x) of eq. (15) where the scene normalises, else by the instant of the
    first focus there; a line shows the order in which they are visited.

    sampled: The sources as a render sampled them, which can take long; by default they are sampled anew.

    Raises InputError: a path leaves the bank's positions, or a source is not as stated.
    """
    sources = _sources(scene, bank, sampled or sample_scene(scene, bank, "sampled").sources)
    surface = ReportSurface.of(bank, [drawn.line_mm for drawn in sources], outline_mm)
    height = surface.height_px(MAP_PX)
    lines = -(-min(len(sources), MAX_NAMED) // 2)
    canvas = Canvas("scene", 2 * MAP_PX + 152, TOP_PX + height + 66 + 16 * lines)
    left = canvas.axes(52, TOP_PX, MAP_PX, height)
    right = canvas.axes(52 + MAP_PX + 20, TOP_PX, MAP_PX, height)
    for axes in (left, right):
        draw_surface(axes, surface, path=False)
        axes.set_xlabel("x (mm)")
    left.set(title=f"{scene.name}: as asked for", ylabel="y (mm)")
    right.tick_params(labelleft=False)
    _draw_asked(left, surface, sources, bank)
    for axes in (left, right):
        _draw_quiet(axes, scene)
    points, largest_mm = sum(len(drawn.rows) for drawn in sources), max(float(drawn.snap_mm.max()) for drawn in sources)
    rows = np.unique(np.concatenate([drawn.rows for drawn in sources]))
    places = f"{points} points on {len(rows)} positions" if points > 1 else "its position"
    moved = "snapped by" if scene.output.interpolation == "nearest" else f"{scene.output.interpolation}; nearest within"
    right.set_title(f"{places}, {moved} up to {largest_mm:.2g} mm".replace("within up to", "within"))
    cells, label = _draw_snapped(right, surface, sources, rows, scene, bank)
    known = cells.get_array()
    # One value alone needs no scale.
    ticks = [float(known[0])] if known is not None and np.ptp(known) < 1e-9 else None
    place_px = (52 + 2 * MAP_PX + 30, TOP_PX + 0.08 * height, 10, 0.84 * height)
    canvas.colour_bar(cells, place_px, label, ticks=ticks)
    canvas.legend(_keys(sources), 52 + MAP_PX + 10, TOP_PX + height + 42, 2)
    return canvas.picture()


def _sources(scene: Scene, bank: GreenSource, sampled: Sequence[SampledSource]) -> list[_Drawn]:
    """Each source as it is drawn; its positions are those that count for its foci."""
    drawn = []
    for source, points in zip(scene.sources, sampled, strict=True):
        count = min(4000, max(2, int(4 * source.path.length_mm) + 2))
        focus_s = points.focus_sample / float(bank.sample_rate_hz)
        line_mm, rows = path_line_mm(source, count), points.focus_position
        drawn.append(_Drawn(source, line_mm, points.points_mm, focus_s, rows, points.snap_mm))
    return drawn


def _draw_asked(axes: Axes, surface: ReportSurface, sources: list[_Drawn], bank: GreenSource) -> None:
    allowed = usable(bank)
    position_mm = surface.position_mm
    axes.plot(*position_mm[allowed].T, ".", ms=1.6, color="#b6bec6", zorder=1)
    axes.plot(*position_mm[~allowed].T, "x", ms=2.0, color=UNMEASURED, mew=0.5, zorder=1)
    for index, drawn in enumerate(sources):
        colour = SOURCE_COLOURS[index % len(SOURCE_COLOURS)]
        axes.plot(*_broken(drawn.line_mm, surface.spacing_mm).T, color=colour, lw=1.1, zorder=5)
        axes.plot(*drawn.points_mm.T, ".", color=colour, ms=3.5, zorder=6)
        axes.plot(*drawn.points_mm[0], "o", ms=7, mfc="none", mec=colour, mew=1.4, zorder=7)
        _draw_direction(axes, drawn.line_mm, colour)


def _draw_quiet(axes: Axes, scene: Scene) -> None:
    """A dashed rim about each quiet place, at the start of its path."""
    angle = np.linspace(0.0, 2.0 * np.pi, 49)
    for place in scene.quiet:
        rim_mm = max(place.radius_mm, 1.5) * np.stack([np.cos(angle), np.sin(angle)], axis=1)
        axes.plot(*(place.path.point_at(np.zeros(1)) + rim_mm).T, "--", color="black", lw=0.8, zorder=7)


def _draw_direction(axes: Axes, line_mm: Float64Array, colour: str) -> None:
    """An arrow head a quarter along the path."""
    steps = np.hypot(*np.diff(line_mm, axis=0).T)
    if not steps.any():
        return
    at = int(np.searchsorted(np.cumsum(steps), 0.25 * steps.sum()))
    tail, head = line_mm[max(0, at - 1)], line_mm[min(len(line_mm) - 1, at + 1)]
    axes.annotate(
        "", xy=(head[0], head[1]), xytext=(tail[0], tail[1]), zorder=8,
        arrowprops={"arrowstyle": "-|>", "color": colour, "lw": 1.1, "mutation_scale": 15, "shrinkA": 0, "shrinkB": 0},
    )  # fmt: skip


def _draw_snapped(
    axes: Axes, surface: ReportSurface, sources: list[_Drawn], rows: Int64Array, scene: Scene, bank: GreenSource
) -> tuple[PolyCollection, str]:
    draw_cells(axes, surface, np.arange(len(surface.position_mm)), colour="#eef1f4")
    gain = _gains(scene, bank, rows) if scene.regularisation.normalise else None
    if gain is not None:
        median = float(np.median(gain))
        values, label = 20.0 * np.log10(gain / median), f"n(x) in dB over its median, {median:.3g}"
    else:
        values, label = _first_instants(sources, rows), "first focus there (s)"
    low, high = float(values.min()), float(values.max())
    if high - low < 1e-9:
        low, high = low - 0.5, high + 0.5
    cells = draw_cells(axes, surface, rows, values, colours="viridis", limits=(low, high))
    for index, drawn in enumerate(sources):
        colour = SOURCE_COLOURS[index % len(SOURCE_COLOURS)]
        visited = surface.position_mm[drawn.rows]
        furthest_mm = 1.5 * (drawn.source.step_mm or np.inf) + surface.spacing_mm
        axes.plot(*_broken(visited, furthest_mm).T, color=colour, lw=0.8, zorder=5)
        moved = np.stack([drawn.points_mm, visited, np.full_like(visited, np.nan)], axis=1).reshape(-1, 2)
        axes.plot(*moved.T, color=INK, lw=0.5, zorder=5)
        axes.plot(*drawn.points_mm.T, ".", color=INK, ms=1.8, zorder=6)
        axes.plot(*visited[0], "o", ms=7, mfc="none", mec=colour, mew=1.4, zorder=7)
    return cells, label


def _gains(scene: Scene, bank: GreenSource, rows: Int64Array) -> Float64Array | None:
    """n(x) at some rows; None where one of them has none, which the renderer reports."""
    try:
        threshold = saturation_threshold(scene.regularisation, bank)
    except InputError:
        return None
    gain = focus_gains(bank, rows.tolist(), threshold)
    return gain if np.isfinite(gain).all() and (gain > 0).all() else None


def _first_instants(sources: list[_Drawn], rows: Int64Array) -> Float64Array:
    first = dict.fromkeys(rows.tolist(), np.inf)
    for drawn in sources:
        for row, focus_s in zip(drawn.rows.tolist(), drawn.focus_s.tolist(), strict=True):
            first[row] = min(first[row], focus_s)
    return np.array([first[row] for row in rows.tolist()])


def _broken(line_mm: Float64Array, furthest_mm: float) -> Float64Array:
    """A line that is not drawn where it jumps, as between two letters."""
    jumps = np.flatnonzero(np.hypot(*np.diff(line_mm, axis=0).T) > furthest_mm) + 1
    return np.insert(line_mm, jumps, np.nan, axis=0)


def _keys(sources: list[_Drawn]) -> list[object]:
    from matplotlib.lines import Line2D

    keys: list[object] = []
    for index, drawn in enumerate(sources[:MAX_NAMED]):
        source = drawn.source
        if len(drawn.rows) > 1:
            pace = f"at {source.speed_mm_s:g} mm/s" if source.speed_mm_s else f"in {source.travel_s:.3g} s"
            way = f"{source.path.length_mm:.0f} mm {pace}"
            text = f"source {index}: {way}, from {source.start_s:g} s"
        else:
            x_mm, y_mm = drawn.points_mm[0]
            text = f"source {index}: at ({x_mm:.3g}, {y_mm:.3g}) mm, from {source.start_s:g} s"
        if index == MAX_NAMED - 1 and len(sources) > MAX_NAMED:
            text, colour = f"and {len(sources) - MAX_NAMED + 1} more", FAINT
        else:
            colour = SOURCE_COLOURS[index % len(SOURCE_COLOURS)]
        keys.append(Line2D([], [], color=colour, marker="o", mfc="none", label=text))
    return keys
