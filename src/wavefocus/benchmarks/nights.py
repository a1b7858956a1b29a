"""Nights on the virtual rig: error against hours of measuring.

The campaign is that of the paper: 1500 positions, 20 actuators, 20-500 Hz, responses of 200 ms. Hours are those of the
rig's own clock over the positions that were measured, the whole way through the engine into a bank, times the
positions of it; errors are those of the same positions against the rig's truth.
"""

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from wavefocus.acquisition.plan import Plan
from wavefocus.benchmarks.harness import Entry
from wavefocus.benchmarks.rig_bank import BAND_HZ, RATE_HZ, TAPS, default_grid, measure, rig_setup, sweep_plan
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.storage.bank.reading import open_bank

Float64Array = NDArray[np.float64]

NIGHT = 1500


def measuring_times(*, quick: bool = False) -> list[Entry]:
    """Error of a campaign against its hours: length and number of sweeps, one after another and all at once."""
    # With the converter's rounding this leaves sequential capture at the -60 dB of the comparison.
    settings = VirtualSettings(dropout_probability=0.0, noise_v=1.2e-4)
    positions = 3 if quick else 12
    sequential = [(s, n) for s in (0.5, 1.0, 2.0) for n in (1, 3)] if not quick else [(0.5, 1), (1.0, 3)]
    schedules: list[tuple[str, dict[str, Any]]] = [
        *(("sequential", {"sweep_s": sweep_s, "averages": averages}) for sweep_s, averages in sequential),
        *(("staggered", {"periods": periods}) for periods in ((1, 2) if quick else (1, 2, 4, 8))),
    ]
    points = []
    for method, parameters in schedules:
        night = _night(settings, positions, staggered=method == "staggered", **parameters)
        points.append(
            Entry(
                work=f"measuring {NIGHT} x 20 responses, {positions} positions of it tried",
                method=method, parameters=parameters, error=10 ** (night["median_db"] / 20), figures=night,
            )
        )  # fmt: skip
    return points


def _night(settings: VirtualSettings, positions: int, **schedule: Any) -> dict[str, float]:
    """Measure some positions of the campaign, evenly spread, through the engine into a bank."""
    rig = VirtualRig(settings)
    rows = np.linspace(0, NIGHT - 1, positions).round().astype(np.int64)
    plan = sweep_plan(default_grid(rig)[rows], rig, **schedule)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "night.h5"
        setup = rig_setup(rig)
        began_s = setup.instruments.clock.now_s()
        measure(path, plan, setup)
        took_s = setup.instruments.clock.now_s() - began_s
        with open_bank(path) as bank:
            green = np.stack([bank.green(row) for row in range(positions)])
    error_db = _errors_db(rig, plan, green)
    # Commits and other overhead that the rig's clock does not see, as the plan estimates them.
    planned_s = max(took_s / positions, plan.position_s(setup))
    median_db, worst_tenth_db = np.percentile(error_db, [50, 90]).tolist()
    return {"hours": NIGHT * planned_s / 3600, "median_db": median_db, "worst_tenth_db": worst_tenth_db}


def _errors_db(rig: VirtualRig, plan: Plan, green: NDArray[np.generic]) -> Float64Array:
    length = scipy.fft.next_fast_len(2 * TAPS, real=True)
    hertz = np.fft.rfftfreq(length, 1 / RATE_HZ)
    inside = np.flatnonzero((hertz >= BAND_HZ[0]) & (hertz <= BAND_HZ[1]))
    band = slice(int(inside[0]), int(inside[-1]) + 1)
    found = []
    for row, here in enumerate(plan.position_mm):
        true = rig.truth_spectra(here[None], TAPS, length, band, RATE_HZ)[0]
        wrong = scipy.fft.rfft(green[row], length)[:, band] - true
        found.append(20 * np.log10(np.linalg.norm(wrong, axis=1) / np.linalg.norm(true, axis=1)))
    return np.stack(found)
