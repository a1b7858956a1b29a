"""Write bench-out/README.md, all tables and diagrams, and docs/reference/measured.md, their summary, from `make bench`.

Run as ``python tools/benchmark_pages.py bench-out`` from the project's folder, after ``wavefocus bench all --out
bench-out`` and ``wavefocus bench paper --out bench-out``. Figures of a quick run are refused.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from wavefocus.benchmarks import BENCHMARKS
from wavefocus.benchmarks.harness import cell, heading, markdown, pareto

PAGE, PICTURES = Path("docs/reference/measured.md"), Path("docs/pictures")
SHOWN = {"render": "one moving source", "estimate": "estimating 20 records"}
"""How the works begin whose best methods the page shows."""
BUSY = 0.8
"""Load per core before a benchmark above which the machine is called busy; the benchmark before leaves 0.5 to 0.75."""


def main(arguments: list[str]) -> int:
    """Write the pages and copy the pictures; 1 with a line on standard error where a run is quick or missing."""
    if len(arguments) != 1:
        print("usage: python tools/benchmark_pages.py DIR", file=sys.stderr)
        return 2
    folder = Path(arguments[0])
    measured = {name: json.loads(path.read_text(encoding="utf-8")) for name in BENCHMARKS
                if (path := folder / f"{name}.json").exists()}  # fmt: skip
    quick = [name for name, found in measured.items() if found["quick"]]
    if quick or not set(SHOWN) < set(measured) or "paper" not in measured:
        print(f"{folder}: {', '.join(quick) or 'not all'} was measured in full; run `make bench`", file=sys.stderr)
        return 1
    (folder / "README.md").write_text(_tables(measured), encoding="utf-8")
    PAGE.write_text(_summary(measured), encoding="utf-8")
    for name, work in SHOWN.items():
        shutil.copyfile(folder / _diagram(measured[name], work), PICTURES / f"bench-{name}.png")
    for picture in BENCHMARKS["paper"].pictures:
        shutil.copyfile(folder / picture, PICTURES / f"paper-{picture}")
    return 0


def _tables(measured: dict[str, Any]) -> str:
    """All tables, each with its diagram."""
    parts = [
        "# Error against run time\n\nTimes are medians of some runs, the methods taking turns in one process; the"
        " spread is the difference of the\nquartiles. `times` is the peer's wall or CPU time, whichever is less, over"
        " our wall time. Grey in a diagram is the Pareto front.\n",
        _conditions(measured),
    ]
    for name, found in measured.items():
        head = f"## {BENCHMARKS[name].title.capitalize()}\n\n`wavefocus bench {name}`, {found['made']['seconds']:.0f} s"
        drawn = {f"**{work}**": ["", f"![{work}]({file})"] for work, file in found["diagrams"].items()}
        parts.append("\n".join([head, "", *(text for line in found["lines"] for text in (line, *drawn.get(line, [])))]))
    return "\n".join(parts)


def _summary(measured: dict[str, Any]) -> str:
    """Conditions, targets missed, the best methods of `SHOWN`, and the paper's numbers and figures."""
    missed = [
        f"{name}: {mark['method']} ({mark['work']}): {heading(mark['figure'])}"
        for name, found in measured.items()
        for mark in found["marks"]
        if mark["met"] is False
    ]
    count = sum(len(found["marks"]) for found in measured.values())
    parts = [
        "# Measured figures\n\nMade by `make bench`, which writes all tables and diagrams to `bench-out/README.md`;"
        " ratios vary by a quarter from run to run.\nErrors are relative L2 errors.\n",
        _conditions(measured),
        f"Of {count} targets missed: {'; '.join(missed) or 'none'}.\n",
    ]
    for name, work in SHOWN.items():
        points = [one for one in measured[name]["points"] if one["work"].startswith(work) and one.get("error")]
        rows = [["no other method is faster and more exact", "wall s", "error"]]
        for place in pareto([(one["wall_s"], one["error"]) for one in points]):
            one = points[place]
            setting = "".join(
                f", {heading(key)} {cell(key, one[key])}" for key in ("tolerance_db", "step_mm") if one.get(key)
            )
            rows.append([one["method"] + setting, cell("wall_s", one["wall_s"]), cell("error", one["error"])])
        parts.append("\n".join([f"## {points[0]['work'].capitalize()}", "", *markdown(rows), ""]))
    pictures = [f"![Figure {file[:2]} of the paper](../pictures/paper-{file})" for file in BENCHMARKS["paper"].pictures]
    lines = measured["paper"]["lines"]
    ends = next(place for place, line in enumerate(lines) if line.startswith("**time of each part"))
    rows = [" ".join(pictures[:4]), " ".join(pictures[4:])]
    return "\n".join([*parts, "## The paper's figures on the virtual rig", "", *lines[:ends], *rows, ""])


def _diagram(found: dict[str, Any], work: str) -> str:
    return next(file for name, file in found["diagrams"].items() if name.startswith(work))


def _conditions(measured: dict[str, Any]) -> str:
    """Which benchmark ran on which machine, and how busy it was; each machine once."""
    machines: dict[str, list[list[str]]] = {}
    for name, found in measured.items():
        made = found["made"]
        packages = ", ".join(f"{package} {version}" for package, version in made["packages"].items())
        threads = ", ".join(f"{key}={value}" for key, value in made["threads"].items()) or "default threads"
        machine = (
            f"{made['processor']}, {made['cores']} cores, {made['memory_gib'] or '?'} GiB, {made['system']}."
            f" Python {made['python']}, {packages}; {threads}."
        )
        before, after = made["load_before"], made["load_after"]
        busy = before is not None and before > BUSY * made["cores"]
        load = f"{before}, {after}{' (**busy**: times are too long, ratios uncertain)' if busy else ''}"
        machines.setdefault(machine, []).append([name, made["date"], made["commit"] or "-", load])
    head = ["benchmark", "date", "commit (+: changed files)", "load average before and after"]
    return "\n".join("\n".join([machine, "", *markdown([head, *rows]), ""]) for machine, rows in machines.items())


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
