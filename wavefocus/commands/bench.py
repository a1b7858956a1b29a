"""``wavefocus bench``: error against run time."""

from __future__ import annotations

import json
from pathlib import Path

from wavefocus.console import people, say


def bench(what: str, out: Path, *, quick: bool) -> None:
    """Run the benchmarks and write their figures as JSON beside the printed tables."""
    out.mkdir(parents=True, exist_ok=True)
    if what in ("estimate", "all"):
        from benchmarks.estimate import run as estimate

        with people.status("estimators side by side ..."):
            figures = estimate(quick=quick)
        _keep(out / "estimate.json", figures)
    if what in ("render", "all"):
        from benchmarks.render import run as render

        with people.status("renderers side by side ..."):
            figures = render(out, quick=quick)
        _keep(out / "render.json", figures)


def _keep(path: Path, figures: dict[str, object]) -> None:
    path.write_text(json.dumps(figures, indent=2) + "\n", encoding="utf-8")
    say(f"wrote {path}")
