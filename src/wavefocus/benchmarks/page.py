"""One HTML page of all benchmarks with work-precision diagrams."""

from __future__ import annotations

import base64
import re
from collections.abc import Iterable, Mapping, Sequence
from html import escape
from itertools import groupby
from pathlib import Path
from typing import Any

from wavefocus.benchmarks.harness import Entry, Findings, Plain, cell, heading
from wavefocus.rendering.report.canvas import COLOURS
from wavefocus.storage.output_files import replacement

FEWEST = 3
"""Points that a diagram needs."""
FLOOR = 1e-16
COSTS = {"hours": "hours of measuring", "wall_s": "run time in s (median on the wall; bars: quartiles' distance)"}
"""What an error is drawn over: the first of these figures that all points of the work have."""
MARKERS = "osd^vPX*<>"


def cost_of(points: Sequence[Entry]) -> str | None:
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


def _draw(path: Path, title: str, points: list[Entry], cost: str) -> None:
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
        settings = {name: {points[index].parameters.get(name) for index in mine} for name in points[mine[0]].parameters}
        # A line joins settings of one parameter; those of several are no sequence.
        width = 1.2 if sum(len(one) > 1 for one in settings.values()) < 2 else 0.0
        axes.plot(x, y, label=method, linewidth=width, markersize=6, **style)
        spreads = [
            one.timing.spread_s or 0.0 if one.timing and cost == "wall_s" else 0.0
            for one in map(points.__getitem__, mine)
        ]
        if any(spreads):
            axes.errorbar(x, y, xerr=[0.5 * one for one in spreads], fmt="none", ecolor=style["color"], alpha=0.5)
    front = pareto(place)
    axes.plot(*zip(*(place[index] for index in front), strict=True), color="#888888", linewidth=5, alpha=0.25,
              solid_capstyle="round", label="Pareto front", zorder=0)  # fmt: skip
    axes.set(xscale="log", yscale="log", xlabel=COSTS[cost], ylabel="relative error", title=title)
    for axis, span in ((axes.xaxis, axes.get_xlim()), (axes.yaxis, axes.get_ylim())):
        axis.set_major_formatter("{x:g}")
        axis.set_minor_formatter("{x:g}" if span[1] < 60 * span[0] else NullFormatter())
        axis.set_tick_params(which="minor", labelsize=7)
    axes.grid(visible=True, which="major", alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.margins(x=0.12)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8, frameon=False)
    figure.draw_without_rendering()
    taken: list[Any] = []
    for index in [*front, *(one for one in range(len(points)) if one not in front)]:
        words = ", ".join(_setting(key, value) for key, value in points[index].parameters.items())
        _label(axes, place[index], words, taken)
    with replacement(path) as temporary:
        figure.savefig(temporary, dpi=120)


def _label(axes: Any, place: tuple[float, float], words: str, taken: list[Any]) -> None:
    """Write words right or left of a place, where they hide no words before them; else nowhere."""
    for right in (True, False):
        label = axes.annotate(
            words, place, (7 if right else -7, 5), textcoords="offset points", fontsize=7, color="#444444",
            ha="left" if right else "right", annotation_clip=False,
        )  # fmt: skip
        label.set_in_layout(False)
        box = label.get_window_extent()
        if axes.bbox.contains(box.x0, box.y0) and axes.bbox.contains(box.x1, box.y1) and not box.count_overlaps(taken):
            taken.append(box)
            return
        label.remove()


def _setting(name: str, value: Plain) -> str:
    """A parameter with its unit after the value."""
    *words, unit = heading(name).split(" ")
    number = cell(name, value)
    return f"{' '.join(words)} {number} {unit}" if unit in ("mm", "s", "dB", "Hz") else f"{heading(name)} {number}"


STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:76rem;margin:2rem auto;padding:0 1rem;color:#1a1a1a}
table{border-collapse:collapse;font-size:13px;margin:.6rem 0 1.6rem;display:block;overflow-x:auto}
th,td{border-bottom:1px solid #ddd;padding:.25rem .6rem;text-align:left;white-space:nowrap}
td:last-child{white-space:normal;min-width:14rem}img{max-width:100%}h3{margin-bottom:.2rem}code{background:#f2f2f2}"""


def html_page(measured: Mapping[str, Mapping[str, Any]], titles: Mapping[str, str], folder: Path) -> str:
    """The page of some benchmarks, by name; their pictures lie in the folder."""
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>wavefocus: error against run time</title>",
        f"<style>{STYLE}</style><h1>Error against run time</h1>",
        "<p>Times are medians of repeats, on the wall and of the processor; the spread is the difference of the"
        " quartiles. Grey in a diagram is the Pareto front: no other setting beats those on it in error and in time."
        "</p><ul>",
        *(f"<li><a href='#{name}'>{escape(titles[name])}</a>" for name in measured),
        "</ul>",
    ]
    for name, found in measured.items():
        made = found["made"]
        words = [made["command"], made["date"], f"commit {made['commit']}", made["processor"], f"{made['cores']} cores"]
        words += [f"Python {made['python']}", *(f"{package} {one}" for package, one in made["packages"].items())]
        quick = " A quick run: its figures say only that it works." if found["quick"] else ""
        parts.append(f"<h2 id='{name}'>{escape(titles[name].capitalize())}</h2>")
        parts.append(
            f"<p>{escape(', '.join(map(str, words)))}. Load {made['load_before']}, {made['load_after']}.{quick}</p>"
        )
        parts += _blocks(found["lines"], found["diagrams"], folder)
    return "\n".join(parts) + "\n"


def _blocks(lines: Iterable[str], diagrams: Mapping[str, str], folder: Path) -> list[str]:
    """Paragraphs, headings with their diagrams, and tables, of lines in Markdown."""
    parts, inside = [], False
    for line in lines:
        row = line.startswith("|")
        if row and line.startswith("|-"):
            continue
        if row:
            tag = "td" if inside else "th"
            cells = [escape(one.strip().replace("\\|", "|")) for one in line.strip("|").split(" | ")]
            parts.append(("" if inside else "<table>") + "<tr>" + "".join(f"<{tag}>{one}" for one in cells))
        elif inside:
            parts.append("</table>")
        inside = row
        if line.startswith("**"):
            work = line.strip("*")
            parts.append(f"<h3>{escape(work)}</h3>")
            if work in diagrams:
                picture = base64.b64encode((folder / diagrams[work]).read_bytes()).decode()
                parts.append(
                    f"<img alt='error against run time: {escape(work)}' src='data:image/png;base64,{picture}'>"
                )
        elif line and not row:
            parts.append(f"<p>{escape(line)}</p>")
    return [*parts, "</table>"] if inside else parts
