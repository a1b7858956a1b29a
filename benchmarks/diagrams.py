"""Work-precision diagrams: error against run time, one for each work of a benchmark, its Pareto front marked."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import Any

from benchmarks.harness import Findings, Plain, Point, cell, heading
from storage.output_files import replacement

FEWEST = 3
"""Points that a diagram needs."""
FLOOR = 1e-16
COSTS = {"hours": "hours of measuring", "wall_s": "run time in s (median on the wall; bars: quartiles' distance)"}
"""What an error is drawn over: the first of these figures that all points of the work have."""
COLOURS = ("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9", "#000000")
"""For the colour-blind (Okabe and Ito 2008)."""
MARKERS = "osd^vPX*<>"


def cost_of(points: Sequence[Point]) -> str | None:
    """The figure that errors of a work are drawn over; None where there are too few points for a diagram."""
    drawn = [one for one in points if one.error]
    if len(drawn) < FEWEST:
        return None
    return next((name for name in COSTS if all(one.row.get(name) for one in drawn)), None)


def pareto(cost_and_error: Sequence[tuple[float, float]]) -> list[int]:
    """Places of the points that no other beats in cost and error, from the cheapest to the most exact."""
    front: list[int] = []
    for place in sorted(range(len(cost_and_error)), key=lambda one: cost_and_error[one]):
        if not front or cost_and_error[place][1] < cost_and_error[front[-1]][1]:
            front.append(place)
    return front


def draw_diagrams(findings: Findings, out: Path, name: str) -> dict[str, str]:
    """Draw all diagrams of a benchmark into a folder. Returns work and file name of each."""
    drawn = {}
    for work, found in groupby(findings.points, lambda point: point.work):
        points = list(found)
        if cost := cost_of(points):
            slug = re.sub(r"[^a-z0-9]+", "-", work.lower()).strip("-")[:40].rstrip("-")
            drawn[work] = f"{name}-{slug}.png"
            _draw(out / drawn[work], work, [one for one in points if one.error], cost)
    return drawn


def _draw(path: Path, title: str, points: list[Point], cost: str) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure
    from matplotlib.ticker import NullFormatter

    figure = Figure(figsize=(8.6, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    place = [(float(one.row[cost] or 0), max(float(one.error or 0), FLOOR)) for one in points]
    for number, method in enumerate(dict.fromkeys(one.method for one in points)):
        mine = [index for index, one in enumerate(points) if one.method == method]
        x, y = zip(*(place[index] for index in mine), strict=True)
        style: dict[str, Any] = {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)]}
        axes.plot(x, y, label=method, linewidth=1.2, markersize=6, **style)
        spreads = [
            one.timing.spread_s or 0.0 if one.timing and cost == "wall_s" else 0.0
            for one in map(points.__getitem__, mine)
        ]
        if any(spreads):
            axes.errorbar(x, y, xerr=[0.5 * one for one in spreads], fmt="none", ecolor=style["color"], alpha=0.5)
    front = pareto(place)
    axes.plot(*zip(*(place[index] for index in front), strict=True), color="#888888", linewidth=5, alpha=0.25,
              solid_capstyle="round", label="Pareto front", zorder=0)  # fmt: skip
    for index in front:
        words = ", ".join(_setting(key, value) for key, value in points[index].parameters.items())
        axes.annotate(words, place[index], (6, 6), textcoords="offset points", fontsize=7, color="#444444")
    axes.set(xscale="log", yscale="log", xlabel=COSTS[cost], ylabel="relative error", title=title)
    for axis, span in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}" if span[1] < 30 * span[0] else NullFormatter())
        axis.set_tick_params(which="minor", labelsize=7)
    axes.grid(visible=True, which="major", alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.12)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    with replacement(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _setting(name: str, value: Plain) -> str:
    """A parameter with its unit after the value."""
    *words, unit = heading(name).split(" ")
    number = cell(name, value)
    return f"{' '.join(words)} {number} {unit}" if unit in ("mm", "s", "dB", "Hz") else f"{heading(name)} {number}"
