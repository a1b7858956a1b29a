"""A capture for one scene: what it needs and no more; the rest later, in the same bank."""

from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import wavefocus


@pytest.fixture
def far(lab):
    """The lab, with two positions that are near to nothing of the scene."""
    with (lab / "positions.csv").open("a", encoding="utf-8") as file:
        file.write("0,40\n4,40\n")
    change_text(lab / "scene.toml", "limit_v = 1.0", 'limit_v = 1.0\ninterpolation = "nearest"')
    return lab


def _measured(bank: Path) -> list[int]:
    with h5py.File(bank) as file:
        return [int(row) for row in np.flatnonzero(file["status"][:])]


def test_given_a_scene_then_only_its_positions_are_measured_and_it_can_be_verified(far, capsys):
    bank = far / "plate.h5"
    assert wavefocus("capture", far / "run.toml", "--bank", bank, "--scene", far / "scene.toml") == 0
    assert _measured(bank) == [0, 1, 2, 3, 4, 5]
    assert "the other 2 are left" in capsys.readouterr().err
    assert wavefocus("render", far / "scene.toml", "--bank", bank, "--out", far / "drive.h5") == 0
    arguments = ("--bank", bank, "--rig", far / "rig.toml", "--out", far / "verify")
    assert wavefocus("verify", far / "scene.toml", *arguments) in (0, 1)
    assert (far / "verify" / "report.html").exists()


def test_given_the_rest_of_the_night_then_the_bank_ends_as_one_measured_at_once(far):
    parts, whole = far / "parts.h5", far / "whole.h5"
    assert wavefocus("capture", far / "run.toml", "--bank", parts, "--scene", far / "scene.toml") == 0
    assert wavefocus("resume", parts) == 0
    assert wavefocus("capture", far / "run.toml", "--bank", whole) == 0
    assert parts.read_bytes() == whole.read_bytes()


def test_given_a_scene_that_is_measured_already_then_nothing_is_played(far, capsys):
    bank = far / "plate.h5"
    for _ in range(2):
        assert wavefocus("capture", far / "run.toml", "--bank", bank, "--scene", far / "scene.toml") == 0
    told = capsys.readouterr().err
    assert told.count("all 6 positions that are needed are in the bank") == 2
    assert told.count("finished:") == 1


def test_given_a_scene_off_the_grid_then_no_bank_is_made(far, capsys):
    change_text(far / "scene.toml", "[8, 0]", "[60, 0]")
    assert wavefocus("capture", far / "run.toml", "--bank", far / "plate.h5", "--scene", far / "scene.toml") == 2
    told = capsys.readouterr().err
    assert "scene.toml" in told
    assert "mm from the nearest position" in told
    assert not (far / "plate.h5").exists()
