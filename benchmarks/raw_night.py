"""Raw recordings of a night streamed into a bank: Green's functions a second and memory, by the command itself.

What is streamed is a sample of a night of 1500 x 20 with records of the same size, so that the figure per signal is
the night's. Each estimate runs in a process of its own, which tells its processor time and its largest resident
memory. Two cores that are free do as many a second as their processor time allows; on a machine that others use the
clock on the wall tells less.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from acquisition.engine.measuring import measuring_of
from acquisition.engine.pointing import point_at
from acquisition.engine.raw_keeping import keep_recordings, raw_header
from acquisition.engine.record import take_record
from acquisition.schedule.plan import Plan
from benchmarks.rig_bank import BAND_HZ, RATE_HZ, TAPS, default_grid, rig_setup
from calibration.excitation.staggered_signal import StaggeredSignal
from calibration.excitation.sweeps import Excitation
from drivers.protocols import Recording, Take
from mocks.virtual.rig import VirtualRig
from storage.raw.writer import RawWriter, create_raw

NIGHT = 1500
STAGGER_S = 0.24
MARK_PER_S = 800.0
MARK_MB = 500.0
# Positions that are recorded; the others repeat them, for the estimator does not mind.
DIFFERENT = 4

CHILD = """
import sys, time
import scipy.optimize, scipy.signal  # a night is longer than the loading of modules, the sample is not
import wavefocus.commands.estimate, wavefocus.campaign.blueprint
from benchmarks.peak_memory import peak_bytes
from wavefocus.__main__ import run
began = time.process_time()
code = run(["estimate", sys.argv[1], "--bank", sys.argv[2], "--json"])
print(peak_bytes(), time.process_time() - began)
sys.exit(code)
"""


def run(*, quick: bool = False) -> dict[str, Any]:
    """Record, stream and print.

    Parameters
    ----------
    quick : bool
        A smaller sample.

    Returns
    -------
    dict
        Per schedule: Green's functions a second by the clock on the wall and on two free cores, milliseconds of
        processor per Green's function, peak memory in MB, sizes of the sample and of the night; `marks`.
    """
    rows: dict[str, dict[str, float]] = {}
    with tempfile.TemporaryDirectory() as folder:
        for name, positions in (("sequential 3 x 1 s", 4 if quick else 50), ("staggered 240 ms", 20 if quick else 300)):
            raw = Path(folder) / f"{len(rows)}.raw.h5"
            record_sample(raw, positions, staggered=name.startswith("staggered"))
            rows[name] = _streamed(raw, positions)
            raw.unlink()
    marks = {
        f"{name}: at least {MARK_PER_S:g} a second on two cores, at most {MARK_MB:g} MB": bool(
            row["per_s_two_cores"] >= MARK_PER_S and row["peak_mb"] <= MARK_MB
        )
        for name, row in rows.items()
    }
    _print(rows, marks)
    return {"streams": rows, "marks": marks}


def record_sample(path: Path, positions: int, *, staggered: bool) -> None:
    """Keep recordings of the virtual rig, a few positions over and over."""
    rig = VirtualRig()
    setup = rig_setup(rig)
    sweep = Excitation(RATE_HZ, *BAND_HZ, 1.0, TAPS / RATE_HZ, 1.0, 3)
    signal = StaggeredSignal(sweep, rig.settings.actuators, TAPS, round(STAGGER_S * RATE_HZ)) if staggered else None
    position_mm = default_grid(rig)[np.linspace(0, NIGHT - 1, positions).astype(int)]
    actuator_mm = np.asarray(rig.settings.actuator_mm, dtype=np.float64)
    plan = Plan(position_mm, actuator_mm, np.arange(positions), sweep, TAPS, "", staggered=signal)
    measuring = measuring_of(plan, setup)
    taken: list[list[Recording]] = []
    for position in range(min(DIFFERENT, positions)):
        point_at(setup, *position_mm[position])
        taken.append(
            [
                play.cut(take_record(setup, play.signals_v, RATE_HZ, Take(position, 1, play.actuator), play.samples))
                for play in measuring.plays
            ]
        )
    header = raw_header(plan, setup, rig_json="", run_json="", software="wavefocus bench estimate")
    create_raw(path, replace(header, plan_sha256=""))
    with RawWriter.open(path) as raw:
        for position in range(positions):
            keep_recordings(raw, position, taken[position % len(taken)])


def _streamed(raw: Path, positions: int) -> dict[str, float]:
    """Run the command in a process of its own."""
    bank = raw.with_suffix(".bank.h5")
    done = subprocess.run(
        [sys.executable, "-c", CHILD, str(raw), str(bank)], capture_output=True, text=True, check=True
    )
    told, measured = done.stdout.splitlines()[-2:]
    facts, (peak, processor_s) = json.loads(told), (float(one) for one in measured.split())
    signals = positions * 20
    per_s = float(facts["green_functions_per_s"])
    processor_ms = 1e3 * processor_s / signals
    size = raw.stat().st_size
    bank.unlink()
    return {
        "per_s": per_s,
        "per_s_two_cores": 2e3 / processor_ms,
        "processor_ms": processor_ms,
        "peak_mb": peak / 1e6,
        "sample_gb": size / 1e9,
        "night_gb": size / 1e9 * NIGHT / positions,
        "night_minutes": NIGHT * 20 * processor_ms / 2e3 / 60,
    }


def _print(rows: dict[str, dict[str, float]], marks: dict[str, bool]) -> None:
    print(
        f"\n{'recordings into a bank':24}{'a second':>10}{'2 free cores':>14}{'ms of processor':>17}"
        f"{'peak MB':>9}{'sample GB':>11}{'night GB':>10}{'night takes':>13}"
    )
    for name, row in rows.items():
        print(
            f"{name:24}{row['per_s']:10.0f}{row['per_s_two_cores']:14.0f}{row['processor_ms']:17.2f}{row['peak_mb']:9.0f}{row['sample_gb']:11.2f}"
            f"{row['night_gb']:10.1f}{row['night_minutes']:9.1f} min"
        )
    for mark, reached in marks.items():
        print(f"{mark}: {'yes' if reached else 'NO'}")


if __name__ == "__main__":
    run()
