"""``wavefocus bench``: error against run time."""

from __future__ import annotations

import json
import time
from importlib import import_module
from pathlib import Path
from typing import Any

from wavefocus.console import people, say

BENCHMARKS = {
    "bank": "what durability costs",
    "estimate": "estimators side by side",
    "render": "renderers side by side",
    "interpolation": "the bank between its positions",
    "focusing": "focusing methods on one scene",
    "paper": "the paper's figures on the virtual rig",
    "wires": "production drivers on emulated wires, in real time",
    "cluster": "a bank larger than memory, on one, two and no workers",
}
"""Modules of `benchmarks` by the name that the command line knows, and what they measure."""

ON_REQUEST = ("paper", "wires", "cluster")
"""Not part of ``all``: two take minutes, and the wires need an audio server."""


def bench(what: str, out: Path, *, quick: bool) -> None:
    """Run one benchmark, or all, and write their figures as JSON beside the printed tables."""
    from benchmarks.conditions import conditions, load

    out.mkdir(parents=True, exist_ok=True)
    for name in [one for one in BENCHMARKS if one not in ON_REQUEST] if what == "all" else [what]:
        module = import_module(f"benchmarks.{name}")
        made = conditions(f"wavefocus bench {name}")
        begun_s = time.monotonic()
        with people.status(f"{BENCHMARKS[name]} ..."):
            figures: dict[str, Any] = module.run(out, quick=quick)
        made |= {"seconds": round(time.monotonic() - begun_s, 1), "load_after": load()}
        path = out / f"{name}.json"
        path.write_text(json.dumps({**figures, "quick": quick, "made": made}, indent=2) + "\n", encoding="utf-8")
        say(f"wrote {path}")
