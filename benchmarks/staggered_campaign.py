"""A staggered campaign beside a sequential one on the virtual rig: hours and errors, and where it does not pay.

The night is that of the paper: 1500 positions, 20 actuators, 20-500 Hz, responses of 200 ms. Hours are those of the
rig's own clock over the positions that were measured, the whole way through the engine into a bank, times the
positions of the night; errors are those of the same positions against the rig's truth.
"""

from __future__ import annotations

import math
import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft
import scipy.signal
from numpy.typing import NDArray

from acquisition.engine.campaign import Campaign
from acquisition.engine.stopping import StopRequest
from acquisition.schedule.plan import Plan
from acquisition.schedule.trial import check_position, run_trial
from benchmarks.rig_bank import BAND_HZ, RATE_HZ, TAPS, default_grid, rig_setup
from calibration.excitation.staggered_signal import StaggeredSignal
from calibration.excitation.sweeps import Excitation
from mocks.virtual.rig import VirtualRig, VirtualSettings
from storage.bank.creation import create_bank
from storage.bank.header import BankHeader
from storage.bank.reading import open_bank
from storage.bank.writer import BankWriter

Float64Array = NDArray[np.float64]

NIGHT = 1500
STAGGER_S = 0.24
MARK_HOURS = 2.2
MARK_ERROR_DB = -61.0
MARK_SKEW_DB = 1.0
SKEW_PPM = 100.0
# With the converter's rounding this leaves sequential capture at the -60 dB of the comparison.
NOISE_V = 1.2e-4
# Rms of a cubic term over that of the response of all actuators together, at the position where the trial is made.
CUBIC = 0.01
# Rms of noise that grows with the response, over the response.
GROWING = 0.01


@dataclass(frozen=True, slots=True)
class Night:
    """What a campaign comes to.

    Parameters
    ----------
    hours : float
        For 1500 positions.
    median_db, worst_db : float
        Relative L2 error in band over all measured pairs; the worst tenth of them begins at `worst_db`.
    positions : int
        How many were measured.
    """

    hours: float
    median_db: float
    worst_db: float
    positions: int


def run(*, quick: bool = False) -> dict[str, Any]:
    """Measure, compare and print.

    Parameters
    ----------
    quick : bool
        Fewer positions.

    Returns
    -------
    dict
        `nights`, `trials` and `marks`.
    """
    positions = 6 if quick else 60
    plain = VirtualSettings(dropout_probability=0.0, noise_v=NOISE_V)
    cubic = _cubic_per_v2(VirtualRig(plain))
    nights = {
        "sequential 3 x 1 s": _night(plain, positions, staggered=False),
        "staggered 240 ms, one period": _night(plain, positions, staggered=True),
        f"staggered, {SKEW_PPM:g} ppm clock skew": _night(
            replace(plain, clock_ppm=SKEW_PPM), positions, staggered=True
        ),
        "staggered, no clock skew": _night(replace(plain, clock_ppm=0.0), positions, staggered=True),
    }
    trials = {
        "additive noise": _trial(plain),
        f"cubic plate, {100 * CUBIC:g} % ({cubic:.3f} u^3 / V^2)": _trial(replace(plain, cubic_per_v2=cubic)),
        "noise that grows with the response (1 %)": _trial(replace(plain, noise_per_response=GROWING)),
    }
    staggered, skewed = nights["staggered 240 ms, one period"], nights[f"staggered, {SKEW_PPM:g} ppm clock skew"]
    still = nights["staggered, no clock skew"]
    marks = {
        f"a staggered night of at most {MARK_HOURS:g} h": staggered.hours <= MARK_HOURS,
        f"its median error at most {MARK_ERROR_DB:g} dB": staggered.median_db <= MARK_ERROR_DB,
        f"within {MARK_SKEW_DB:g} dB at {SKEW_PPM:g} ppm": abs(skewed.median_db - still.median_db) <= MARK_SKEW_DB,
    }
    _print(nights, trials, marks)
    return {
        "nights": {name: _facts(night) for name, night in nights.items()},
        "trials": trials,
        "marks": marks,
    }


def _plan(rig: VirtualRig, rows: NDArray[np.int64] | slice, *, staggered: bool) -> Plan:
    sweep = Excitation(RATE_HZ, *BAND_HZ, 1.0, TAPS / RATE_HZ, 1.0, 3)
    position_mm = default_grid(rig)[rows]
    signal = StaggeredSignal(sweep, rig.settings.actuators, TAPS, round(STAGGER_S * RATE_HZ)) if staggered else None
    actuator_mm = np.asarray(rig.settings.actuator_mm, dtype=np.float64)
    return Plan(position_mm, actuator_mm, np.arange(len(position_mm)), sweep, TAPS, "0" * 64, staggered=signal)


def _night(settings: VirtualSettings, positions: int, *, staggered: bool) -> Night:
    """Measure every so many positions of the night through the engine into a bank."""
    rig = VirtualRig(settings)
    rows = np.linspace(0, NIGHT - 1, positions).round().astype(np.int64)
    plan = _plan(rig, rows, staggered=staggered)
    header = BankHeader(RATE_HZ, TAPS, BAND_HZ, plan.position_mm, plan.actuator_mm, "{}", "{}", plan.sha256, "bench")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "night.h5"
        create_bank(path, header)
        setup = rig_setup(rig)
        began_s = setup.instruments.clock.now_s()
        with BankWriter.open(path) as writer:
            Campaign(plan, setup, writer, lambda event: None, StopRequest()).run()
        took_s = setup.instruments.clock.now_s() - began_s
        with open_bank(path) as bank:
            green = np.stack([bank.green(row) for row in range(positions)])
    error_db = _errors_db(rig, plan, green)
    # What the rig's clock does not see: commits and other overhead, as the plan reckons with them.
    reckoned_s = max(took_s / positions, plan.position_s(setup))
    return Night(NIGHT * reckoned_s / 3600, float(np.median(error_db)), float(np.percentile(error_db, 90)), positions)


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


def _cubic_per_v2(rig: VirtualRig) -> float:
    """The term that is so much of a staggered record; many sweeps together are like a Gaussian signal."""
    plan = _plan(rig, slice(None), staggered=True)
    x_mm, y_mm = plan.position_mm[check_position(plan)]
    sweep = plan.excitation.base_v()[: plan.excitation.sweep_samples]
    alone = scipy.signal.fftconvolve(rig.truth(x_mm, y_mm, TAPS), sweep[None], axes=1)[:, : sweep.size]
    power = float(np.mean(np.square(alone / rig.settings.sensitivity_m_s_per_v), axis=1).sum())
    return CUBIC / (math.sqrt(15) * power)


def _trial(settings: VirtualSettings) -> dict[str, Any]:
    """What the trial before a night says of a plate, and what each schedule really errs there."""
    rig = VirtualRig(settings)
    plan = _plan(rig, slice(None), staggered=True)
    trial = run_trial(plan, rig_setup(rig), 3.0)
    return {
        "reason": trial.verdict.reason,
        "chosen": trial.verdict.chosen.name,
        "hours": trial.verdict.chosen.campaign_s / 3600,
        "candidates": {one.name: [one.campaign_s / 3600, one.error_db] for one in trial.candidates},
    }


def _facts(night: Night) -> dict[str, float]:
    return {
        "hours": night.hours,
        "median_db": night.median_db,
        "worst_tenth_db": night.worst_db,
        "positions": night.positions,
    }


def _print(nights: dict[str, Night], trials: dict[str, dict[str, Any]], marks: dict[str, bool]) -> None:
    print(f"\n{'a night of 1500 x 20':42}{'hours':>8}{'median':>9}{'worst tenth':>13}{'measured':>10}   (error in dB)")
    for name, night in nights.items():
        print(f"{name:42}{night.hours:8.2f}{night.median_db:9.1f}{night.worst_db:13.1f}{night.positions:10d}")
    for plate, trial in trials.items():
        print(f"\n{plate}, as the trial at one position sees it: {trial['reason']}")
        for name, (hours, error_db) in trial["candidates"].items():
            print(f"  {name:46}{hours:8.2f} h{error_db:9.1f} dB{'   <- taken' if name == trial['chosen'] else ''}")
    print()
    for mark, reached in marks.items():
        print(f"{mark}: {'yes' if reached else 'NO'}")


if __name__ == "__main__":
    run()
