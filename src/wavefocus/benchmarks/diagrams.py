"""Work-precision diagrams: the error of each method over its run time."""

import re
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from wavefocus.benchmarks.harness import Entry, Findings, cell, heading
from wavefocus.rendering.report.canvas import COLOURS
from wavefocus.storage.output_files import replacement

COSTS = {"hours": "hours of measuring", "wall_s": "run time in s"}
"""What an error is drawn over: the first of these figures that all points of the work have."""
MARKERS = "osd^vPX*<>"


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
        points = [one for one in found if one.error]
        cost = next((cost for cost in COSTS if all(one.row.get(cost) for one in points)), None)
        # A diagram needs three points.
        if len(points) >= 3 and cost is not None:
            slug = re.sub(r"[^a-z0-9]+", "-", work.lower()).strip("-")[:40].rstrip("-")
            drawn[work] = f"{name}-{slug}.png"
            _draw(out / drawn[work], work, points, cost)
    return drawn


def _draw(path: Path, title: str, points: list[Entry], cost: str) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8.6, 5.4), layout="constrained")
    FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    place = [(float(one.row[cost] or 0), float(one.error or 0)) for one in points]
    for number, method in enumerate(dict.fromkeys(one.method for one in points)):
        mine = [at for at, one in zip(place, points, strict=True) if one.method == method]
        marker = MARKERS[number % len(MARKERS)]
        axes.plot(*zip(*mine, strict=True), marker, label=method, markersize=6, color=COLOURS[number % len(COLOURS)])
    front = pareto(place)
    axes.plot(*zip(*(place[index] for index in front), strict=True), color="#888888", linewidth=5, alpha=0.25,
              solid_capstyle="round", label="Pareto front", zorder=0)  # fmt: skip
    for index in front:
        words = ", ".join(f"{heading(name)} {cell(name, value)}" for name, value in points[index].parameters.items())
        axes.annotate(words, place[index], (7, 5), textcoords="offset points", fontsize=7, color="#444444")
    axes.set(xscale="log", yscale="log", xlabel=COSTS[cost], ylabel="relative error", title=title)
    axes.grid(visible=True, which="major", alpha=0.25)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    with replacement(path) as temporary:
        figure.savefig(temporary, dpi=120)
