"""``wavefocus live`` on the virtual rig: orders on standard input and by OSC, wrong orders, and every way out."""

import math
import signal
import subprocess
import sys
import time
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket

import pytest
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from tests.lab_files import with_check_rows
from tests.system.lines import Lines
from wavefocus.__main__ import run
from wavefocus.rendering.scene.model import load_scene
from wavefocus.rendering.scene.trajectory import TrajectoryPath

QUIET = {"amplitude": 1e-3}


def live(lab, *options):
    return Lines("live", lab / "plate.h5", "--rig", lab / "rig.toml", "--json", "--ahead-ms", "200", *options)


def move_until_heard(running, *names, x_mm=4.0):
    """Send positions until all sources sound."""
    for _ in range(600):
        for name in names:
            running.send(order="move", name=name, at_mm=[x_mm, 0.0], **QUIET)
        time.sleep(0.02)
        while (state := running.next_of("state")) is not None:
            appeared = {source["name"] for source in state["sources"] if source["amplitude"] == 1e-3}
            if appeared == {source["name"] for source in state["sources"]} == set(names):
                return state
    raise AssertionError("they do not sound")


@pytest.mark.smoke
def test_positions_on_standard_input_then_sources_sound_there_until_the_order_to_end(bank):
    scene = bank.parent / "scene.toml"
    text = scene.read_text(encoding="utf-8").replace("limit_v = 1.0", "limit_v = 1e-6")
    scene.write_text(text, encoding="utf-8")
    with live(bank.parent, "--scene", scene, "--record", bank.parent / "felt", "--independent") as running:
        ready = running.hear("ready")
        assert ready["independent"] is True
        assert (ready["actuators"], ready["block_ms"], ready["osc"]) == (3, 5.0, "")
        assert (ready["x_mm"], ready["y_mm"]) == ([0.0, 8.0], [0.0, 4.0])
        state = move_until_heard(running, "left", "right")
        assert [source["at_mm"] for source in state["sources"]] == [[4.0, 0.0]] * 2
        assert [source["amplitude"] for source in state["sources"]] == [1e-3] * 2
        assert state["latency_ms"] > 0
        for wrong in (
            {"order": "move", "name": "left", "at_mm": [400, 0]},
            {"order": "move", "name": "left", "at_mm": [4]},
            {"order": "signal", "name": "left", "signal": {"kind": "sine", "frequency_hz": 9e9, "duration_s": 1}},
            {"order": "signal", "name": "left", "signal": {"kind": "noise", "band_hz": [50, 450], "duration_s": 1e9}},
            {"order": "end_source", "name": "nobody"},
            {"order": "sing"},
        ):
            running.send(**wrong)
            assert running.hear("refused")["sentence"]
        running.send_text("no JSON")
        running.hear("refused")
        sine = {"kind": "sine", "frequency_hz": 200.0, "duration_s": 0.5}
        running.send(order="signal", name="left", signal=sine)
        move_until_heard(running, "left", "right")
        running.send(order="end_source", name="right")
        move_until_heard(running, "left")
        running.send(order="end")
        ended = running.rest()[-1]
        assert running.end() == 0
    assert ended["event"] == "ended"
    assert ended["positions"] > 3
    assert ended["latency_p999_ms"] > 0
    assert ended["limited_s"] > 0
    assert Path(ended["recorded"]) == bank.parent / "felt" / "scene.toml"
    recorded = load_scene(ended["recorded"])
    assert {type(source.path) for source in recorded.sources} == {TrajectoryPath}
    assert recorded.regularisation.independent


def message(address, *values):
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)
    return builder.build()


def test_a_coarse_bank_and_a_scene_with_nearest_then_a_notice_says_what_is_wrong(bank):
    coarse = with_check_rows(bank, bank.with_name("coarse.h5"), 5)
    arguments = ("--rig", bank.parent / "rig.toml", "--scene", bank.parent / "scene.toml", "--json")
    with Lines("live", coarse, *arguments) as running:
        running.hear("ready")
        notice = running.hear("notice")
        assert notice["code"] == "interpolation"
        assert "'nearest'" in notice["sentence"]
        running.send(order="end")
        running.rest()
        assert running.end() == 0


def test_given_osc_messages_then_they_are_orders_and_wrong_ones_end_nothing(bank):
    with live(bank.parent, "--osc", "127.0.0.1:0") as running, socket(AF_INET, SOCK_DGRAM) as sender:
        host, _, port = running.hear("ready")["osc"].rpartition(":")
        sender.connect((host, int(port)))
        sender.send(b"/\xff garbage")
        assert "OSC" in running.hear("refused")["sentence"]
        for address, values in (
            ("/source/a/position", [1.0]),
            ("/source/a/position", [1.0, "two"]),
            ("/source/a/position", [math.nan, 1.0]),
            ("/source/a/signal", ['{"kind": "file", "path": "/etc/passwd"}']),
            ("/source/a/colour", [1]),
            ("/elsewhere", []),
        ):
            sender.send(message(address, *values).dgram)
            assert running.hear("refused")["sentence"]
        sine = '{"kind": "sine", "frequency_hz": 200, "duration_s": 0.1}'
        sender.send(message("/source/a/signal", sine).dgram)
        seen: list = []
        for _ in range(600):
            bundle = OscBundleBuilder(IMMEDIATELY)
            bundle.add_content(message("/source/a/amplitude", 0.25))
            bundle.add_content(message("/source/a/position", 8, 4.0))
            sender.send(bundle.build().dgram)
            time.sleep(0.02)
            state = running.next_of("state")
            seen = seen if state is None else state["sources"]
            if seen and seen[0]["amplitude"] == 0.25:  # it has appeared
                break
        assert [(one["name"], one["at_mm"], one["amplitude"]) for one in seen] == [("a", [8.0, 4.0], 0.25)]
        sender.send(message("/end").dgram)
        assert running.rest()[-1]["event"] == "ended"
        assert running.end() == 0


@pytest.mark.parametrize("way", ["input ends", "Ctrl-C"])
def test_given_an_end_from_outside_then_it_is_muted_and_says_so(bank, way):
    with live(bank.parent) as running:
        running.hear("ready")
        move_until_heard(running, "finger")
        if way == "Ctrl-C":
            if sys.platform == "win32":
                pytest.skip("Windows sends Ctrl-C to whole consoles")
            running.process.send_signal(signal.SIGINT)
        else:
            running.close_input()
        assert running.rest()[-1]["event"] == "ended"
        assert running.end() == (130 if way == "Ctrl-C" else 0)


@pytest.mark.parametrize(
    ("options", "named"),
    [
        (("--osc", "nowhere"), "--osc"),
        (("--osc", "127.0.0.1:70000"), "--osc"),
        (("--look-ahead-ms", "3000"), "--look-ahead-ms"),
        (("--look-ahead-ms", "-1"), "--look-ahead-ms"),
        (("--scene", "none.toml"), "none.toml"),
        (("--rig", "none.toml"), "none.toml"),
    ],
)
def test_given_wrong_options_then_a_sentence_names_them_before_anything_sounds(bank, capsys, options, named):
    assert run(["live", str(bank), "--rig", str(bank.parent / "rig.toml"), *options]) == 2
    told = capsys.readouterr()
    assert told.out == ""
    assert named in told.err
    assert told.err.count("\n") == 1


@pytest.mark.may_skip("a closed pipe is another thing on Windows")
@pytest.mark.skipif(sys.platform == "win32", reason="a closed pipe is another thing on Windows")
def test_given_a_listener_that_goes_away_then_orders_are_carried_out_to_their_end(bank):
    words = ["live", bank, "--rig", bank.parent / "rig.toml", "--json", "--record", bank.parent / "felt"]
    command = [sys.executable, "-m", "wavefocus", *map(str, words)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdin is not None
        assert process.stdout is not None
        while '"ready"' not in process.stdout.readline():
            pass
        process.stdout.close()
        for _ in range(50):
            process.stdin.write('{"order": "move", "name": "pen", "at_mm": [4, 0], "amplitude": 1e-3}\n')
            process.stdin.flush()
            time.sleep(0.02)
        process.stdin.write('{"order": "end"}\n')
        process.stdin.flush()
        assert process.wait(60) == 0
    assert len(load_scene(bank.parent / "felt" / "scene.toml").sources) == 1
