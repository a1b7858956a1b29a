"""What `plan` expects of a schedule, held against what is measured on the virtual rig."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy.signal

from wavefocus.acquisition.judgement import in_band
from wavefocus.acquisition.plan import Plan
from wavefocus.acquisition.plays import measuring_of
from wavefocus.acquisition.setup import Setup, point_at, take_record
from wavefocus.calibration.estimator.schedule_error import expected_error_db
from wavefocus.campaign.blueprint import blueprint_from_files
from wavefocus.config.emulation import Emulation
from wavefocus.drivers.protocols import RecordLabel
from wavefocus.rig.setup import open_setup
from wavefocus.rig.virtual_bench import virtual_rig

POSITIONS = (0, 2, 4)
ACTUATORS = [[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0], [60.0, -50.0], [-60.0, -50.0]]
WITHIN_DB = 1.5


def _measured_db(plan: Plan, setup: Setup, true: np.ndarray) -> float:
    """Median error over positions and actuators."""
    measuring = measuring_of(plan, setup)
    sweep, shares = plan.excitation, []
    for position in POSITIONS:
        point_at(setup, *plan.position_mm[position])
        for attempt in (1, 2):
            takes = [RecordLabel(position, attempt, play.actuator, "trial") for play in measuring.plays]
            recordings = [
                play.cut(take_record(setup, play.signals_v, plan.excitation.sample_rate_hz, take, play.samples))
                for play, take in zip(measuring.plays, takes, strict=True)
            ]
            reference_v, response_v = (np.stack([one.volts[row] for one in recordings]) for row in range(2))
            found = measuring.estimator.estimate(reference_v, response_v, range_v=setup.range_v)
            right, got = (
                in_band(green, sweep.sample_rate_hz, sweep.band_hz) for green in (true[position], found.green)
            )
            shares.append(np.linalg.norm(got - right, axis=1) / np.linalg.norm(right, axis=1))
    return 20 * float(np.log10(np.median(np.concatenate(shares))))


def _response_v(plan: Plan, setup: Setup, green: np.ndarray) -> np.ndarray:
    """What each actuator alone gives while its sweep sounds, in volts, (actuators, samples)."""
    sweep = plan.excitation.base_v()[: plan.excitation.sweep_samples]
    heard = scipy.signal.fftconvolve(green, sweep[None], axes=1)[:, : sweep.size]
    return np.asarray(heard / setup.response_per_volt)


@pytest.mark.parametrize(
    "emulation",
    ["noise_v = 1e-3", "noise_v = 1e-6\nnoise_per_response = 0.02"],
    ids=["noise always there", "noise that grows"],
)
def test_a_model_of_noise_then_sequential_and_staggered_capture_err_as_expected(lab: Path, emulation: str) -> None:
    rig = (lab / "rig.toml").read_text(encoding="utf-8").partition("[actuators]")[0]
    (lab / "rig.toml").write_text(
        f"{rig}[actuators]\nposition_mm = {ACTUATORS}\n[emulation]\n{emulation}\n", encoding="utf-8"
    )
    run = (lab / "run.toml").read_text(encoding="utf-8").replace("noise_v = 1e-4\n", "").replace("1000", "2000")
    run = run.replace("decay_s = 0.1", 'decay_s = 0.2\nexcitation = "staggered"').replace("0.3", "1.0")
    (lab / "run.toml").write_text(run, encoding="utf-8")
    blueprint = blueprint_from_files(lab / "run.toml")
    configuration, staggered = blueprint.configuration, blueprint.plan
    truth = virtual_rig(configuration.rig, configuration.run.virtual)
    true = np.stack([truth.truth(x_mm, y_mm, staggered.taps) for x_mm, y_mm in staggered.position_mm])
    with open_setup(configuration.rig, configuration.run) as setup:
        for plan in (replace(staggered, staggered=None), staggered):
            measured_db = _measured_db(plan, setup, true)
            expected_db = [
                one
                for position in POSITIONS
                for one in _expected_db(plan, configuration.rig.emulation, _response_v(plan, setup, true[position]))
            ]
            assert measured_db == pytest.approx(float(np.median(expected_db)), abs=WITHIN_DB)


def _expected_db(plan: Plan, emulated: Emulation, volts: np.ndarray) -> list[float]:
    """What is expected of each actuator at a position where they give such responses, one at a time."""
    rms_v = np.sqrt(np.mean(volts**2, axis=1))
    # The recorder rounds to steps of its range over 32768.
    always_v = np.hypot(emulated.noise_v or 0.0, 10.0 / 32768 / np.sqrt(12))
    sweep, signal = plan.excitation, plan.staggered
    sounding_s = sweep.averages * sweep.duration_s
    if signal is not None:
        sounding_s = signal.periods * signal.period_samples / sweep.sample_rate_hz
    together_v = rms_v if signal is None else np.full_like(rms_v, np.sqrt(np.sum(rms_v**2)))
    noise_v = np.hypot(always_v, emulated.noise_per_response * together_v)
    return [
        expected_error_db(one_db, sounding_s, 1.0, band_hz=sweep.band_hz, sample_rate_hz=1e4, taps=plan.taps)
        for one_db in 20 * np.log10(rms_v / noise_v)
    ]
