"""The level of the reference: a record whose loopback is not as loud as it was is never wrong and valid."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import events_of, of_kind, wavefocus
from tests.system.conftest import with_faults

READ = 'role = "recorder"\noperation = "read"\nkind = "faint_reference"\n'
SCHEDULES = ["sequential", "staggered"]


def _as(lab: Path, schedule: str) -> None:
    change_text(lab / "run.toml", "[capture]\n", f'[capture]\nexcitation = "{schedule}"\n')


def _captured(lab: Path, name: str, capsys: pytest.CaptureFixture[str]) -> tuple[Path, list[dict[str, Any]]]:
    bank = lab / name
    assert wavefocus("capture", lab / "run.toml", "--bank", bank, "--json") == 0
    return bank, events_of(capsys.readouterr().out)


def _rows(bank: Path) -> tuple[np.ndarray, np.ndarray]:
    with h5py.File(bank, "r") as file:
        return file["status"][...], file["green"][...].astype(np.float64)


@pytest.mark.parametrize(("schedule", "level_db"), [("sequential", -0.3), ("staggered", 6.0)])
def test_a_faint_reference_in_one_record_of_each_position_is_taken_again(lab, capsys, schedule, level_db):
    _as(lab, schedule)
    quiet, _ = _captured(lab, "quiet.h5", capsys)
    faults = [f"{READ}position = {row}\nrecord = {'0' if schedule == 'staggered' else row % 3}" for row in range(6)]
    with_faults(lab, *(f"{one}\nlevel_db = {level_db}" for one in faults))
    bank, events = _captured(lab, "faint.h5", capsys)
    assert {tuple(one["defects"]) for one in of_kind(events, "position_repeated")} == {("reference level",)}
    status, green = _rows(bank)
    _, right = _rows(quiet)
    assert list(status) == [1] * 6
    assert np.linalg.norm(green - right) < 2e-2 * np.linalg.norm(right)  # the noise of both


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_reference_that_stays_faint_then_position_is_poor_and_its_level_is_named(lab, capsys, schedule):
    _as(lab, schedule)
    with_faults(lab, f"{READ}position = 0\nrecord = 0\ncount = 99\nlevel_db = -0.3")
    bank, events = _captured(lab, "plate.h5", capsys)
    told = next(one for one in of_kind(events, "position_committed") if one["position"] == 0)
    assert told["defects"] == ["reference level"]
    assert "0.30 dB below" in str(told["reason"])
    assert told["moved_mm"] == [0.0, 0.0]
    assert list(_rows(bank)[0]) == [4] + [1] * 5


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_reference_that_changes_within_its_calibration_is_refused(lab, capsys, schedule):
    _as(lab, schedule)
    records = 3 if schedule == "sequential" else 1
    with_faults(lab, f"{READ}at_call = {2 * records + 2}\ncount = 999\nlevel_db = -0.2")
    bank, events = _captured(lab, "plate.h5", capsys)
    assert list(_rows(bank)[0]) == [1, 1, 4, 4, 4, 4]
    assert {tuple(one["defects"]) for one in of_kind(events, "position_committed")} == {
        (),
        ("reference level",),
    }
    with h5py.File(bank, "r") as file:
        assert file["quality/reference_db"][...] == pytest.approx([0.0, 0.0, -0.2, -0.2, -0.2, -0.2], abs=0.01)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_reference_off_in_every_record_stops_capture_early_and_says_why(lab, capsys, schedule):
    _as(lab, schedule)
    with_faults(lab, f'{READ}purpose = "capture"\ncount = 999\nlevel_db = -0.54')
    assert wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 3
    last = capsys.readouterr().err.splitlines()[-1]
    assert "every record" in last
    assert "0.54 dB below its calibration" in last
    assert "wavefocus doctor" in last
    assert list(_rows(lab / "plate.h5")[0]) == ([4] if schedule == "sequential" else [4, 4]) + [0] * (
        5 if schedule == "sequential" else 4
    )
