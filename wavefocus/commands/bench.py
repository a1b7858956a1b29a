"""``wavefocus bench``: error against run time."""

from __future__ import annotations

import json
import time
from importlib import import_module
from pathlib import Path
from typing import Any

from storage.output_files import require_output_folder, write_whole
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

PICTURES = {
    "render": ("render-precision.png",),
    "paper": tuple(f"{figure}{part}.png" for figure in "34" for part in "ABCD"),
}
"""Pictures that a benchmark draws beside its figures."""


def bench(what: str, out: Path, *, quick: bool, force: bool = False) -> None:
    """Run one benchmark, or all, and write their figures as JSON beside the printed tables."""
    from benchmarks.conditions import conditions, load

    chosen = [one for one in BENCHMARKS if one not in ON_REQUEST] if what == "all" else [what]
    files = [name for one in chosen for name in (f"{one}.json", f"{one}.md", *PICTURES.get(one, ()))]
    require_output_folder(out, files, (), force=force)
    out.mkdir(parents=True, exist_ok=True)
    for name in chosen:
        module = import_module(f"benchmarks.{name}")
        made = conditions(f"wavefocus bench {name}")
        begun_s = time.monotonic()
        with people.status(f"{BENCHMARKS[name]} ..."):
            figures: dict[str, Any] = module.run(out, quick=quick)
        made |= {"seconds": round(time.monotonic() - begun_s, 1), "load_after": load()}
        path = out / f"{name}.json"
        write_whole(path, json.dumps({**figures, "quick": quick, "made": made}, indent=2) + "\n")
        say(f"wrote {path}")
