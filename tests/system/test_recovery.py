"""Instruments that go away in the middle of a campaign or a scan, through the commands on the virtual rig."""

import contextlib
import json
import signal
import subprocess
import sys

import pytest

from tests.system.captures import Listener, capture, empty_bank, events_of, states_of
from tests.system.conftest import with_faults
from wavefocus.__main__ import run

UNPLUGGED = {
    "recorder in a record": 'role = "recorder"\noperation = "read"\nposition = 2\nrecord = 2',
    "player before it plays": 'role = "player"\noperation = "play"\nposition = 0\nrecord = 0',
    "player while it plays": 'role = "player"\noperation = "wait"\nposition = 5\nrecord = 1',
    "mirror before a move": 'role = "mirror"\noperation = "move_to"\nat_call = 5',
    "mirror on its way": 'role = "mirror"\noperation = "wait_settled"\nat_call = 4',
}


@pytest.mark.parametrize("fault", UNPLUGGED.values(), ids=UNPLUGGED.keys())
def test_instrument_unplugged_and_plugged_in_then_bank_is_that_of_quiet_night(lab, measured, fault, capsys):
    disturbed = empty_bank(lab, "disturbed.h5")
    with_faults(lab, f'{fault}\nkind = "unplugged"\ntries = 3')
    capsys.readouterr()
    assert capture(lab, disturbed) == 0
    told = capsys.readouterr().out
    tries = events_of(told, "reconnect_tried")
    assert [one["number"] for one in tries] == [1, 2, 3, 4]
    assert [one["next_try_s"] for one in tries] == [1.0, 2.0, 4.0, None]
    assert [one["connected"] for one in tries] == [False, False, False, True]
    assert "recovering" in states_of(told)
    assert states_of(told)[-2:] == ["running", "finished"]
    assert events_of(told, "fault")[0]["retried"] is True
    assert disturbed.read_bytes() == measured.read_bytes()
    assert run(["check", str(disturbed)]) == 0


def test_an_instrument_that_stays_away_then_exit_3_tells_how_long_and_how_to_go_on(lab, measured, capsys):
    bank = empty_bank(lab, "plate.h5")
    sound = (lab / "run.toml").read_text(encoding="utf-8")
    with_faults(lab, 'role = "mirror"\noperation = "move_to"\nkind = "lost"\nat_call = 6')
    capsys.readouterr()
    assert capture(lab, bank) == 3
    told = capsys.readouterr()
    last = told.err.splitlines()[-1]
    assert "mirror" in last
    assert "not back within 10 min 00 s" in last
    assert "check its cable and its power" in last
    assert last.endswith(f"go on with: wavefocus resume {bank} --rig {lab / 'rig.toml'}")
    assert "Traceback" not in told.err
    waits = [one["next_try_s"] for one in events_of(told.out, "reconnect_tried")]
    assert waits[:7] == [1.0, 2.0, 4.0, 8.0, 16.0, 30.0, 30.0]
    assert waits[-1] is None
    assert events_of(told.out, "session_ended")[0]["state"] == "failed"
    (lab / "run.toml").write_text(sound, encoding="utf-8")
    assert capture(lab, bank) == 0
    assert bank.read_bytes() == measured.read_bytes()


def test_status_while_instrument_is_waited_for_then_it_says_so_since_when_and_which(lab):
    with_faults(lab, 'role = "player"\noperation = "wait"\nkind = "unplugged"\nposition = 2\nrecord = 0\ntries = 2')
    bank = lab / "plate.h5"
    answers: list[subprocess.CompletedProcess[str]] = []

    def ask():
        for more in (["--json"], []):
            command = [sys.executable, "-m", "wavefocus", "status", str(bank), *more]
            answers.append(subprocess.run(command, capture_output=True, text=True, check=True))

    listener = Listener(('"event": "reconnect_tried"', ask))
    with contextlib.redirect_stdout(listener):
        assert capture(lab, bank) == 0
    facts = json.loads(answers[0].stdout)
    assert facts["state"] == "recovering"
    recovering = next(one for one in events_of(listener.told, "state_changed") if one["state"] == "recovering")
    assert facts["state_since"][:19] == str(recovering["at"])[:19]
    assert facts["recovering"]["instrument"] == "virtual player"
    assert facts["recovering"]["tries"] == 1
    assert facts["recovering"]["next_try_s"] == 1.0
    assert facts["recovering"]["gives_up_s"] == 600.0
    assert "is recovering since" in answers[1].stdout
    assert "virtual player" in answers[1].stdout


def test_given_a_lost_instrument_then_all_that_still_answers_is_put_to_rest(lab, capsys):
    with_faults(
        lab,
        'role = "player"\noperation = "play"\nkind = "lost"\nposition = 1\nrecord = 0',
        'role = "mirror"\noperation = "park"\nkind = "timeout"\nat_call = 1',
    )
    assert run(["capture", str(lab / "run.toml"), "--bank", str(lab / "plate.h5")]) == 3
    told = capsys.readouterr().err
    assert "on the way out: virtual player: muting" in told
    assert "on the way out: virtual mirror: parking" in told
    assert "player" in told.splitlines()[-1]


@pytest.mark.parametrize("interrupts", [1, 2])
def test_ctrl_c_while_an_instrument_is_waited_for_stops_and_can_be_resumed(lab, measured, interrupts, capsys):
    bank = empty_bank(lab, "plate.h5")
    sound = (lab / "run.toml").read_text(encoding="utf-8")
    with_faults(lab, 'role = "player"\noperation = "play"\nkind = "lost"\nposition = 2\nrecord = 1')

    def press():
        for _ in range(interrupts):
            signal.raise_signal(signal.SIGINT)

    listener = Listener(('"event": "reconnect_tried"', press))
    with contextlib.redirect_stdout(listener):
        assert capture(lab, bank) == 130
    assert len(events_of(listener.told, "reconnect_tried")) == 1
    assert events_of(listener.told, "session_ended")[0]["state"] == "stopped"
    assert f"wavefocus resume {bank}" in capsys.readouterr().err
    (lab / "run.toml").write_text(sound, encoding="utf-8")
    assert capture(lab, bank) == 0
    assert bank.read_bytes() == measured.read_bytes()
