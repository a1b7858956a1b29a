"""The level of the reference: a record whose loopback is not as loud as it was is never wrong and valid."""

from __future__ import annotations

import json
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.system.conftest import with_faults
from wavefocus.__main__ import run

READ = 'role = "recorder"\noperation = "read"\nkind = "faint_reference"\n'
SCHEDULES = ["sequential", "staggered"]


def _wavefocus(*arguments: object) -> int:
    return run([str(argument) for argument in arguments])


def _as(lab: Path, schedule: str) -> None:
    if schedule == "staggered":
        text = (lab / "run.toml").read_text(encoding="utf-8")
        asked = '[capture]\nexcitation = "staggered"\n'
        (lab / "run.toml").write_text(text.replace("[capture]\n", asked), encoding="utf-8")


def _captured(lab: Path, name: str, capsys: pytest.CaptureFixture[str]) -> tuple[Path, list[dict[str, object]]]:
    bank = lab / name
    assert _wavefocus("capture", lab / "run.toml", "--bank", bank, "--json") == 0
    return bank, [json.loads(line) for line in capsys.readouterr().out.splitlines()]


def _rows(bank: Path) -> tuple[np.ndarray, np.ndarray]:
    with h5py.File(bank, "r") as file:
        return file["status"][...], file["green"][...].astype(np.float64)


def _of_kind(events: list[dict[str, object]], kind: str) -> list[dict[str, object]]:
    return [event for event in events if event["event"] == kind]


@pytest.mark.parametrize("schedule", SCHEDULES)
@pytest.mark.parametrize("level_db", [-0.3, 6.0])
def test_a_faint_reference_in_one_record_of_each_position_is_taken_again(
    lab: Path, capsys: pytest.CaptureFixture[str], schedule: str, level_db: float
) -> None:
    _as(lab, schedule)
    quiet, _ = _captured(lab, "quiet.h5", capsys)
    faults = [f"{READ}position = {row}\nrecord = {'0' if schedule == 'staggered' else row % 3}" for row in range(6)]
    with_faults(lab, *(f"{one}\nlevel_db = {level_db}" for one in faults))
    bank, events = _captured(lab, "faint.h5", capsys)
    assert {tuple(one["defects"]) for one in _of_kind(events, "position_repeated")} == {("reference level",)}  # type: ignore[arg-type]
    status, green = _rows(bank)
    _, right = _rows(quiet)
    assert list(status) == [1] * 6
    assert np.linalg.norm(green - right) < 2e-2 * np.linalg.norm(right)  # the noise of both


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_reference_that_stays_faint_then_position_is_poor_and_its_level_is_named(
    lab: Path, capsys: pytest.CaptureFixture[str], schedule: str
) -> None:
    _as(lab, schedule)
    with_faults(lab, f"{READ}position = 0\nrecord = 0\ncount = 99\nlevel_db = -0.3")
    bank, events = _captured(lab, "plate.h5", capsys)
    told = next(one for one in _of_kind(events, "position_committed") if one["position"] == 0)
    assert told["defects"] == ["reference level"]
    assert "0.30 dB below" in str(told["reason"])
    assert told["moved_mm"] == [0.0, 0.0]
    assert list(_rows(bank)[0]) == [4] + [1] * 5


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_reference_that_changes_within_its_calibration_is_refused(
    lab: Path, capsys: pytest.CaptureFixture[str], schedule: str
) -> None:
    _as(lab, schedule)
    records = 3 if schedule == "sequential" else 1
    with_faults(lab, f"{READ}at_call = {2 * records + 2}\ncount = 999\nlevel_db = -0.2")
    bank, events = _captured(lab, "plate.h5", capsys)
    assert list(_rows(bank)[0]) == [1, 1, 4, 4, 4, 4]
    assert {tuple(one["defects"]) for one in _of_kind(events, "position_committed")} == {(), ("reference level",)}  # type: ignore[arg-type]
    with h5py.File(bank, "r") as file:
        assert file["quality/reference_db"][...] == pytest.approx([0.0, 0.0, -0.2, -0.2, -0.2, -0.2], abs=0.01)


@pytest.mark.parametrize("schedule", SCHEDULES)
def test_a_reference_off_in_every_record_stops_capture_early_and_says_why(
    lab: Path, capsys: pytest.CaptureFixture[str], schedule: str
) -> None:
    _as(lab, schedule)
    with_faults(lab, f'{READ}purpose = "capture"\ncount = 999\nlevel_db = -0.54')
    assert _wavefocus("capture", lab / "run.toml", "--bank", lab / "plate.h5") == 3
    last = capsys.readouterr().err.splitlines()[-1]
    assert "every record" in last
    assert "0.54 dB below its calibration" in last
    assert "wavefocus doctor" in last
    assert list(_rows(lab / "plate.h5")[0]) == ([4] if schedule == "sequential" else [4, 4]) + [0] * (
        5 if schedule == "sequential" else 4
    )
