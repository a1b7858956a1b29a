"""Benchmarks: error against run time, with other programs in the same run.

A benchmark is a module here with ``run(out, quick=...)`` that returns `wavefocus.benchmarks.harness.Findings`, and an
entry of `BENCHMARKS`.
"""

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class _Benchmark:
    """A benchmark of ``wavefocus bench``, with the names of the pictures that it draws.

    One that takes minutes, or needs an audio server, runs `on_request` and is not part of ``all``.
    """

    title: str
    on_request: bool = False
    pictures: tuple[str, ...] = ()


BENCHMARKS = {
    "plate": _Benchmark("simulated plates"),
    "bank": _Benchmark("commit latency against durability"),
    "estimate": _Benchmark("estimators side by side"),
    "render": _Benchmark("renderers and predictors side by side"),
    "interpolation": _Benchmark("the bank between its positions"),
    "quiet": _Benchmark("quiet places: level, drive energy, run time", on_request=True),
    "commands": _Benchmark("commands from the shell"),
    "paper": _Benchmark(
        "the paper's figures on the virtual rig",
        on_request=True,
        pictures=tuple(f"{figure}{part}.png" for figure in "34" for part in "ABCD"),
    ),
    "wires": _Benchmark("production drivers on emulated wires, in real time", on_request=True),
    "live_latency": _Benchmark("latency of live sources, ten minutes on each player", on_request=True),
}
