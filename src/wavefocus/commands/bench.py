"""``wavefocus bench``: error against run time."""

import time
from importlib import import_module
from pathlib import Path

from wavefocus.benchmarks import BENCHMARKS
from wavefocus.console import say, spinner
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import require_output_folder


def bench(what: str, out: Path, *, quick: bool, force: bool = False, seconds: float | None = None) -> None:
    """Run one benchmark, or all: print their tables, and write points and diagrams.

    seconds: For how long each case of `live_latency` plays.
    """
    if seconds is not None and what != "live_latency":
        raise InputError(f"--seconds is {seconds:g}; it goes with live_latency, and {what} was asked for")
    options = {} if seconds is None else {"seconds": seconds}
    from wavefocus.benchmarks.harness import conditions, draw_diagrams, load

    chosen = [name for name, one in BENCHMARKS.items() if not one.on_request] if what == "all" else [what]
    files = [name for one in chosen for name in (f"{one}.json", *BENCHMARKS[one].pictures)]
    require_output_folder(out, files, (), force=force)
    out.mkdir(parents=True, exist_ok=True)
    for name in chosen:
        module = import_module(f"wavefocus.benchmarks.{name}")
        made = conditions(f"wavefocus bench {name}")
        begun_s = time.monotonic()
        with spinner(BENCHMARKS[name].title):
            found = module.run(out, quick=quick, **options)
        made |= {"seconds": round(time.monotonic() - begun_s, 1), "load_after": load()}
        # Small workloads say nothing about the marks.
        print("\n".join(found.lines(judged=not quick)))
        diagrams = draw_diagrams(found, out, name)
        say(f"wrote {found.write(out, name, {'quick': quick, 'made': made, 'diagrams': diagrams})}")
