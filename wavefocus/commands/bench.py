"""``wavefocus bench``: error against run time."""

from __future__ import annotations

import time
from importlib import import_module
from pathlib import Path

from benchmarks import BENCHMARKS
from storage.output_files import require_output_folder
from wavefocus.console import people, say


def bench(what: str, out: Path, *, quick: bool, force: bool = False) -> None:
    """Run one benchmark, or all: print their tables, and write their points as JSON and CSV."""
    from benchmarks.machine import conditions, load

    chosen = [name for name, one in BENCHMARKS.items() if not one.on_request] if what == "all" else [what]
    files = [name for one in chosen for name in (f"{one}.json", f"{one}.csv", *BENCHMARKS[one].pictures)]
    require_output_folder(out, files, (), force=force)
    out.mkdir(parents=True, exist_ok=True)
    for name in chosen:
        module = import_module(f"benchmarks.{name}")
        made = conditions(f"wavefocus bench {name}")
        begun_s = time.monotonic()
        with people().status(f"{BENCHMARKS[name].title} ..."):
            found = module.run(out, quick=quick)
        made |= {"seconds": round(time.monotonic() - begun_s, 1), "load_after": load()}
        # Small workloads say nothing about the marks.
        print("\n".join(found.lines(judged=not quick)))
        say(f"wrote {found.write(out, name, {'quick': quick, 'made': made})}")
