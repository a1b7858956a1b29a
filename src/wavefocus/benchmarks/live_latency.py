"""Live sources: latency, and how quiet independent sources are.

``wavefocus live`` runs in a process of its own on the virtual rig's bank, and takes positions of sources on a circle as
JSON lines, 100 a second of each: on the virtual player, whose clock is the wall's, and on a real audio server with a
dummy driver. Latency is the time from a position's arrival to the first drive sample made with it, written. The last
message has that of all positions at the 99.9th percentile. A stall of the machine that is longer than what waits to be
played makes an underrun whatever the session does: the longest that the process that sends has met is stated.

The level of independent sources is the energy of the response where a source of amplitude 0 is over that where one
sounds, the largest of three, all four moving: at the measured position nearest to each, and at its true place between
them, on the plate itself, for which the mark is.
"""

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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.benchmarks.commands import write_bank
from wavefocus.benchmarks.harness import Entry, Findings, Mark, run_command
from wavefocus.benchmarks.rig_bank import RATE_HZ, TAPS, true_bank
from wavefocus.calibration.numerics import one_blas_thread
from wavefocus.config.scene import Regularisation
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.live.engine import LiveEngine
from wavefocus.rendering.scene.signals import Noise
from wavefocus.storage.bank.reading import Bank, open_bank

DURATION_S, QUICK_S = 600.0, 3.0
MARK_GROWTH_MB = 10.0
POSITIONS_HZ = 100.0
RADIUS_MM, SPEED_MM_S, AMPLITUDE = 30.0, 100.0, 0.01
LEVEL_RADII_MM, QUIET_SOURCES = (30.0, 17.0), 4
"""Radii of the circle on which independent sources are judged; four of them on it are 42 and 24 mm apart."""
PERIOD_FRAMES = 1024
AHEAD_MS = {"virtual": 40.0, "emulated": 80.0}
"""The audio server asks for 21.3 ms at a time: so much more waits. A shorter period runs dry in the server itself."""
BLOCK_S, LOOK_AHEAD_S = 0.005, 0.05


@dataclass(frozen=True, slots=True)
class _LatencyCase:
    """Sources at a time on a rig, and the latency wanted, in ms."""

    rig: str
    sources: int
    mark_ms: float
    independent: bool = False


TEN, INDEPENDENT = _LatencyCase("virtual", 10, 20.0), _LatencyCase("virtual", QUIET_SOURCES, 25.0, independent=True)
ONE = (_LatencyCase("virtual", 1, 20.0), _LatencyCase("emulated", 1, 20.0))


def run(out: Path | None = None, *, quick: bool = False, seconds: float | None = None) -> Findings:
    """Measure levels, and latencies on both players.

    seconds: Only ten sources and independent ones, on the virtual player, each for so long.
    """
    cases = (TEN, INDEPENDENT) if seconds is not None else (TEN, INDEPENDENT, *ONE)
    lasts_s = seconds if seconds is not None else QUICK_S if quick else DURATION_S
    with tempfile.TemporaryDirectory(dir=out) as name:
        folder = Path(name)
        path = write_bank(folder / "plate.h5", quick=quick)
        with open_bank(path) as bank, one_blas_thread():
            points = [_level(bank, radius_mm) for radius_mm in LEVEL_RADII_MM[: 1 if quick else None]]
        points += [_latency(path, folder, case, lasts_s) for case in cases]
    notes = [
        f"Blocks of {1e3 * BLOCK_S:g} ms, 20 actuators, {POSITIONS_HZ:g} positions a second of each source, which move"
        f" at {SPEED_MM_S:g} mm/s, look-ahead {1e3 * LOOK_AHEAD_S:g} ms; the audio server's period is {PERIOD_FRAMES}"
        " frames at 48 kHz."
    ]
    return Findings(points, notes=notes)


def _places_mm(time_s: float, sources: int, radius_mm: float = RADIUS_MM) -> list[tuple[float, float]]:
    """Where sources are."""
    angles = [SPEED_MM_S / radius_mm * time_s + 2 * math.pi * source / sources for source in range(sources)]
    return [(radius_mm * math.cos(angle), radius_mm * math.sin(angle)) for angle in angles]


def _engine(bank: Bank, *, independent: bool, **options: Any) -> LiveEngine:
    engine = LiveEngine(
        bank, block_samples=round(BLOCK_S * RATE_HZ), look_ahead_samples=round(LOOK_AHEAD_S * RATE_HZ),
        regularisation=Regularisation(independent=independent),
        interpolation="kernel" if independent else "nearest", **options,
    )  # fmt: skip
    engine.preload()
    return engine


def _level(bank: Bank, radius_mm: float) -> Entry:
    """Sources on a circle, of which the first sounds."""
    engine = _engine(bank, independent=True, signal=Noise((50.0, 450.0), 0.4, 5))
    blocks, every = round(1.2 / BLOCK_S), round(1.0 / POSITIONS_HZ / BLOCK_S)
    drive_v = []
    for block in range(blocks):
        if block % every == 0:
            for source, at_mm in enumerate(_places_mm(block * BLOCK_S, QUIET_SOURCES, radius_mm)):
                engine.move(f"{source}", at_mm, 0.0 if source else 1.0)
        drive_v.append(engine.next_block())
    drive, rig, grid = np.concatenate(drive_v, axis=1), VirtualRig(), PositionGrid(bank.position_mm)
    at_measured, at_true = [], []
    for now_s in np.arange(0.5, 1.15, 0.004).tolist():
        places_mm = np.array(_places_mm(now_s - LOOK_AHEAD_S, QUIET_SOURCES, radius_mm))
        rows, _ = grid.nearest(places_mm)
        at_measured.append([_response(drive, bank.green(row), now_s) for row in rows.tolist()])
        at_true.append([_response(drive, green, now_s) for green in true_bank(rig, places_mm, None).values])
    levels_db = []
    for response in (at_measured, at_true):
        energy = np.square(response).mean(axis=(0, 2))
        levels_db.append(10.0 * math.log10(float(energy[1:].max() / energy[0])))
    return Entry(
        work="response at sources of amplitude 0, of four at 100 mm/s", method="live, independent",
        parameters={"radius_mm": radius_mm}, figures={"measured_db": levels_db[0], "true_place_db": levels_db[1]},
        marks=(Mark("true_place_db", -25.0, at_most=True),),
    )  # fmt: skip


def _response(drive_v: Float64Array, green: NDArray[Any], now_s: float) -> Float64Array:
    """Response within 2 ms around an instant."""
    sample = round(now_s * RATE_HZ) + np.arange(-20, 20, 5)
    windows = np.stack([drive_v[:, last - TAPS + 1 : last + 1][:, ::-1] for last in sample.tolist()])
    return np.asarray(np.einsum("sit,it->s", windows, green, optimize=True))


def _latency(bank: Path, folder: Path, case: _LatencyCase, seconds: float) -> Entry:
    lab = folder / case.rig
    if not lab.exists():
        run_command("init", lab, "--rig", case.rig)
    with _environment(case.rig) as environment:
        figures = _figures(bank, lab / "rig.toml", case, seconds, environment)
    return Entry(
        work="position to drive sample written",
        method="virtual player on the wall's clock" if case.rig == "virtual" else "audio server with a dummy driver",
        parameters={
            "sources": case.sources,
            "independent": case.independent,
            "seconds": seconds,
            "ahead_ms": AHEAD_MS[case.rig],
        },
        figures=figures,
        marks=(
            Mark("latency_p999_ms", case.mark_ms, at_most=True),
            Mark("underruns", 0, at_most=True),
            Mark("memory_growth_mb", MARK_GROWTH_MB, at_most=True),
        ),
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


def _figures(
    bank: Path, rig_file: Path, case: _LatencyCase, seconds: float, environment: Mapping[str, str]
) -> dict[str, float]:
    """Figures of ``wavefocus live`` as a process, whose sources move for so long."""
    independent = ["--independent"] if case.independent else []
    arguments = ["live", bank, "--rig", rig_file, "--json", "--ahead-ms", AHEAD_MS[case.rig], *independent]
    states: list[dict[str, Any]] = []
    memory_mb: list[float] = []
    ended: dict[str, Any] = {}
    stall_s = 0.0
    with subprocess.Popen(
        [sys.executable, "-m", "wavefocus", *map(str, arguments)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={**os.environ, **environment, "PYTHONPATH": str(Path(__file__).parents[2])},
    ) as process:
        assert process.stdin is not None
        told = process.stdout
        assert told is not None
        if "ready" not in told.readline():
            raise RuntimeError("wavefocus live did not begin")

        def read() -> None:
            for line in told:
                event = json.loads(line)
                if event["event"] == "state":
                    states.append(event)
                    memory_mb.append(_resident_mb(process.pid))
                elif event["event"] == "ended":
                    ended.update(event)

        reader = threading.Thread(target=read)
        reader.start()
        begun_s = time.monotonic()
        for count in range(round(seconds * POSITIONS_HZ)):
            before_s, due_s = time.monotonic(), begun_s + count / POSITIONS_HZ
            time.sleep(max(0.0, due_s - before_s))
            stall_s = max(stall_s, time.monotonic() - max(before_s, due_s))
            for source, at_mm in enumerate(_places_mm(count / POSITIONS_HZ, case.sources)):
                order = {"order": "move", "name": f"{source}", "at_mm": at_mm, "amplitude": AMPLITUDE}
                process.stdin.write(json.dumps(order) + "\n")
            process.stdin.flush()
        process.stdin.write('{"order": "end"}\n')
        process.stdin.flush()
        reader.join()
    # Memory is compared from this share of the duration on.
    settled = memory_mb[int(0.1 * len(memory_mb)) :]
    latencies = [state["latency_ms"] for state in states if state["latency_ms"] is not None]
    found = {
        "latency_p999_ms": float(ended["latency_p999_ms"]),
        "latency_largest_ms": float(max(latencies, default=math.nan)),
        "underruns": float(ended["underruns"]),
        "stall_ms": 1e3 * stall_s,
    }
    return found | ({"memory_growth_mb": settled[-1] - settled[0]} if settled and settled[0] else {})


def _resident_mb(process: int) -> float:
    """Resident memory of a process and its children; 0 where the system has no /proc."""
    try:
        status = Path(f"/proc/{process}/status").read_text(encoding="utf-8").split()
        children = Path(f"/proc/{process}/task/{process}/children").read_text(encoding="utf-8").split()
    except OSError:
        return 0.0
    return int(status[status.index("VmRSS:") + 1]) / 1024 + sum(_resident_mb(int(child)) for child in children)
