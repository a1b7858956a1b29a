"""`wavefocus operate` as a script drives it: orders in, events out, and every way it may end."""

import codecs
import json
import os
import re
import signal
import subprocess
import sys
import time

import pytest

from tests.lab_files import ABSENT_RIG, RIG
from tests.system.captures import said_by
from tests.system.lines import in_process, of_posix, python
from wavefocus.configuration import load_rig
from wavefocus.rendering.scene.model import load_scene
from wavefocus.rig.operation import order_of
from wavefocus.storage.errors import InputError


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "rig.toml").write_text(f"{RIG}[player]\nlimit_v = 3.0\nlimit_rms_v = 1.0\n", encoding="utf-8")
    return tmp_path / "rig.toml"


@pytest.mark.smoke
def test_given_orders_then_each_is_carried_out_and_answered_in_turn(rig):
    def script(operated):
        ready = operated.hear("ready")
        assert ready["name"] == "three coils"
        assert ready["largest_level_v"] == pytest.approx(2**0.5)
        assert len(ready["actuator_mm"]) == 3
        assert set(ready["instruments"]) == {"mirror", "recorder", "player"}

        operated.send(order="jog", x_mm=12.5, y_mm=-8, id="a")
        mirror = operated.hear("mirror")
        assert (mirror["x_mm"], mirror["y_mm"], mirror["parked"]) == (12.5, -8.0, False)
        assert operated.hear("done") == {"event": "done", "order": "jog", "id": "a", "ok": True}

        operated.send(order="level", every_s=0.1, actuator=1, level_v=0.4)
        for level in (operated.hear("level"), operated.hear("level")):
            assert level["reference"]["peak_v"] == pytest.approx(0.4, rel=0.01)
            assert level["response"]["range_v"] == 10.0
            assert level["light"] == 1.0

        operated.send(order="sweep", actuator=2, level_v=0.8, duration_s=0.3)
        sweep = operated.hear("sweep")
        assert sweep["figures"]["snr_db"] > 20
        assert sweep["figures"]["defects"] == []
        assert len(sweep["response_v"]) == len(sweep["reference_v"]) > 3000
        assert len(sweep["frequency_hz"]) == len(sweep["response_db"]) == len(sweep["noise_db"])
        assert operated.hear("done")["ok"]

        operated.send(order="park")
        assert operated.hear("mirror")["parked"]
        operated.send(order="state")
        assert operated.hear("levels")["on"]
        operated.send(order="mute")
        operated.hear("muted")
        operated.send(order="state")
        assert not operated.hear("levels")["on"]
        operated.send(order="reconnect", instrument="recorder")
        assert operated.hear("reconnected")["instrument"] == "recorder"
        operated.send(order="end")
        assert operated.hear("ended") == {"event": "ended", "muted": True, "parked": True}

    assert in_process(script, "operate", rig) == 0


def test_orders_that_cannot_be_then_each_is_one_sentence_and_the_next_is_carried_out(rig):
    wrong = (
        '{"order": "mute", "now": true}',  # first: a mute drops the orders that wait
        '{"order": "state", "id": 1e400}',
        '{"order": "state", "id": ' + 700 * "[" + 700 * "]" + "}",
        '{"order": "jog", "x_mm": 1' + 400 * "0" + ', "y_mm": 0}',
        '{"order": "\\ud800"}',
        "jog, please",
    )

    def script(operated):
        operated.hear("ready")
        byte_order_mark = codecs.BOM_UTF8.decode()
        operated.send_text(f"{byte_order_mark}\n{byte_order_mark}" + '{"order": "mute"}')
        operated.hear("muted")
        for line in wrong:
            operated.send_text(line)
            assert operated.hear("refused")["sentence"]
        operated.send(order="jog", x_mm=900, y_mm=0, id=7)
        assert "mirror.limit_mrad" in operated.hear("refused")["sentence"]
        assert operated.hear("done") == {"event": "done", "order": "jog", "id": 7, "ok": False}
        operated.send(order="sweep", actuator=0, duration_s=0.1)
        for x_mm in range(5):  # what is in the pipe when it ends is carried out
            operated.send(order="jog", x_mm=x_mm, y_mm=0)
        operated.close_input()
        told = operated.rest()
        assert [one["event"] for one in told].count("sweep") == 1
        assert [one["x_mm"] for one in told if one["event"] == "mirror"] == [0, 1, 2, 3, 4]
        assert told[-1]["event"] == "ended"

    assert in_process(script, "operate", rig) == 0


@pytest.mark.parametrize(
    ("order", "why"),
    [
        ({"order": "state", "id": [[1]]}, "id: Expected"),
        ({"order": "jog", "x_mm": 1e308, "y_mm": -1e308}, "x_mm is"),
        ({"order": "jog", "x_mm": 1}, "y_mm is None"),
        ({"order": "jog", "x_mm": 1, "y_mm": 1, "x_mrad": 1}, "not both"),
        ({"order": "sweep"}, "missing required field `actuator`"),
        ({"order": "sweep", "actuator": 3}, "actuator is 3; allowed: 0 to 2"),
        ({"order": "sweep", "actuator": True}, "actuator: Expected"),
        ({"order": "sweep", "actuator": 0, "level_v": 1.5}, "at most 1.414 V"),
        ({"order": "sweep", "actuator": 0, "level_v": 1e-320}, "allowed: 1e-06 V"),
        ({"order": "sweep", "actuator": 0, "stop_hz": 20}, "start_hz is 40; allowed is less than stop_hz, 20"),
        ({"order": "sweep", "actuator": 0, "start_hz": 399.9999999999, "stop_hz": 400}, "duration_s is 0.5"),
        ({"order": "level", "actuator": 0, "level_v": 5e-324}, "allowed: 1e-06 V"),
        ({"order": "level", "loud": True}, "unknown field `loud`"),
        ({"order": "reconnect", "instrument": "laser"}, "instrument: Invalid enum value 'laser'"),
        ({"order": "dance"}, "allowed: jog, park, level, sweep, mute, state, reconnect, end"),
        ({"step": 1}, "order None is not known"),
    ],
)
def test_given_an_order_that_cannot_be_then_one_sentence_says_what_is_allowed(rig, order, why):
    with pytest.raises(InputError, match=re.escape(why)):
        order_of(order, load_rig(rig))


@of_posix
def test_given_a_closed_standard_input_then_it_ends_muted_and_parked(rig):
    done = python("-m", "wavefocus", "operate", rig, shell=("sh", "-c", 'exec "$@" <&-', "sh"))
    assert json.loads(done.stdout.splitlines()[-1]) == {"event": "ended", "muted": True, "parked": True}
    assert (done.returncode, done.stderr) == (0, "")


def test_given_a_reading_thread_that_fails_then_it_is_acted_on_at_once_and_reported():
    code = (
        "from wavefocus.json_lines import LinesIn, ReadingFailedError\n"
        "def fail(content): raise KeyError(content['order'])\n"
        "lines = LinesIn()\n"
        "lines.start(fail, on_error=lambda: print('muted', flush=True))\n"
        "try: lines.next(30)\n"
        "except ReadingFailedError as failure: print(type(failure.__cause__).__name__)\n"
    )
    done = python("-c", code, input='{"order": "park"}\n')
    assert done.stdout.split() == ["muted", "KeyError"]


@pytest.mark.parametrize("name", [name for name in ("SIGTERM", "SIGQUIT") if hasattr(signal, name)])
def test_given_a_signal_then_it_ends_in_130(rig, name, capfd):
    def script(operated):
        operated.send(order="level", every_s=0.1, actuator=0)
        operated.hear("level")
        os.kill(os.getpid(), getattr(signal, name))
        assert operated.hear("ended")["parked"]

    assert in_process(script, "operate", rig) == 130
    assert capfd.readouterr().err == "stopped by the user; the outputs are muted, the mirror is parked\n"


@of_posix
@pytest.mark.parametrize(
    ("words", "order"),
    [
        (("operate", "rig.toml"), '{"order": "jog", "x_mm": 10, "y_mm": 5}\n'),
        (
            ("live", "plate.h5", "--rig", "rig.toml", "--json", "--record", "felt"),
            '{"order": "move", "name": "pen", "at_mm": [4, 0], "amplitude": 1e-3}\n',
        ),
    ],
    ids=["operate", "live"],
)
def test_given_a_listener_that_goes_away_then_orders_count_until_the_input_ends(bank, words, order):
    command = [sys.executable, "-m", "wavefocus", *words]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen(command, cwd=bank.parent, text=True, **pipes) as process:
        while '"ready"' not in process.stdout.readline():
            pass
        process.stdout.close()
        process.stdout = None
        for _ in range(50):
            process.stdin.write(order)
            process.stdin.flush()
            time.sleep(0.02)
        _, said = process.communicate(timeout=60)
    assert (process.returncode, "Traceback" in said) == (0, False)
    if "live" in words:
        assert len(load_scene(bank.parent / "felt" / "scene.toml").sources) == 1


def test_instruments_that_are_not_there_then_fault_is_told_and_exit_code_is_3(rig, capsys):
    rig.write_text(ABSENT_RIG.format(folder=rig.parent), encoding="utf-8")
    told = said_by(capsys, "operate", rig, code=3)
    fault = json.loads(told.out.splitlines()[-1])
    assert (fault["event"], fault["instrument"]) == ("fault", "mirror")
    assert "there is no such port now" in fault["cause"]
    assert fault["remedy"]
    assert len(told.err.splitlines()) == 1
