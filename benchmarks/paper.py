"""The paper's figures on the virtual rig, and its numbers beside ours, misses included.

The plate is a soft plate fitted to the paper's group velocity and
attenuation (`mocks.plates.soft`), without the reflections of a real one's rim; the actuators lie on the rim.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

from benchmarks import paper_rows
from benchmarks.paper_rows import Row, table_of
from benchmarks.rig_bank import paper_bank
from rendering.report.canvas import Picture
from storage.output_files import write_whole

FOCI, QUICK_FOCI = 120, 24
SEEDS, QUICK_SEEDS = 8, 2


def run(out: Path, *, quick: bool = False) -> dict[str, Any]:
    """Draw the figures into a folder, print and write the table.

    Returns ``rows``, the table; ``bank``, where it comes from; ``seconds`` per figure.
    """
    out.mkdir(parents=True, exist_ok=True)
    watch = _Stopwatch(out)
    source = watch.time("bank", lambda: paper_bank(out, quick=quick))
    surface = paper_rows.surface_of(source)
    rows = paper_rows.travel(source)
    watch.draw(lambda: paper_rows.figure_3a(source, surface))
    rows += watch.draw_and_tell(lambda: paper_rows.figure_3b(source, surface))
    rows += watch.draw_and_tell(lambda: paper_rows.figure_3c(source, surface))
    rows += watch.time("foci", lambda: paper_rows.foci(source, QUICK_FOCI if quick else FOCI))
    rows += watch.draw_and_tell(lambda: paper_rows.figure_3d(source, surface, quick=quick))
    rows += watch.draw_and_tell(lambda: paper_rows.figure_4a(source, surface))
    watch.draw(lambda: paper_rows.figure_4b(source, surface))
    rows += watch.draw_and_tell(lambda: paper_rows.figure_4c(source, surface, QUICK_SEEDS if quick else SEEDS))
    rows += watch.draw_and_tell(lambda: paper_rows.figure_4d(source))
    table = table_of(rows, source.how)
    write_whole(out / "paper.md", table)
    print(table)
    return {"quick": quick, "bank": source.how, "rows": [asdict(row) for row in rows], "seconds": watch.seconds}


class _Stopwatch:
    """Times the parts and keeps the pictures."""

    def __init__(self, out: Path) -> None:
        self.seconds: dict[str, float] = {}
        self._out = out

    def time(self, name: str, work: Callable[[], Any]) -> Any:
        began = time.perf_counter()
        result = work()
        self.seconds[name] = round(time.perf_counter() - began, 3)
        return result

    def draw(self, work: Callable[[], Picture]) -> None:
        self.draw_and_tell(lambda: (work(), []))

    def draw_and_tell(self, work: Callable[[], tuple[Picture, list[Row]]]) -> list[Row]:
        began = time.perf_counter()
        picture, rows = work()
        write_whole(self._out / f"{picture.name}.png", picture.png)
        self.seconds[picture.name] = round(time.perf_counter() - began, 3)
        return rows
