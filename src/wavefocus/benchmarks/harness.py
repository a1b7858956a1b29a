"""Harness of all benchmarks: points measured in turns, their marks, JSON and tables, and the machine of a run."""

from __future__ import annotations

import json
import os
import platform
import re
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from importlib import import_module
from importlib.metadata import PackageNotFoundError, version
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.report.canvas import COLOURS
from wavefocus.storage.output_files import replacement, write_whole

Plain = float | str | bool | None
UNITS = {"cpu": "CPU", "db": "dB", "mb": "MB", "gb": "GB", "hz": "Hz", "khz": "kHz"}


@dataclass(frozen=True, slots=True)
class Times:
    """Some runs of one action.

    Parameters
    ----------
    wall_s, cpu_s : float
        Medians over the runs of the time on the wall and of the CPU time of all threads together.
    spread_s : float, optional
        Difference of the quartiles of the time on the wall; None for a single run.
    peak_mb : float, optional
        Peak of the memory that one more run allocated through Python; None where it was not asked for.
    result : object
        Returned by the last run.
    """

    wall_s: float
    cpu_s: float
    spread_s: float | None = None
    peak_mb: float | None = None
    result: Any = None

    def times(self, factor: float) -> Times:
        """The time of so much more of the same work."""
        spread_s = None if self.spread_s is None else self.spread_s * factor
        return replace(self, wall_s=self.wall_s * factor, cpu_s=self.cpu_s * factor, spread_s=spread_s)


@dataclass(frozen=True, slots=True)
class Mark:
    """Target of a figure of a point: at least `limit`, or at most."""

    figure: str
    limit: float
    at_most: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class Entry:
    """One line of a benchmark: one method at one setting.

    Parameters
    ----------
    work : str
        The task; points of one work are compared with each other and make one table.
    method : str
        Name of the method.
    parameters : mapping
        Its settings, by name with the unit at the end.
    error : float, optional
        Against the truth that the benchmark states; None for the truth itself, and where there is none.
    timing : Timing, optional
        Its time.
    figures : mapping
        All else, by name with the unit at the end.
    marks : tuple of Mark
        Targets of figures.
    remark : str
        Note for the reader.
    """

    work: str
    method: str
    parameters: Mapping[str, Plain] = field(default_factory=dict)
    error: float | None = None
    timing: Times | None = None
    figures: Mapping[str, Plain] = field(default_factory=dict)
    marks: tuple[Mark, ...] = ()
    remark: str = ""

    @property
    def row(self) -> dict[str, Plain]:
        """Its values, by column."""
        timing = {} if self.timing is None else asdict(replace(self.timing, result=None))
        timing.pop("result", None)
        known = {**self.parameters, "error": self.error, **timing, **self.figures}
        return {"method": self.method, **{name: one for name, one in known.items() if one is not None}}

    def judged(self, mark: Mark) -> bool | None:
        """The figure keeps to the mark; None where it was not measured."""
        value = self.row.get(mark.figure)
        if not isinstance(value, float | int):
            return None
        return bool(value <= mark.limit if mark.at_most else value >= mark.limit)

    @property
    def met(self) -> bool:
        """Every mark is kept."""
        return all(self.judged(mark) for mark in self.marks)

    def against(self, peer: Times) -> Entry:
        """The same with its speed over a peer's, by time on the wall (`times`) and by CPU time (`cpu_times`).

        A peer that other programs kept from the cores was not slow: it counts no more than its CPU time.
        """
        assert self.timing is not None
        times = min(peer.wall_s, peer.cpu_s) / self.timing.wall_s
        cpu_times = peer.cpu_s / max(self.timing.cpu_s, 1e-9)
        return replace(self, figures={"times": times, "cpu_times": cpu_times, **self.figures})


@dataclass(frozen=True, slots=True)
class Findings:
    """Points of one benchmark, what their errors are relative to, and notes."""

    points: Sequence[Entry]
    truth: str = ""
    notes: Sequence[str] = ()

    def lines(self, *, judged: bool = True) -> list[str]:
        """Notes and tables in Markdown; marks where `judged`."""
        lines = [*([f"Errors are relative to {self.truth}."] if self.truth else []), *self.notes]
        for work, points in groupby(self.points, lambda point: point.work):
            lines += ["", f"**{work}**", "", *table(list(points), judged=judged)]
        return lines

    def write(self, out: Path, name: str, made: Mapping[str, Any]) -> Path:
        """Write ``NAME.json`` into a folder; `made` holds the conditions. Returns its path."""
        points = [{"work": one.work, **one.row, "remark": one.remark} for one in self.points]
        marks = [
            {"work": one.work, "method": one.method, **asdict(mark), "met": one.judged(mark)}
            for one in self.points
            for mark in one.marks
        ]
        content = {"truth": self.truth, "notes": list(self.notes), "points": points, "marks": marks, **made}
        write_whole(out / f"{name}.json", json.dumps(content | {"lines": self.lines()}, indent=2) + "\n")
        return out / f"{name}.json"


def measure(
    actions: Mapping[str, Callable[[], Any]],
    repeats: int,
    *,
    once: Sequence[str] = (),
    slow_s: float = 2.0,
    warm: bool = False,
    memory: bool = False,
) -> dict[str, Times]:
    """Run actions in turns, so that other load of the machine meets all of them.

    Those named in `once` run once, those slower than `slow_s` in every third turn. `warm` runs each once untimed before
    each timed run, so that none pays for the caches as the one before left them. `memory` runs each once more, untimed,
    for its peak memory.
    """
    walls: dict[str, list[float]] = {name: [] for name in actions}
    cpus: dict[str, list[float]] = {name: [] for name in actions}
    results: dict[str, Any] = {}
    for turn in range(repeats):
        for name, action in actions.items():
            if walls[name] and (name in once or (min(walls[name]) > slow_s and turn % 3)):
                continue
            if warm:
                action()
            wall, cpu = time.perf_counter(), time.process_time()
            results[name] = action()
            cpus[name].append(time.process_time() - cpu)
            walls[name].append(time.perf_counter() - wall)
    return {
        name: Times(
            float(np.median(walls[name])),
            float(np.median(cpus[name])),
            float(np.subtract(*np.percentile(walls[name], [75, 25]))) if len(walls[name]) > 1 else None,
            peak_mb(actions[name]) if memory and name not in once else None,
            results[name],
        )
        for name in actions
    }


def peak_mb(action: Callable[[], object]) -> float:
    """Peak of the memory that an action allocates."""
    tracemalloc.start()
    try:
        action()
        return tracemalloc.get_traced_memory()[1] / 1e6
    finally:
        tracemalloc.stop()


def relative_error(found: NDArray[Any], expected: NDArray[Any]) -> float:
    """Relative L2 error."""
    return float(np.linalg.norm(found - expected) / np.linalg.norm(expected))


def band_error_db(
    green: NDArray[Any], truth: NDArray[Any], rate_hz: float, band_hz: tuple[float, float], length: int
) -> NDArray[np.float64]:
    """Relative L2 error in dB, shape (records,), of the in-band spectra of FIRs (records, taps)."""
    hertz = np.fft.rfftfreq(length, 1 / rate_hz)
    band = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
    both = (green.astype(np.float64) - truth, truth)
    wrong, right = (np.square(np.abs(np.fft.rfft(one, length)[:, band])).sum(axis=1) for one in both)
    return np.asarray(10 * np.log10(wrong / right))


def table(points: Sequence[Entry], *, judged: bool = True) -> list[str]:
    """Lines of a table in Markdown, its columns aligned for a console."""
    parameters = [name for point in points for name in point.parameters]
    columns = list(dict.fromkeys(["method", *parameters, *(name for point in points for name in point.row)]))
    rows = [[heading(name) for name in columns]]
    rows += [[cell(name, point.row.get(name)) for name in columns] for point in points]
    for title, cells in (
        ("mark", ["; ".join(_words(point, mark) for mark in point.marks) if judged else "" for point in points]),
        ("remark", [point.remark for point in points]),
    ):
        if any(cells):
            rows = [[*row, one] for row, one in zip(rows, [title, *cells], strict=True)]
    return markdown(rows)


def markdown(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table in Markdown; the first row is the heading."""
    clean = [[one.replace("|", "\\|") for one in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*clean, strict=True)]
    lines = ["| " + " | ".join(map(str.ljust, row, widths)) + " |" for row in clean]
    return [lines[0], "|" + "|".join("-" * (width + 2) for width in widths) + "|", *lines[1:]]


def cell(name: str, value: Plain) -> str:
    """A value as tables show it."""
    if value is None or isinstance(value, str):
        return value or ""
    if isinstance(value, bool):
        return "yes" if value else "no"
    if name.endswith("error"):
        return f"{value:.1e}"
    return f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def heading(name: str) -> str:
    """A column's name as tables show it."""
    return " ".join(UNITS.get(word, word) for word in name.split("_"))


def _words(point: Entry, mark: Mark) -> str:
    met = {True: "met", False: "**not met**", None: "not measured"}[point.judged(mark)]
    return f"{heading(mark.figure)} at {'most' if mark.at_most else 'least'} {mark.limit:g}: {met}"


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


PACKAGES = ("numpy", "scipy", "h5py", "pyfar", "dask")
THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS")


def conditions(command: str) -> dict[str, object]:
    """Machine, versions and load as they are now."""
    return {
        "command": command,
        "date": datetime.now().astimezone().isoformat(timespec="minutes"),
        "commit": _commit(),
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "memory_gib": _memory_gib(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "packages": {name: found for name in PACKAGES if (found := _version(name)) is not None},
        "threads": {name: os.environ[name] for name in THREADS if name in os.environ},
        "load_before": load(),
    }


def load() -> float | None:
    """Load average over the last minute; None where the system has none."""
    try:
        return round(os.getloadavg()[0], 2)
    except (AttributeError, OSError):
        return None


def _processor() -> str:
    if sys.platform.startswith("linux"):
        text = Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace")
        for line in text.splitlines():
            if line.startswith("model name"):
                return " ".join(line.partition(":")[2].split())
    return platform.processor() or platform.machine()


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / 2**30, 1)
    except (AttributeError, ValueError, OSError):
        return None


def _version(name: str) -> str | None:
    try:
        return version(name)
    except PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit that is checked out around this module, with a plus where files differ from it."""
    try:
        command, here = ["git", "describe", "--always", "--dirty=+"], Path(__file__).parent
        done = subprocess.run(command, cwd=here, capture_output=True, text=True, check=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None


def run_command(*arguments: object) -> tuple[float, float]:
    """Run ``wavefocus`` with arguments; its processor seconds, and the peak memory of its largest process in bytes."""
    child = [sys.executable, "-m", "wavefocus.benchmarks.harness", *map(str, arguments)]
    done = subprocess.run(child, capture_output=True, text=True, check=False)
    if done.returncode:
        raise RuntimeError(f"wavefocus {' '.join(map(str, arguments))}: {done.stderr.strip()}")
    processor_s, peak = map(float, done.stdout.splitlines()[-1].split())
    return processor_s, peak


def _peak_bytes() -> int:
    """Peak of the resident memory; 0 where the system does not report it.

    Linux counts a process's peak (``getrusage``) from before it became another program, so that a child of a large
    parent seems large; ``VmHWM`` begins anew (proc(5)).
    """
    try:
        for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
            if line.startswith("VmHWM:"):
                return 1024 * int(line.split()[1])
    except OSError:
        pass
    return _usage()[1]


def _usage(*, children: bool = False) -> tuple[float, int]:
    """Processor seconds and peak memory of this process, or of those that it has waited for."""
    try:
        import resource
    except ImportError:
        return (0.0 if children else time.process_time()), 0
    used = resource.getrusage(resource.RUSAGE_CHILDREN if children else resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime, used.ru_maxrss * (1 if sys.platform == "darwin" else 1024)


def _main(arguments: list[str]) -> int:
    code: int = import_module("wavefocus.__main__").run(arguments)
    workers_s, workers_bytes = _usage(children=True)
    print(_usage()[0] + workers_s, max(_peak_bytes(), workers_bytes))
    return code


if __name__ == "__main__":
    sys.exit(_main(sys.argv[1:]))
