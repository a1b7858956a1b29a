"""A pilot of 30 positions recommends the spacing of the grid."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.lab_files import ACTUATORS
from wavefocus.__main__ import run
from wavefocus.acquisition.grid import read_positions_file, surface_grid
from wavefocus.benchmarks.rig_bank import RATE_HZ, TAPS, true_bank
from wavefocus.calibration.coarse_grid.rim_waves import RimWaves
from wavefocus.calibration.numerics import transform_at
from wavefocus.campaign.blueprint import blueprint_from_files
from wavefocus.campaign.pilot import JUDGED_SEED, pilot_result, spread_positions
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.ledger import PointRecord
from wavefocus.storage.bank.writer import BankWriter, create_bank

MARGIN_MM = 45.0
BAND_HZ = (60.0, 160.0)
"""Long waves need few sources along the rim, which makes the tests quick."""


@pytest.fixture
def pilot_lab(lab: Path) -> Path:
    """A lab whose run asks for a lattice."""
    text = (lab / "run.toml").read_text(encoding="utf-8")
    text = text.replace('positions_file = "positions.csv"', f"margin_mm = {MARGIN_MM}\nrefine_to = 0.05")
    (lab / "run.toml").write_text(text, encoding="utf-8")
    return lab


@pytest.fixture(scope="module")
def rig() -> VirtualRig:
    return VirtualRig(VirtualSettings(actuator_mm=tuple((x, y) for x, y in ACTUATORS)))


def _write_bank(path: Path, position_mm: np.ndarray, actuator_mm: np.ndarray, values: np.ndarray) -> Path:
    create_bank(path, BankHeader(RATE_HZ, TAPS, BAND_HZ, position_mm, actuator_mm, "{}", "{}", "0" * 64, "test"))
    quality = np.zeros(len(actuator_mm), dtype=np.float32)
    with BankWriter.open(path, plan_sha256="0" * 64) as writer:
        for row, green in enumerate(values):
            writer.commit(row, green, PointRecord(1, 1, quality, quality, quality, quality))
    return path


def _planned(lab: Path, capsys: pytest.CaptureFixture[str], bank: Path) -> dict[str, Any]:
    capsys.readouterr()
    assert run(["plan", str(lab / "run.toml"), "--pilot", str(bank), "--json"]) == 0
    return json.loads(capsys.readouterr().out)["pilot"]


def test_positions_of_a_pilot_are_spread_over_the_surface_and_the_same_again(
    pilot_lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    files = [pilot_lab / "one.csv", pilot_lab / "two.csv"]
    for file in files:
        assert run(["plan", str(pilot_lab / "run.toml"), "--pilot-positions", str(file)]) == 0
    assert files[0].read_bytes() == files[1].read_bytes()
    outline = blueprint_from_files(pilot_lab / "run.toml").configuration.rig.surface.outline
    position_mm = read_positions_file(files[0], outline)
    assert position_mm.shape == (30, 2)
    assert outline.contains(position_mm, MARGIN_MM - 1e-6).all()
    # No part of the surface is far from all of them, and the mirror's way is far shorter than in random order.
    gaps_mm = np.hypot(*(surface_grid(outline, MARGIN_MM, 4.0)[:, None] - position_mm).transpose(2, 0, 1)).min(axis=1)
    assert gaps_mm.max() < 2.5 * np.sqrt(160.0 * 60.0 / 30)
    shuffled_mm = np.random.default_rng(0).permutation(position_mm)
    assert _way_mm(position_mm) < 0.5 * _way_mm(shuffled_mm)
    assert run(["plan", str(pilot_lab / "run.toml"), "--pilot-positions", str(files[0])]) == 2


def _way_mm(position_mm: np.ndarray) -> float:
    return float(np.hypot(*np.diff(position_mm, axis=0).T).sum())


def test_the_forecast_of_a_grid_holds_when_it_is_measured(pilot_lab: Path, rig: VirtualRig) -> None:
    blueprint = blueprint_from_files(pilot_lab / "run.toml")
    outline = rig.settings.outline
    position_mm = spread_positions(outline, MARGIN_MM, 30, 1)
    truth = true_bank(rig, position_mm, -50.0)
    pilot = _write_bank(pilot_lab / "pilot.h5", position_mm, truth.actuator_mm, truth.values)
    found = pilot_result(pilot, blueprint, 4.8, (12.0, 16.0, 20.0))
    assert found.recommended_spacing_mm == 20.0
    assert found.reason == ""
    assert [one.spacing_mm for one in found.forecasts] == [12.0, 16.0, 20.0]
    assert np.all(np.diff([one.hours for one in found.forecasts]) < 0)
    forecast = found.forecasts[1]
    grid_mm = surface_grid(outline, MARGIN_MM, 16.0)
    points_mm = spread_positions(outline, MARGIN_MM, 200, JUDGED_SEED)
    hz = np.linspace(70.0, 150.0, 6)
    model = RimWaves.fit(hz, grid_mm, truth.actuator_mm, _transfer(rig, grid_mm, hz, -50.0))
    true = _transfer(rig, points_mm, hz, None)
    missed = np.linalg.norm(model.values(points_mm) - true, axis=(0, 2)) / np.linalg.norm(true, axis=(0, 2))
    assert forecast.expected_error is not None
    assert 0.4 < np.median(missed) / forecast.expected_error < 2.5
    # A stricter run is told that no spacing reaches what it asks for.
    text = (pilot_lab / "run.toml").read_text(encoding="utf-8").replace("refine_to = 0.05", "refine_to = 1e-6")
    (pilot_lab / "run.toml").write_text(text, encoding="utf-8")
    strict = pilot_result(pilot, blueprint_from_files(pilot_lab / "run.toml"), 4.8, (12.0, 16.0))
    assert (strict.reason, strict.recommended_spacing_mm) == ("not_reached", 12.0)


def _transfer(rig: VirtualRig, position_mm: np.ndarray, hz: np.ndarray, noise_db: float | None) -> np.ndarray:
    values = transform_at(true_bank(rig, position_mm, noise_db).values, hz, RATE_HZ)
    return values.transpose(2, 0, 1).astype(np.complex128)


def test_a_pilot_that_no_wave_explains_recommends_the_finest_grid(
    pilot_lab: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    position_mm = spread_positions(VirtualSettings().outline, MARGIN_MM, 30, 1)
    values = np.random.default_rng(0).standard_normal((30, 3, TAPS)).astype(np.float32)
    found = _planned(pilot_lab, capsys, _write_bank(pilot_lab / "p.h5", position_mm, np.array(ACTUATORS), values))
    assert (found["reason"], found["recommended_spacing_mm"]) == ("not_explained", 4.0)
    assert found["left_out_error_90"] > 0.5
    assert found["forecasts"][0]["expected_error"] > found["refine_to"]


@pytest.mark.parametrize(
    ("count", "moved", "reason"), [(19, 0.0, "too_few_positions"), (30, np.nan, "unknown_actuators")]
)
def test_a_pilot_that_cannot_be_judged_says_why(
    pilot_lab: Path, capsys: pytest.CaptureFixture[str], count: int, moved: float, reason: str
) -> None:
    position_mm = spread_positions(VirtualSettings().outline, MARGIN_MM, count, 1)
    actuator_mm = np.array(ACTUATORS) + moved
    bank = _write_bank(pilot_lab / "p.h5", position_mm, actuator_mm, np.ones((count, 3, TAPS), dtype=np.float32))
    found = _planned(pilot_lab, capsys, bank)
    assert (found["reason"], found["recommended_spacing_mm"]) == (reason, 4.0)
    assert found["forecasts"][0]["spacing_mm"] == 4.0
    assert found["forecasts"][0]["hours"] > 0
    assert found["forecasts"][0]["expected_error"] is None


def test_a_pilot_of_another_rig_is_refused(pilot_lab: Path, capsys: pytest.CaptureFixture[str]) -> None:
    position_mm = spread_positions(VirtualSettings().outline, MARGIN_MM, 30, 1)
    values = np.ones((30, 3, TAPS), dtype=np.float32)
    bank = _write_bank(pilot_lab / "p.h5", position_mm, np.array(ACTUATORS) + 1.0, values)
    assert run(["plan", str(pilot_lab / "run.toml"), "--pilot", str(bank)]) == 2
    assert "actuators" in capsys.readouterr().err
