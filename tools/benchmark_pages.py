"""Write docs/error-against-run-time/ and docs/reference/paper-figures.md from what `wavefocus bench` measured.

Run as ``python tools/benchmark_pages.py bench-out`` from the project's folder, after ``wavefocus bench all --out
bench-out`` and ``wavefocus bench paper --out bench-out``; `make bench` does all of that. Figures of a quick run are
refused.
"""

from __future__ import annotations

import json
import shutil
import sys
from pathlib import Path
from typing import Any

from wavefocus.benchmarks import BENCHMARKS
from wavefocus.benchmarks.harness import markdown

DOCS = Path("docs")
PAGE = DOCS / "error-against-run-time/README.md"
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
    if quick or not measured:
        print(f"{folder}: {', '.join(quick) or 'nothing'} was measured in full; run `make bench`", file=sys.stderr)
        return 1
    paper = measured.pop("paper", None)
    if measured:
        shutil.rmtree(PAGE.parent, ignore_errors=True)
        PAGE.parent.mkdir(parents=True)
        PAGE.write_text(_page(measured), encoding="utf-8")
        for found in measured.values():
            for picture in found["diagrams"].values():
                shutil.copyfile(folder / picture, PAGE.parent / picture)
    if paper is not None:
        (DOCS / "reference/paper-figures.md").write_text(_paper_page(paper), encoding="utf-8")
        for picture in BENCHMARKS["paper"].pictures:
            shutil.copyfile(folder / picture, DOCS / "pictures" / f"paper-{picture}")
    return 0


def _page(measured: dict[str, Any]) -> str:
    parts = [
        "# Error against run time\n\nMade by `make bench`; every time is the median of some runs, the methods taking"
        " turns in one process, its spread\nthe difference of the quartiles. `times` is the peer's wall or CPU time,"
        " whichever is less, over our wall time. Expect\nratios to vary by a quarter from run to run. Grey in a diagram"
        " is the Pareto front: no other setting beats those on it in\nerror and in time.\n[The paper's"
        " figures](../reference/paper-figures.md) and the [stiff and extreme cases](../reference/stiff-cases.md) have\n"
        "pages of their own.\n",
        _conditions(measured),
    ]
    for name, found in measured.items():
        head = f"## {BENCHMARKS[name].title.capitalize()}\n\n`wavefocus bench {name}`, {found['made']['seconds']:.0f} s"
        drawn = {f"**{work}**": ["", f"![{work}]({file})"] for work, file in found["diagrams"].items()}
        parts.append("\n".join([head, "", *(text for line in found["lines"] for text in (line, *drawn.get(line, [])))]))
    return "\n".join(parts)


def _paper_page(found: dict[str, Any]) -> str:
    pictures = [f"![Figure {file[:2]} of the paper](../pictures/paper-{file})\n" for file in
                BENCHMARKS["paper"].pictures]  # fmt: skip
    head = ["# The paper's figures on the virtual rig", "", "Made by `wavefocus bench paper`.", ""]
    return "\n".join([*head, *found["lines"], "", "## Figures", "", *pictures])


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
