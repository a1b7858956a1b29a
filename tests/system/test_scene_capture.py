"""Captures of some positions: those of a scene, and those measured again."""

import json

import h5py
import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import wavefocus
from tests.system.conftest import with_faults


@pytest.fixture
def far(lab):
    """The lab, with two positions that are near to nothing of the scene."""
    with (lab / "positions.csv").open("a", encoding="utf-8") as file:
        file.write("0,40\n4,40\n")
    change_text(lab / "scene.toml", "limit_v = 1.0", 'limit_v = 1.0\ninterpolation = "nearest"')
    return lab


def _measured(bank):
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


READ = 'role = "recorder"\noperation = "read"\nposition = 2\n'


def _captured(lab, *faults, schedule="sequential"):
    change_text(lab / "run.toml", "[capture]\n", f'[capture]\nexcitation = "{schedule}"\n')
    with_faults(lab, *faults)
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 0
    return lab / "plate.h5"


def _remeasured(bank, capsys, *options):
    """The events of measuring position 2 again, and what status says then."""
    capsys.readouterr()
    assert wavefocus("remeasure", bank, "--positions", "2", "--json", *options) == 0
    events = [json.loads(line) for line in capsys.readouterr().out.splitlines()]
    assert wavefocus("status", bank, "--json") == 0
    return events, json.loads(capsys.readouterr().out)


def _kinds(events):
    kinds = ("position_repeated", "position_committed", "position_kept")
    return [event["event"] for event in events if event["event"] in kinds]


@pytest.mark.parametrize(
    ("schedule", "kind", "level_db", "name"),
    [
        ("sequential", "faint_reference", -0.3, "reference level"),
        ("staggered", "faint_reference", 6.0, "reference level"),
        ("staggered", "drift", -0.3, "neighbours"),
        ("sequential", "drift", -20.0, "neighbours"),
    ],
)
def test_given_a_fault_that_stays_then_the_valid_row_is_kept_and_named(lab, capsys, schedule, kind, level_db, name):
    fault = f'{READ}kind = "{kind}"\nlevel_db = {level_db}\nattempt = 2\ncount = 99\nrecord = 0'
    bank = _captured(lab, fault, schedule=schedule)
    before = bank.read_bytes()
    events, status = _remeasured(bank, capsys)
    assert _kinds(events) == ["position_repeated", "position_repeated", "position_kept"]
    assert next(one for one in events if one["event"] == "position_kept")["defects"] == [name]
    assert [one["position"] for one in status["kept_positions"]] == [2]
    assert bank.read_bytes() == before


def test_given_a_fault_that_passes_then_the_next_try_agrees_and_replaces_the_row(lab, capsys):
    bank = _captured(lab, f'{READ}kind = "drift"\nlevel_db = -0.3\nattempt = 2\nrecord = 1')
    with h5py.File(bank, "r") as file:
        before = file["green"][2]
    events, status = _remeasured(bank, capsys)
    assert _kinds(events) == ["position_repeated", "position_committed"]
    assert status["kept_positions"] == []
    with h5py.File(bank, "r") as file:
        assert np.any(file["green"][2] != before)
        assert file["status"][2] == 1


def test_a_wrong_valid_row_is_replaced_where_asked_for_and_two_attempts_agree(lab, capsys):
    bank = _captured(lab, f'{READ}kind = "drift"\nlevel_db = -0.5\nrecord = 1')
    with h5py.File(bank, "r") as file:
        wrong = file["green"][2]
    assert "position_committed" not in _kinds(_remeasured(bank, capsys)[0])
    events, _ = _remeasured(bank, capsys, "--replace")
    assert _kinds(events) == ["position_repeated", "position_committed"]
    with h5py.File(bank, "r") as file:
        level_db = 20 * np.log10(np.linalg.norm(file["green"][2, 1]) / np.linalg.norm(wrong[1]))
    assert level_db == pytest.approx(0.5, abs=0.1)
