"""Captures of some positions: those of a scene, and those measured again."""

import json

import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import held, wavefocus
from tests.system.conftest import with_faults


@pytest.fixture
def far(lab):
    """The lab, with two positions that are near to nothing of the scene."""
    with (lab / "positions.csv").open("a", encoding="utf-8") as file:
        file.write("0,40\n4,40\n")
    change_text(lab / "scene.toml", "limit_v = 1.0", 'limit_v = 1.0\ninterpolation = "nearest"')
    return lab


def test_a_scene_then_its_positions_are_measured_once_and_the_rest_as_in_one_night(far, capsys):
    bank, whole, scene = far / "plate.h5", far / "whole.h5", far / "scene.toml"
    for _ in range(2):
        assert wavefocus("capture", far / "run.toml", "--bank", bank, "--scene", scene) == 0
    assert held(bank) == [1] * 6 + [0] * 2
    told = capsys.readouterr().err
    assert "the other 2 are left" in told
    assert told.count("all 6 positions that are needed are in the bank") == 2
    assert told.count("finished:") == 1
    assert wavefocus("render", scene, "--bank", bank, "--out", far / "drive.h5") == 0
    assert wavefocus("verify", scene, "--bank", bank, "--rig", far / "rig.toml", "--out", far / "verify") in (0, 1)
    assert (far / "verify" / "report.html").exists()
    assert wavefocus("resume", bank) == 0
    assert wavefocus("capture", far / "run.toml", "--bank", whole) == 0
    assert bank.read_bytes() == whole.read_bytes()


def test_given_a_scene_off_the_grid_then_no_bank_is_made(far, capsys):
    change_text(far / "scene.toml", "[8, 0]", "[60, 0]")
    assert wavefocus("capture", far / "run.toml", "--bank", far / "plate.h5", "--scene", far / "scene.toml") == 2
    told = capsys.readouterr().err
    assert "scene.toml" in told
    assert "mm from the nearest position" in told
    assert not (far / "plate.h5").exists()


READ = 'role = "recorder"\noperation = "read"\n'


def _captured(lab, *faults, schedule="sequential"):
    change_text(lab / "run.toml", "[capture]\n", f'[capture]\nexcitation = "{schedule}"\n')
    with_faults(lab, *(READ + fault for fault in faults))
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 0
    return lab / "plate.h5"


def _remeasured(bank, position, capsys, *options):
    """Kinds of events and defects of measuring a position again, and the positions kept by `status` then."""
    capsys.readouterr()
    assert wavefocus("remeasure", bank, "--positions", position, "--json", *options) == 0
    events = [
        event for event in map(json.loads, capsys.readouterr().out.splitlines())
        if event["event"] in ("position_repeated", "position_committed", "position_kept")
    ]  # fmt: skip
    assert wavefocus("status", bank, "--json") == 0
    kept = [one["position"] for one in json.loads(capsys.readouterr().out)["kept_positions"]]
    return [event["event"] for event in events], events[-1]["defects"], kept


@pytest.mark.parametrize(
    ("schedule", "reference_db", "drift_db"), [("sequential", -0.3, -20.0), ("staggered", 6.0, -0.3)]
)
def test_given_faults_that_stay_then_valid_rows_are_kept_and_named(lab, capsys, schedule, reference_db, drift_db):
    stays = "attempt = 2\ncount = 99\nrecord = 0\n"
    faults = (
        f'{stays}position = 2\nkind = "faint_reference"\nlevel_db = {reference_db}',
        f'{stays}position = 4\nkind = "drift"\nlevel_db = {drift_db}',
    )
    bank = _captured(lab, *faults, schedule=schedule)
    before = bank.read_bytes()
    kinds = ["position_repeated", "position_repeated", "position_kept"]
    assert _remeasured(bank, 2, capsys) == (kinds, ["reference level"], [2])
    assert _remeasured(bank, 4, capsys)[:2] == (kinds, ["neighbours"])
    assert bank.read_bytes() == before


def _green(bank):
    return np.array(held(bank, "green"))[2]


def test_given_a_fault_that_passes_then_the_next_try_agrees_and_replaces_the_row(lab, capsys):
    bank = _captured(lab, 'position = 2\nkind = "drift"\nlevel_db = -0.3\nattempt = 2\nrecord = 1')
    before = _green(bank)
    assert _remeasured(bank, 2, capsys) == (["position_repeated", "position_committed"], [], [])
    assert np.any(_green(bank) != before)
    assert held(bank)[2] == 1


def test_a_wrong_valid_row_is_replaced_where_asked_for_and_two_attempts_agree(lab, capsys):
    bank = _captured(lab, 'position = 2\nkind = "drift"\nlevel_db = -0.5\nrecord = 1')
    wrong = _green(bank)
    assert "position_committed" not in _remeasured(bank, 2, capsys)[0]
    assert _remeasured(bank, 2, capsys, "--replace")[0] == ["position_repeated", "position_committed"]
    level_db = 20 * np.log10(np.linalg.norm(_green(bank)[1]) / np.linalg.norm(wrong[1]))
    assert level_db == pytest.approx(0.5, abs=0.1)
