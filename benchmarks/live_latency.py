"""Latency of live sources, from a position's arrival to the first drive sample made with it, written.

``wavefocus live`` runs in a process of its own on the virtual rig's bank, and takes positions on a circle as JSON
lines, 100 a second: on the virtual player, whose clock is the wall's, and on a real audio server with a dummy driver.
Its last message has the latency of all positions at the 99.9th percentile.
"""

from __future__ import annotations

import json
import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from statistics import median
from typing import Any

from wavefocus.benchmarks.commands import write_bank
from wavefocus.benchmarks.harness import Findings, Mark, Point
from wavefocus.benchmarks.machine import run_command

DURATION_S, QUICK_S, SEVERAL_S = 600.0, 3.0, 60.0
SETTLED = 0.1
"""Memory is compared from this share of the duration on."""
MARK_MS, MARK_GROWTH_MB = 20.0, 10.0
POSITIONS_HZ = 100.0
RADIUS_MM, TURN_S, AMPLITUDE = 30.0, 2.0, 0.01
PERIOD_FRAMES = 1024
AHEAD_MS = {"virtual": 40.0, "emulated": 80.0}
"""The audio server asks for 21.3 ms at a time: so much more waits. A shorter period runs dry in the server itself."""


def run(out: Path | None = None, *, quick: bool = False) -> Findings:
    """Measure both players."""
    seconds = QUICK_S if quick else DURATION_S
    with tempfile.TemporaryDirectory(dir=out) as name:
        folder = Path(name)
        bank = write_bank(folder / "plate.h5", quick=quick)
        points = [
            _point(bank, folder, "virtual", 1, seconds),
            _point(bank, folder, "emulated", 1, seconds),
            _point(bank, folder, "virtual", 4, QUICK_S if quick else SEVERAL_S),
        ]
    notes = [
        f"Blocks of 5 ms, 20 actuators, {POSITIONS_HZ:g} positions a second of each source, look-ahead 50 ms; the audio"
        f" server's period is {PERIOD_FRAMES} frames at 48 kHz. Load: largest of each fifth of a second, the median."
    ]
    return Findings(points, notes=notes)


def _point(bank: Path, folder: Path, rig: str, sources: int, seconds: float) -> Point:
    lab = folder / rig
    if not lab.exists():
        run_command("init", lab, "--rig", rig)
    with _environment(rig) as environment:
        session = Session(bank, lab / "rig.toml", AHEAD_MS[rig], environment)
        session.play(sources, seconds)
    marks = (
        Mark("latency_p999_ms", MARK_MS, at_most=True),
        Mark("underruns", 0, at_most=True),
        Mark("memory_growth_mb", MARK_GROWTH_MB, at_most=True),
    )
    method = "virtual player on the wall's clock" if rig == "virtual" else "audio server with a dummy driver"
    return Point(
        work="position to drive sample written",
        method=method,
        parameters={"sources": sources, "seconds": seconds, "ahead_ms": AHEAD_MS[rig]},
        figures=session.figures(),
        marks=marks if sources == 1 else (),
    )


@contextmanager
def _environment(rig: str) -> Iterator[Mapping[str, str]]:
    """Variables of the session's process, and the audio server that they name."""
    if rig == "virtual":
        yield {}
        return
    from wavefocus.mocks.wire.jack_server import JackServer

    with JackServer(period_frames=PERIOD_FRAMES) as server:
        yield server.environment


@dataclass
class Session:
    """``wavefocus live`` as a process, its states, and the memory of all its processes."""

    bank: Path
    rig_file: Path
    ahead_ms: float
    environment: Mapping[str, str]
    states: list[dict[str, Any]] = field(default_factory=list)
    memory_mb: list[float] = field(default_factory=list)
    ended: dict[str, Any] = field(default_factory=dict)

    def play(self, sources: int, seconds: float) -> None:
        """Move sources for so long, then end."""
        arguments = ("live", self.bank, "--rig", self.rig_file, "--json", "--ahead-ms", self.ahead_ms)
        with subprocess.Popen(
            [sys.executable, "-m", "wavefocus", *map(str, arguments)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env={**os.environ, **self.environment, "PYTHONPATH": str(Path(__file__).parents[2])},
        ) as process:
            assert process.stdin is not None
            assert process.stdout is not None
            if "ready" not in process.stdout.readline():
                raise RuntimeError("wavefocus live did not begin")
            reader = threading.Thread(target=self._read, args=(process,))
            reader.start()
            begun_s = time.monotonic()
            for count in range(round(seconds * POSITIONS_HZ)):
                time.sleep(max(0.0, begun_s + count / POSITIONS_HZ - time.monotonic()))
                for source in range(sources):
                    angle = 2 * math.pi * (count / POSITIONS_HZ / TURN_S + source / sources)
                    at_mm = [RADIUS_MM * math.cos(angle), RADIUS_MM * math.sin(angle)]
                    order = {"order": "move", "name": f"{source}", "at_mm": at_mm, "amplitude": AMPLITUDE}
                    process.stdin.write(json.dumps(order) + "\n")
                process.stdin.flush()
            process.stdin.write('{"order": "end"}\n')
            process.stdin.flush()
            reader.join()

    def figures(self) -> dict[str, float]:
        """Figures of the session."""
        settled = self.memory_mb[int(SETTLED * len(self.memory_mb)) :]
        latencies = [state["latency_ms"] for state in self.states if state["latency_ms"] is not None]
        found = {
            "latency_p999_ms": float(self.ended["latency_p999_ms"]),
            "latency_largest_ms": float(max(latencies, default=math.nan)),
            "positions": float(self.ended["positions"]),
            "underruns": float(self.ended["underruns"]),
            "load": float(median(state["load"] for state in self.states)),
            "degraded_share": sum(state["degradation"] != "none" for state in self.states) / len(self.states),
        }
        return found | ({"memory_growth_mb": settled[-1] - settled[0]} if settled and settled[0] else {})

    def _read(self, process: subprocess.Popen[str]) -> None:
        assert process.stdout is not None
        for line in process.stdout:
            event = json.loads(line)
            if event["event"] == "state":
                self.states.append(event)
                self.memory_mb.append(_resident_mb(process.pid))
            elif event["event"] == "ended":
                self.ended = event


def _resident_mb(process: int) -> float:
    """Resident memory of a process and its children; 0 where the system has no /proc."""
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="utf-8").split()
        children = Path(f"/proc/{process}/task/{process}/children").read_text(encoding="utf-8").split()
    except OSError:
        return 0.0
    return int(status[status.index("VmRSS:") + 1]) / 1024 + sum(_resident_mb(int(child)) for child in children)
