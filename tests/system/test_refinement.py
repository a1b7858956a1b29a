"""Grids that are refined where the expected error between their positions is largest."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from tests.lab_files import change_text, write_positions
from tests.system.captures import await_event, capture_process
from wavefocus.__main__ import run
from wavefocus.campaign.refinement import ErrorMap, worst_points
from wavefocus.campaign.sidecar_files import read_expected_errors
from wavefocus.storage.bank.origins import origins_of
from wavefocus.storage.bank.reading import open_bank

SQUARE_MM = [[x_mm, y_mm] for y_mm in (-18.0, -6.0, 6.0, 18.0) for x_mm in (-24.0, -12.0, 0.0, 12.0, 24.0)]


@pytest.fixture
def coarse(lab: Path) -> Path:
    """A lab whose run asks for more than its 20 positions, 12 mm apart, can give."""
    text = (lab / "run.toml").read_text(encoding="utf-8")
    text = text.replace("[grid]", "[grid]\nmargin_mm = 55\nrefine_to = 1e-5\nrefine_positions = 5")
    (lab / "run.toml").write_text(text, encoding="utf-8")
    write_positions(lab, SQUARE_MM)
    return lab


def _capture(lab: Path, bank: Path) -> int:
    return run(["capture", str(lab / "run.toml"), "--bank", str(bank)])


def test_given_an_error_that_is_too_large_then_positions_are_added_and_measured(
    coarse: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bank = coarse / "plate.h5"
    assert _capture(coarse, bank) == 0
    told = capsys.readouterr().err
    assert "refine_positions are used up" in told
    with open_bank(bank) as view:
        assert view.positions == 25
        assert view.status.tolist() == [1] * 25
        assert view.verify() == ()
        assert view.position_mm[:20].tolist() == SQUARE_MM
        gaps = np.hypot(*(view.position_mm[20:, None] - view.position_mm[None, :]).transpose(2, 0, 1))
        assert np.sort(gaps, axis=1)[:, 1].min() > 2.0
        assert [origin.rows for origin in origins_of(view)] == ["0-19"]
        assert json.loads(view.run_json)["grid"]["regular_positions"] == 20
    maps = read_expected_errors(bank)
    assert maps["before"]["added"] == 0
    assert maps["after"]["added"] == 5
    assert max(maps["after"]["error"]) < max(maps["before"]["error"])
    # The run file of the coarse grid goes on with it, and so does the bank alone; neither adds more.
    before = bank.read_bytes()
    assert _capture(coarse, bank) == 0
    assert run(["resume", str(bank)]) == 0
    assert bank.read_bytes() == before
    assert run(["check", str(bank)]) == 0


def test_given_a_kill_in_the_middle_of_the_refinement_then_the_bank_ends_as_without_it(coarse: Path) -> None:
    undisturbed, killed = coarse / "undisturbed" / "plate.h5", coarse / "killed" / "plate.h5"
    undisturbed.parent.mkdir()
    killed.parent.mkdir()
    assert _capture(coarse, undisturbed) == 0
    with capture_process(coarse, killed) as child:
        await_event(child, "position_committed", 0)
        for _ in range(21):  # of which one is an added one
            await_event(child, "position_committed", 0)
        child.kill()
    with open_bank(killed) as view:
        assert view.positions == 25
        assert 0 < np.count_nonzero(view.status == 0) < 5
    assert run(["resume", str(killed)]) == 0
    with open_bank(undisturbed) as one, open_bank(killed) as other:
        assert np.array_equal(one.position_mm, other.position_mm)
        assert all(np.array_equal(one.green(row), other.green(row)) for row in range(25))
    assert undisturbed.read_bytes() == killed.read_bytes()


def test_given_kept_recordings_then_they_grow_with_the_bank(coarse: Path) -> None:
    change_text(coarse / "run.toml", "taps = 1000", "taps = 1000\nkeep_raw = true")
    bank = coarse / "plate.h5"
    assert _capture(coarse, bank) == 0
    assert run(["estimate", str(coarse / "plate.raw.h5"), "--bank", str(coarse / "again.h5")]) == 0
    with open_bank(bank) as view, open_bank(coarse / "again.h5") as again:
        assert again.positions == view.positions == 25
        assert np.allclose(again.green(24), view.green(24), atol=1e-6 * np.abs(view.green(24)).max())


@pytest.mark.parametrize(("key", "value"), [("refine_to", "0"), ("refine_to", "2"), ("refine_positions", "-1")])
def test_given_a_wrong_key_then_it_is_named(
    coarse: Path, capsys: pytest.CaptureFixture[str], key: str, value: str
) -> None:
    text = (coarse / "run.toml").read_text(encoding="utf-8")
    (coarse / "run.toml").write_text(
        text.replace("refine_to = 1e-5\nrefine_positions = 5", f"{key} = {value}"), encoding="utf-8"
    )
    assert _capture(coarse, coarse / "plate.h5") == 2
    assert f"grid.{key}" in capsys.readouterr().err


def test_too_few_positions_are_said_by_name(lab: Path, bank: Path, capsys: pytest.CaptureFixture[str]) -> None:
    change_text(lab / "run.toml", "[grid]", "[grid]\nrefine_to = 0.05")
    assert _capture(lab, bank) == 2
    assert "12 measured positions" in capsys.readouterr().err


def test_points_are_taken_from_the_largest_error_down_and_apart() -> None:
    grid_mm = np.array([[x, y] for x in range(0, 50, 10) for y in range(0, 50, 10)], float)
    points_mm = np.array([[x, y] for x in np.arange(0, 41, 2.5) for y in np.arange(0, 41, 2.5)])
    error = np.hypot(points_mm[:, 0], points_mm[:, 1]) / 100
    chosen = worst_points(ErrorMap(points_mm, error), grid_mm, 0.3, 8)
    gaps = np.hypot(*(chosen[:, None] - chosen[None]).transpose(2, 0, 1))
    assert gaps[~np.eye(len(chosen), dtype=bool)].min() >= 7.5
    assert (np.hypot(chosen[:, 0], chosen[:, 1]) > 30).all()
    assert np.hypot(*(chosen[:, None] - grid_mm[None]).transpose(2, 0, 1)).min() > 2.4
    assert len(worst_points(ErrorMap(points_mm, error), grid_mm, 0.6, 8)) == 0
