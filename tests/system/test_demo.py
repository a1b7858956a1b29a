"""The demo: its grids, and the errors that it states."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from wavefocus.__main__ import run
from wavefocus.banks import open_bank
from wavefocus.commands.demo import norms_of_errors
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.rendering.greens.source import GreenArray


def test_given_two_grids_at_once_then_the_demo_is_refused_and_writes_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(["demo", "--quick", "--coarse", "--out", str(tmp_path / "out")]) == 2
    assert "--coarse" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()


def test_given_a_known_error_of_some_places_then_it_is_stated() -> None:
    rig = VirtualRig(VirtualSettings())
    places_mm = np.array([[3.0, 4.0], [-21.0, 7.5], [40.0, -12.0]])
    true = np.stack([rig.truth(x_mm, y_mm, 2000) for x_mm, y_mm in places_mm])
    bank = GreenArray(true, places_mm, 10_000.0, band_hz=(20.0, 500.0))
    green = (row * gain for row, gain in zip(true, (1.0, 1.1, 0.99), strict=True))
    wrong, right = norms_of_errors(bank, rig, places_mm, green)
    assert wrong.shape == right.shape == (3, 20)
    assert (wrong[0] < 1e-5 * right[0]).all()
    assert wrong[1] / right[1] == pytest.approx(0.1, rel=1e-3)
    assert wrong[2] / right[2] == pytest.approx(0.01, rel=1e-3)


@pytest.mark.nightly
@pytest.mark.timeout(900)
def test_given_a_coarse_grid_then_the_demo_says_how_wrong_it_is_between_positions(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    assert run(["demo", "--coarse", "--out", str(out)]) == 0
    said = " ".join(capsys.readouterr().err.split())
    assert "by check positions in the scene's band" in said
    assert "by the plate's truth" in said
    with open_bank(out / "plate.h5") as bank:
        assert bank.positions == 258
        assert bank.status.all()
    assert (out / "verify" / "report.html").is_file()
