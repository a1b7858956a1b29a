"""Drift during a campaign, and going on with what is not the same any more."""

from datetime import UTC, datetime, timedelta

import pytest

from tests.lab_files import change_text
from tests.system.captures import answered, captured, held, refused, said_by, wavefocus
from tests.system.conftest import with_faults
from wavefocus.campaign.sidecar_files import read_drift, session_failure, unvouched_rows
from wavefocus.config.calibration import FORMAT, FORMAT_VERSION, CalibrationRecord, InputsMeasured, write_calibration
from wavefocus.drivers.protocols import DeviceIdentity

DRIFT = "\n[drift]\nevery_positions = 2\n"
LOUDER = 'role = "recorder"\noperation = "read"\nkind = "drift"\nlevel_db = -6.0\npurpose = "sentinel"'


def _with_drift(lab):
    change_text(lab / "run.toml", "[virtual]", f"{DRIFT}\n[virtual]")


def test_drift_that_a_repeat_does_not_confirm_is_noted_and_the_campaign_goes_on(lab, measured, capsys):
    _with_drift(lab)
    with_faults(lab, LOUDER)
    looks = captured(capsys, lab).of("drift")
    pair = [(0, "run", "stop"), (0, "repeat", "steady")]
    assert [(one["position"], one["occasion"], one["verdict"]) for one in looks] == pair * 3
    assert [drift.verdict for _, drift in read_drift(lab / "plate.h5")] == ["stop", "steady"] * 3
    assert held(lab / "plate.h5", "green") == held(measured, "green")  # the bank does not show it


def test_given_drift_during_a_run_then_exit_3_names_the_positions_that_are_suspect(lab, capsys):
    _with_drift(lab)
    # The third measurement of the sentinel is the first one of a resumed session, so strike in the second.
    mend = with_faults(lab, f"{LOUDER}\ncount = 2")
    bank = lab / "plate.h5"
    told = captured(capsys, lab, code=3)
    assert "sentinel position 0 has changed during the run: level -" in told.last
    assert f"wavefocus remeasure {bank} --positions 1 and resume" in told.last
    assert "--accept-drift" in told.last
    assert told.of("drift")[-1]["suspect"] == [1]
    assert told.of("session_ended")[-1]["failure"] == "drift"
    failure, reason = session_failure(bank, datetime.now(UTC) - timedelta(minutes=5))
    assert failure == "drift"
    assert "has changed during the run: level" in reason
    assert "wavefocus" not in reason  # the window says in its own words what to press
    assert "--" not in reason
    assert session_failure(bank, datetime.now(UTC) + timedelta(minutes=5)) == ("", "")
    assert held(bank) == [1, 4, 0, 0, 0, 0]
    assert "--positions 1" in said_by(capsys, "status", bank).out
    assert answered(capsys, "status", bank)["suspect_positions"] == "1"
    # Accepted on purpose, it is told and goes on.
    assert "stop" in [one["verdict"] for one in captured(capsys, lab, "--accept-drift").of("drift")]
    accepted = held(bank)
    captured(capsys, lab)  # what was accepted at its end is not marked by the same command later
    assert held(bank) == accepted
    mend()
    captured(capsys, lab)


VIRTUAL = DeviceIdentity("wavefocus", "virtual recorder")


def _calibrate(lab, name, day, delay_s, device=VIRTUAL):
    """Have the lab's rig file name a calibration of a day in January."""
    at = datetime(2026, 1, day, 12, tzinfo=UTC)
    inputs = InputsMeasured(at=at, device=str(device), identity=device, inter_channel_delay_s=delay_s)
    about = {"format": FORMAT, "format_version": FORMAT_VERSION, "software": "wavefocus", "rig": "three coils"}
    write_calibration(lab / name, CalibrationRecord(made=at, inputs=inputs, **about))
    rig = (lab / "rig.toml").read_text(encoding="utf-8").partition("\n[calibration]")[0]
    table = f'\n[calibration]\nfile = "{name}"\nstale_after_days = 100000.0\n'
    (lab / "rig.toml").write_text(rig + table, encoding="utf-8")


LOST = 'role = "recorder"\noperation = "read"\nkind = "lost"\nposition = 3\npurpose = "capture"'


def test_a_calibration_of_another_device_or_another_one_is_refused_until_accepted(lab, capsys):
    bank = lab / "plate.h5"
    _calibrate(lab, "old.toml", 1, 5e-6, DeviceIdentity("NI", "USB-6211", "0123ABCD"))
    mend = with_faults(lab, LOST)
    # An empty bank has no rows of the other device yet: it is only warned of.
    assert "inputs measured on another device" in captured(capsys, lab, code=3).err
    before = bank.read_bytes()
    told = refused(capsys, "resume", bank)
    assert bank.read_bytes() == before
    assert "inputs measured on another device (NI USB-6211, serial number 0123ABCD)" in told
    assert "--accept-calibration" in told
    assert wavefocus("remeasure", bank, "--positions", "1", "--accept-calibration") == 0
    _calibrate(lab, "new.toml", 2, 6e-6)
    mend()
    before = bank.read_bytes()
    told = refused(capsys, "capture", lab / "run.toml", "--bank", bank)
    assert bank.read_bytes() == before
    assert all(words in told for words in ("old.toml of 2026-01-01", "new.toml of 2026-01-02", "--accept-calibration"))
    assert "goes on with the calibration new.toml" in captured(capsys, lab, "--accept-calibration").err
    assert held(bank) == [1] * 6


LASTING = 'role = "recorder"\noperation = "read"\nkind = "drift"\nlevel_db = {level_db}\ncount = 1000\n'


def test_another_gain_from_some_position_on_is_suspect_until_measured_again(lab, capsys):
    fault = LASTING.format(level_db=1.0)
    mend = with_faults(lab, f'{fault}purpose = "sentinel"', *(f"{fault}position = {one}" for one in (3, 4, 5)))
    bank = lab / "plate.h5"
    told = captured(capsys, lab)
    # The change came after the last measurement of the sentinel, so that all since then are suspect.
    assert held(bank) == [1, 4, 4, 4, 4, 4]
    assert told.of("drift")[-1]["suspect"] == [1, 2, 3, 4, 5]
    assert "suspect" in told.last
    assert ": 1-5;" in told.last
    assert "positions 1-5 are suspect" in said_by(capsys, "check", bank, code=1).out
    # Nothing is called valid as long as the gain is another one.
    assert wavefocus("remeasure", bank) == 0
    assert held(bank) == [1, 4, 4, 4, 4, 4]
    mend()
    captured(capsys, lab)
    assert held(bank) == [1] * 6


@pytest.mark.parametrize("level_db", [1.0, pytest.param(6.0, marks=pytest.mark.nightly)])
def test_a_session_ended_before_its_sentinel_is_marked_by_the_next_one(lab, capsys, level_db):
    bank = lab / "plate.h5"
    fault = LASTING.format(level_db=level_db)
    mend = with_faults(lab, f"{fault}position = 2", LOST)
    captured(capsys, lab, code=3)
    assert held(bank) == [1, 1, 1, 0, 0, 0]
    assert unvouched_rows(bank, 6) == (0, 1, 2, 3)
    # Nothing vouches for what lies between the last look at the sentinel and the one that finds another gain.
    mend()
    mend = with_faults(lab, f'{fault}purpose = "sentinel"', *(f"{fault}position = {one}" for one in (3, 4, 5)))
    looks = captured(capsys, lab, code=3 if level_db > 3 else 0).of("drift")
    assert [(one["occasion"], one["suspect"]) for one in looks[:2]] == [("resume", []), ("repeat", [1, 2])]
    assert held(bank)[:3] == [1, 4, 4]
    assert wavefocus("check", bank) == 1
    mend()
    assert wavefocus("remeasure", bank) == 0
    captured(capsys, lab)
    assert held(bank) == [1] * 6
    # A steady sentinel vouches for what came before it: a later change marks nothing of that.
    assert unvouched_rows(bank, 6) == ()
    with_faults(lab, LASTING.format(level_db=1.0) + 'purpose = "sentinel"')
    assert wavefocus("remeasure", bank, "--positions", "5") == 0
    assert held(bank)[:5] == [1] * 5
