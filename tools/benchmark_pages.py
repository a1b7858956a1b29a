"""Write docs/reference/benchmarks.md and paper-figures.md from what `wavefocus bench` measured.

Run as ``python tools/benchmark_pages.py bench-out`` from the project's folder, after ``wavefocus bench all --out
bench-out`` and ``wavefocus bench paper --out bench-out``; `make bench` does all of that. Figures of a quick run are
refused: they say nothing.
"""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

PAGE = Path("docs/reference/benchmarks.md")
PAPER_PAGE = Path("docs/reference/paper-figures.md")
PICTURES = Path("docs/pictures")
PRECISION = "render-precision.png"
PAPER_PICTURES = ("3A", "3B", "3C", "3D", "4A", "4B", "4C", "4D")
BUSY = 0.8
"""A machine whose load per core was above this before a benchmark began is called busy; on two cores the benchmark that
went before leaves 0.5 to 0.75."""

Figures = dict[str, Any]


class UnfitFiguresError(Exception):
    """What was measured cannot stand in the documentation."""


def main(arguments: Sequence[str]) -> int:
    """Write the pages; 1 with a line on standard error where the figures cannot stand there."""
    if len(arguments) != 1:
        print("usage: python tools/benchmark_pages.py DIR", file=sys.stderr)
        return 2
    try:
        measured = read(Path(arguments[0]))
    except UnfitFiguresError as unfit:
        print(unfit, file=sys.stderr)
        return 1
    PAGE.write_text(page_of(measured), encoding="utf-8")
    if (picture := Path(arguments[0]) / PRECISION).exists():
        shutil.copyfile(picture, PICTURES / PRECISION)
    if "paper" in measured:
        PAPER_PAGE.write_text(paper_page_of(measured["paper"]), encoding="utf-8")
        for name in PAPER_PICTURES:
            shutil.copyfile(Path(arguments[0]) / f"{name}.png", PICTURES / f"paper-{name}.png")
    return 0


def read(folder: Path) -> dict[str, Figures]:
    """Figures by benchmark, in the order of the page.

    Raises
    ------
    UnfitFiguresError
        There are none, or some are of a quick run, or do not say how they were made.
    """
    found = {path.stem: json.loads(path.read_text(encoding="utf-8")) for path in sorted(folder.glob("*.json"))}
    if not found:
        raise UnfitFiguresError(f"{folder} holds no figures; run wavefocus bench all --out {folder}")
    for name, figures in found.items():
        if figures.get("quick", True):
            raise UnfitFiguresError(f"{folder}/{name}.json is of a quick run, which says nothing: run it in full")
        if "made" not in figures:
            raise UnfitFiguresError(f"{folder}/{name}.json does not say how it was made: run it again")
    order = [*SECTIONS, *(name for name in found if name not in SECTIONS)]
    return {name: found[name] for name in order if name in found}


def page_of(measured: dict[str, Figures]) -> str:
    """The page, in Markdown."""
    parts = [
        "# Benchmarks, as measured\n\nMade by `make bench`; every figure is the best of some runs, the methods taking"
        ' turns in one process.\n"Times" is the peer\'s wall or CPU time, whichever is less, over our wall time.'
        " Expect ratios to vary by a\nquarter from run to run. [The paper's figures](paper-figures.md) and the [stiff"
        " and extreme cases](stiff-cases.md)\nstand on pages of their own.\n",
        conditions_of(measured),
    ]
    for name, figures in measured.items():
        if name == "paper":
            continue
        title, section = SECTIONS.get(name, (name.capitalize(), anything_of))
        parts.append(
            f"## {title}\n\n`wavefocus bench {name}`, {figures['made']['seconds']:.0f} s\n\n{section(figures)}"
        )
    return "\n".join(parts)


def conditions_of(measured: dict[str, Figures]) -> str:
    """What ran on which machine, how busy it was; each machine once."""
    machines: dict[str, list[tuple[str, str, str, str]]] = {}
    for name, figures in measured.items():
        made = figures["made"]
        packages = ", ".join(f"{package} {version}" for package, version in made["packages"].items())
        threads = ", ".join(f"{key}={value}" for key, value in made["threads"].items()) or "threads as they come"
        machine = (
            f"{made['processor']}, {made['cores']} cores, {made['memory_gib'] or '?'} GiB, {made['system']}."
            f" Python {made['python']}, {packages}; {threads}."
        )
        line = (name, f"{made['date']}", made["commit"] or "-", _load_words(made))
        machines.setdefault(machine, []).append(line)
    head = ("benchmark", "date", "commit (+: changed files)", "load average before and after")
    return "\n".join(f"{machine}\n\n{table(head, lines)}" for machine, lines in machines.items())


def _load_words(made: Figures) -> str:
    before, after = made["load_before"], made["load_after"]
    if before is None:
        return "-"
    busy = " (**busy**: times are too long, ratios uncertain)" if before > BUSY * made["cores"] else ""
    return f"{before}, {after}{busy}"


def render_of(figures: Figures) -> str:
    """Marks first, then every line, then the work-precision picture."""
    marks = [
        (
            mark["work"],
            mark["method"],
            f"{mark['figure']} at {'most' if mark['at_most'] else 'least'} {mark['value']:g}",
            _number(_measured(mark, figures["results"])),
            "met" if mark["met"] else "**not met**",
        )
        for mark in figures["marks"]
    ]
    lines = [
        (
            one["work"],
            one["method"],
            _number(one["wall_s"]),
            _number(one["cpu_s"]),
            _number(one["times"]),
            "" if one["error"] is None else f"{one['error']:.1e}",
            one["remark"],
        )
        for one in figures["results"]
    ]
    points = [
        (
            one["method"],
            "" if one["step_mm"] is None else f"{one['step_mm']:g} mm",
            "" if one["tolerance_db"] is None else f"{one['tolerance_db']:g} dB",
            _number(one["wall_s"]),
            _number(one["cpu_s"]),
            f"{one['error']:.1e}",
        )
        for one in figures["precision"]
    ]
    return (
        "### Marks\n\n"
        + table(("work", "method", "mark", "measured", ""), marks)
        + "\n### All lines\n\n"
        + table(("work", "method", "wall s", "CPU s", "times", "error", "remark"), lines)
        + "\n### Error over the path's sample distance and over run time\n\n"
        + f"![Work and precision of all renderers of one moving source](../pictures/{PRECISION})\n\n"
        + "The reference is direct summation of eq. (9), sample by sample; errors are relative L2 errors of drives.\n\n"
        + table(("method", "d", "tolerance", "wall s", "CPU s", "error"), points)
    )


def _measured(mark: Figures, results: Iterable[Figures]) -> float | None:
    """A mark's own figure, else how many times faster its line is."""
    if mark["measured"] is not None:
        return float(mark["measured"])
    for one in results:
        if (one["work"], one["method"]) == (mark["work"], mark["method"]):
            return None if one["times"] is None else float(one["times"])
    return None


def interpolation_of(figures: Figures) -> str:
    """Errors between positions, by kind, bank and frequency."""
    errors = [
        (
            one["kind"],
            "noise-free" if one["bank_db"] is None else f"{one['bank_db']:g} dB",
            f"{one['frequency_hz']:g} Hz",
            _percent(one["median"]),
            _percent(one["worst"]),
            _percent(one["estimated"]),
            "" if one["mark"] is None else _judged(one["median"] <= one["mark"], f"at most {_percent(one['mark'])}"),
        )
        for one in figures["errors"]
    ]
    head = ("kind", "bank", "at", "median error", "worst", "estimated from the bank alone", "mark of the median")
    return table(head, errors) + "\n" + anything_of({key: figures[key] for key in ("seconds", "grids")})


def focusing_of(figures: Figures) -> str:
    """Ways of focusing on the same scenes."""
    lines = [
        (
            one["scene"],
            one["method"],
            _number(one["width_mm"]),
            _number(one["off_mm"]),
            _number(one["artefact_db"]),
            _number(one["at_focus"]),
            _number(one["energy"]),
            _number(one["peak"]),
            _number(one["condition"]),
        )
        for one in figures["results"]
    ]
    head = (
        "scene",
        "method",
        "focal width mm",
        "off mm",
        "artefacts dB",
        "at the focus",
        "energy",
        "peak",
        "condition",
    )
    return "Energy and peak of the drives are relative to time reversal.\n\n" + table(head, lines)


def estimate_of(figures: Figures) -> str:
    """Estimators side by side, and nights."""
    methods = [
        (
            name,
            _number(1e3 * one["seconds_per_record"]),
            _number(one["relative_speed"]),
            _number(one["median_error_db"]),
            _number(one["worst_error_db"]),
        )
        for name, one in figures["methods"].items()
    ]
    marks = [(mark, "not compared" if met is None else _judged(met, "")) for mark, met in figures["marks"].items()]
    rest = {key: figures[key] for key in ("nights", "trials", "streams") if key in figures}
    return (
        table(("method", "ms a record", "times pyfar's speed", "median error dB", "worst"), methods)
        + f"\nThe noise's own limit is {figures['limit_db']:.1f} dB.\n\n"
        + table(("mark", ""), marks)
        + "\n"
        + anything_of(rest)
    )


def anything_of(figures: Figures) -> str:
    """Any figures, one line each, by their names."""
    return table(("figure", "value"), list(_flat(figures)))


def _flat(value: Any, name: str = "") -> Iterable[tuple[str, str]]:
    if isinstance(value, dict):
        for key, inner in value.items():
            if name or key not in ("made", "quick"):
                yield from _flat(inner, f"{name}, {key}" if name else str(key).replace("_", " "))
    elif isinstance(value, list) and value and isinstance(value[0], dict):
        for number, inner in enumerate(value, 1):
            yield f"{name} {number}", "; ".join(f"{key} {text}" for key, text in _flat(inner))
    elif isinstance(value, list):
        yield name, ", ".join(_number(one) if isinstance(one, int | float) else str(one) for one in value)
    elif isinstance(value, bool):
        yield name, "yes" if value else "no"
    else:
        yield name, _number(value) if isinstance(value, int | float) else str(value)


def paper_page_of(figures: Figures) -> str:
    """The paper's numbers beside ours, and its figures drawn on the virtual rig."""
    words = {True: "as the paper", False: "**not** as the paper", None: ""}
    rows = [(row["what"], row["paper"], row["ours"], words[row["met"]], row["definition"]) for row in figures["rows"]]
    pictures = "\n".join(
        f"### {name}\n\n![Figure {name} of the paper](../pictures/paper-{name}.png)\n" for name in PAPER_PICTURES
    )
    return (
        "# The paper's figures on the virtual rig\n\n"
        f"Made by `wavefocus bench paper`. Bank: {figures['bank']}.\n\n"
        + table(("figure", "paper", "ours", "", "definition of ours"), rows)
        + f"\n## Figures\n\n{pictures}"
    )


def table(head: Sequence[str], lines: Iterable[Sequence[str]]) -> str:
    """A table in Markdown."""
    rows = [head, ["---"] * len(head), *lines]
    return "\n".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in row) + " |" for row in rows) + "\n"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _percent(value: float) -> str:
    return f"{100 * value:.2g} %" if value < 1 else f"{100 * value:.0f} %"


def _judged(met: bool, mark: str) -> str:
    return f"{mark}{': ' if mark else ''}{'met' if met else '**not met**'}"


SECTIONS: dict[str, tuple[str, Callable[[Figures], str]]] = {
    "render": ("Drives and fields", render_of),
    "interpolation": ("The bank between its positions", interpolation_of),
    "focusing": ("Ways of focusing", focusing_of),
    "estimate": ("Estimators and nights", estimate_of),
    "bank": ("Durability", anything_of),
    "wires": ("Production drivers on emulated wires", anything_of),
    "paper": ("The paper's figures", anything_of),
}
"""Titles and writers by benchmark, in the order of the page; others come after them, as plain lists."""

if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
