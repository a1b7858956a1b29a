"""Trials on real drivers: onsets through the loopback of an emulated interface, and a player that goes away in one."""

import pytest

from tests.lab_files import POSITIONS, write_positions
from tests.system.lines import Lines
from tests.system.test_trials import MASKING, TRIALS
from tests.wire.emulated import emulated_instruments, free_port, rig_text
from tests.wire.test_campaign_through_wires import VIRTUAL_RIG, write_run
from wavefocus.__main__ import run
from wavefocus.trials.answers import read_answers

pytestmark = pytest.mark.long


def test_a_player_unplugged_in_a_trial_repeats_it_and_every_onset_is_found(tmp_path):
    (tmp_path / "rig.toml").write_text(rig_text(tmp_path, f"localhost:{free_port()}"), encoding="utf-8")
    (tmp_path / "virtual-rig.toml").write_text(VIRTUAL_RIG, encoding="utf-8")
    write_run(tmp_path, "run.toml", "virtual-rig.toml", averages=1)
    write_positions(tmp_path, POSITIONS)
    assert run(["capture", str(tmp_path / "run.toml"), "--bank", str(tmp_path / "plate.h5")]) == 0
    trials = TRIALS.replace("repetitions = 4", "repetitions = 2").replace("[trials]", "[trials]\nfamiliarise = false")
    (tmp_path / "trials.toml").write_text(trials + MASKING, encoding="utf-8")
    files = [tmp_path / "trials.toml", "--bank", tmp_path / "plate.h5", "--rig", tmp_path / "rig.toml"]
    rest = ["--out", tmp_path / "out", "--participant", "P1", "--lines"]
    with (
        emulated_instruments(tmp_path / "rig.toml") as sides,
        Lines("trials", *files, *rest, environment=sides.environment) as it,
    ):
        away = False
        while (event := it.hear("state", "ended"))["event"] != "ended":
            match event["waiting"], event["note"]:
                case "go_on", _:
                    it.send(order="go_on")
                case "answer", _:
                    it.send(order="answer", choice="left")
                case "playing", "" if event["trial"] == 2:
                    sides.say("unplug player")
                    away = True
                case "playing", _ if away:
                    sides.say("plug player")
                    away = False
        assert event["complete"]
        assert it.end() == 0
    attempts = [row.attempts for row in read_answers(tmp_path / "out")]
    assert attempts[1] > 1
    assert attempts[:1] + attempts[2:] == [1, 1, 1]
