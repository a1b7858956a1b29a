"""Drift during a campaign, and going on with what is not the same any more."""

from dataclasses import asdict
from datetime import UTC, datetime, timedelta

import pytest

from tests.lab_files import change_text
from tests.system.captures import answered, events_of, held
from tests.system.conftest import with_faults
from wavefocus.__main__ import run
from wavefocus.campaign.sidecar_files import read_drift, session_failure, unvouched_rows
from wavefocus.drivers.protocols import DeviceIdentity

DRIFT = "\n[drift]\nevery_positions = 2\n"
LOUDER = 'role = "recorder"\noperation = "read"\nkind = "drift"\nlevel_db = -6.0\npurpose = "sentinel"'


def _with_drift(lab):
    change_text(lab / "run.toml", "[virtual]", f"{DRIFT}\n[virtual]")


def _capture(lab, bank, *more):
    return run(["capture", str(lab / "run.toml"), "--bank", str(bank), "--json", *more])


def test_drift_that_a_repeat_does_not_confirm_is_noted_and_the_campaign_goes_on(lab, measured, capsys):
    _with_drift(lab)
    with_faults(lab, LOUDER)
    bank = lab / "plate.h5"
    assert _capture(lab, bank) == 0
    looks = events_of(capsys.readouterr().out, "drift")
    pair = [(0, "run", "stop"), (0, "repeat", "steady")]
    assert [(one["position"], one["occasion"], one["verdict"]) for one in looks] == pair * 3
    assert [one.verdict for one in read_drift(bank)] == ["stop", "steady"] * 3
    assert held(bank, "green") == held(measured, "green")  # the bank does not show it


def test_given_drift_during_a_run_then_exit_3_names_the_positions_that_are_suspect(lab, capsys):
    _with_drift(lab)
    # The third measurement of the sentinel is the first one of a resumed session, so strike in the second.
    mend = with_faults(lab, f"{LOUDER}\ncount = 2")
    bank = lab / "plate.h5"
    assert _capture(lab, bank) == 3
    told = capsys.readouterr()
    last = told.err.splitlines()[-1]
    assert "sentinel position 0 has changed during the run (level changed)" in last
    assert f"wavefocus remeasure {bank} --positions 1 and resume" in last
    assert "--accept-drift" in last
    assert events_of(told.out, "drift")[-1]["suspect"] == [1]
    assert events_of(told.out, "session_ended")[-1]["failure"] == "drift"
    failure, reason = session_failure(bank, datetime.now(UTC) - timedelta(minutes=5))
    assert failure == "drift"
    assert "level changed" in reason
    assert "wavefocus" not in reason  # the window says in its own words what to press
    assert "--" not in reason
    assert session_failure(bank, datetime.now(UTC) + timedelta(minutes=5)) == ("", "")
    assert held(bank) == [1, 4, 0, 0, 0, 0]
    assert run(["status", str(bank)]) == 0
    assert "--positions 1" in capsys.readouterr().out
    assert answered(capsys, "status", bank)["suspect_positions"] == "1"
    # Accepted on purpose, it is told and goes on.
    assert _capture(lab, bank, "--accept-drift") == 0
    assert "stop" in [one["verdict"] for one in events_of(capsys.readouterr().out, "drift")]
    mend()
    assert _capture(lab, bank) == 0
    capsys.readouterr()


CALIBRATION = """
format = "wavefocus-calibration"
format_version = 1
made = 2026-01-{day:02d}T12:00:00+00:00
software = "wavefocus"
rig = "three coils"

[inputs]
at = 2026-01-{day:02d}T12:00:00+00:00
device = "{device}"
identity = {{ maker = "{maker}", product = "{product}", serial = "{serial}" }}
inter_channel_delay_s = {delay_s}
"""

VIRTUAL = DeviceIdentity("wavefocus", "virtual recorder")


def _calibrate(lab, name, day, delay_s, device=VIRTUAL):
    text = CALIBRATION.format(day=day, delay_s=delay_s, device=device, **asdict(device))
    (lab / name).write_text(text, encoding="utf-8")
    rig = (lab / "rig.toml").read_text(encoding="utf-8").partition("\n[calibration]")[0]
    table = f'\n[calibration]\nfile = "{name}"\nstale_after_days = 100000.0\n'
    (lab / "rig.toml").write_text(rig + table, encoding="utf-8")


LOST = 'role = "recorder"\noperation = "read"\nkind = "lost"\nposition = 3\npurpose = "capture"'


def test_a_calibration_of_another_device_or_another_one_is_refused_until_accepted(lab, capsys):
    bank = lab / "plate.h5"

    def refused(*command):
        before = bank.read_bytes()
        capsys.readouterr()
        assert run([*map(str, command)]) == 2
        assert bank.read_bytes() == before
        return capsys.readouterr().err.strip().splitlines()

    _calibrate(lab, "old.toml", 1, 5e-6, DeviceIdentity("NI", "USB-6211", "0123ABCD"))
    mend = with_faults(lab, LOST)
    assert _capture(lab, bank) == 3  # an empty bank has no rows of the other device yet: it is only warned of
    assert "inputs measured on another device" in capsys.readouterr().err
    told = refused("resume", bank)[-1]
    assert "inputs measured on another device (NI USB-6211, serial number 0123ABCD)" in told
    assert "--accept-calibration" in told
    assert run(["remeasure", str(bank), "--positions", "1", "--accept-calibration"]) == 0
    _calibrate(lab, "new.toml", 2, 6e-6)
    mend()
    (told,) = refused("capture", lab / "run.toml", "--bank", bank)
    assert all(words in told for words in ("old.toml of 2026-01-01", "new.toml of 2026-01-02", "--accept-calibration"))
    assert _capture(lab, bank, "--accept-calibration") == 0
    assert "goes on with the calibration new.toml" in capsys.readouterr().err
    assert held(bank) == [1] * 6


LASTING = 'role = "recorder"\noperation = "read"\nkind = "drift"\nlevel_db = {level_db}\ncount = 1000\n'


def test_another_gain_from_some_position_on_is_suspect_until_measured_again(lab, capsys):
    fault = LASTING.format(level_db=1.0)
    mend = with_faults(lab, f'{fault}purpose = "sentinel"', *(f"{fault}position = {one}" for one in (3, 4, 5)))
    bank = lab / "plate.h5"
    assert _capture(lab, bank) == 0
    told = capsys.readouterr()
    # The change came after the last measurement of the sentinel, so that all since then are suspect.
    assert held(bank) == [1, 4, 4, 4, 4, 4]
    assert events_of(told.out, "drift")[-1]["suspect"] == [1, 2, 3, 4, 5]
    assert "suspect" in told.err.splitlines()[-1]
    assert ": 1-5;" in told.err.splitlines()[-1]
    assert run(["check", str(bank)]) == 1
    assert "positions 1-5 are suspect" in capsys.readouterr().out
    # Nothing is called valid as long as the gain is another one.
    assert run(["remeasure", str(bank)]) == 0
    assert held(bank) == [1, 4, 4, 4, 4, 4]
    mend()
    assert _capture(lab, bank) == 0
    assert held(bank) == [1] * 6


@pytest.mark.parametrize("level_db", [1.0, pytest.param(6.0, marks=pytest.mark.nightly)])
def test_a_session_ended_before_its_sentinel_is_marked_by_the_next_one(lab, capsys, level_db):
    bank = lab / "plate.h5"
    fault = LASTING.format(level_db=level_db)
    mend = with_faults(lab, f"{fault}position = 2", LOST)
    assert _capture(lab, bank) == 3
    assert held(bank) == [1, 1, 1, 0, 0, 0]
    assert unvouched_rows(bank) == (0, 1, 2, 3)
    # Nothing vouches for what lies between the last look at the sentinel and the one that finds another gain.
    mend()
    mend = with_faults(lab, f'{fault}purpose = "sentinel"', *(f"{fault}position = {one}" for one in (3, 4, 5)))
    capsys.readouterr()
    assert _capture(lab, bank) == (3 if level_db > 3 else 0)
    looks = events_of(capsys.readouterr().out, "drift")
    assert [(one["occasion"], one["suspect"]) for one in looks[:2]] == [("resume", []), ("repeat", [1, 2])]
    assert held(bank)[:3] == [1, 4, 4]
    assert run(["check", str(bank)]) == 1
    mend()
    assert run(["remeasure", str(bank)]) == 0
    assert _capture(lab, bank) == 0
    assert held(bank) == [1] * 6
    # A steady sentinel vouches for what came before it: a later change marks nothing of that.
    assert unvouched_rows(bank) == ()
    with_faults(lab, LASTING.format(level_db=1.0) + 'purpose = "sentinel"')
    assert run(["remeasure", str(bank), "--positions", "5"]) == 0
    assert held(bank)[:5] == [1] * 5
