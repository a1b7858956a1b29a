"""``wavefocus live`` on the virtual rig: orders on standard input and by OSC, wrong ones, and every way out."""

import signal
import sys
import time
from pathlib import Path
from socket import AF_INET, SOCK_DGRAM, socket

import pytest
from pythonosc.osc_bundle_builder import IMMEDIATELY, OscBundleBuilder
from pythonosc.osc_message_builder import OscMessageBuilder

from tests.lab_files import with_check_rows
from tests.system.captures import refused
from tests.system.lines import Lines
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


def message(address, *values):
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)
    return builder.build()


@pytest.mark.smoke
def test_orders_on_standard_input_and_by_osc_then_sources_sound_there_until_the_end(bank):
    scene, felt = bank.parent / "scene.toml", bank.parent / "felt"
    text = scene.read_text(encoding="utf-8").replace("limit_v = 1.0", "limit_v = 1e-6")
    scene.write_text(text, encoding="utf-8")
    options = ("--scene", scene, "--record", felt, "--independent", "--osc", "127.0.0.1:0")
    with live(bank.parent, *options) as running, socket(AF_INET, SOCK_DGRAM) as sender:
        ready = running.hear("ready")
        assert ready["independent"] is True
        assert (ready["actuators"], ready["block_ms"]) == (3, 5.0)
        assert (ready["x_mm"], ready["y_mm"]) == ([0.0, 8.0], [0.0, 4.0])
        host, _, port = ready["osc"].rpartition(":")
        sender.connect((host, int(port)))
        state = move_until_heard(running, "left", "right")
        assert [source["at_mm"] for source in state["sources"]] == [[4.0, 0.0]] * 2
        assert [source["amplitude"] for source in state["sources"]] == [1e-3] * 2
        assert state["latency_ms"] > 0
        # What else is wrong with an order: tests/unit/test_live_session.py.
        running.send(order="move", name="left", at_mm=[400, 0])
        assert running.hear("refused")["sentence"]
        running.send_text("no JSON")
        running.hear("refused")
        sender.send(b"/\xff garbage")
        assert "OSC" in running.hear("refused")["sentence"]
        sine = {"kind": "sine", "frequency_hz": 200.0, "duration_s": 0.5}
        running.send(order="signal", name="left", signal=sine)
        move_until_heard(running, "left", "right")
        running.send(order="end_source", name="right")
        move_until_heard(running, "left")
        sender.send(message("/source/a/signal", '{"kind": "sine", "frequency_hz": 200, "duration_s": 0.1}').dgram)
        seen: list = []
        for _ in range(600):
            bundle = OscBundleBuilder(IMMEDIATELY)
            bundle.add_content(message("/source/a/amplitude", 0.25))
            bundle.add_content(message("/source/a/position", 8, 4.0))
            sender.send(bundle.build().dgram)
            time.sleep(0.02)
            state = running.next_of("state")
            seen = seen if state is None else [one for one in state["sources"] if one["name"] == "a"]
            if seen and seen[0]["amplitude"] == 0.25:  # it has appeared
                break
        assert [(one["at_mm"], one["amplitude"]) for one in seen] == [([8.0, 4.0], 0.25)]
        sender.send(message("/end").dgram)
        ended = running.rest()[-1]
        assert running.end() == 0
    assert ended["event"] == "ended"
    assert ended["positions"] > 3
    assert ended["latency_p999_ms"] > 0
    assert ended["limited_s"] > 0
    assert Path(ended["recorded"]) == felt / "scene.toml"
    recorded = load_scene(ended["recorded"])
    assert {type(source.path) for source in recorded.sources} == {TrajectoryPath}
    assert recorded.regularisation.independent


def test_nearest_on_a_coarse_bank_is_noticed_and_ctrl_c_mutes_and_says_so(bank):
    coarse = with_check_rows(bank, bank.with_name("coarse.h5"), 5)
    scene = ("--scene", bank.parent / "scene.toml")
    with Lines("live", coarse, "--rig", bank.parent / "rig.toml", *scene, "--json") as running:
        running.hear("ready")
        notice = running.hear("notice")
        assert notice["code"] == "interpolation"
        assert "'nearest'" in notice["sentence"]
        move_until_heard(running, "finger")
        if sys.platform == "win32":  # it sends Ctrl-C to whole consoles
            running.close_input()
        else:
            running.process.send_signal(signal.SIGINT)
        assert running.rest()[-1]["event"] == "ended"
        assert running.end() == (0 if sys.platform == "win32" else 130)


def test_given_wrong_options_then_a_sentence_names_them_before_anything_sounds(bank, capsys):
    for option, value, named in (
        ("--osc", "nowhere", "--osc"),
        ("--osc", "127.0.0.1:70000", "--osc"),
        ("--look-ahead-ms", "3000", "--look-ahead-ms"),
        ("--look-ahead-ms", "-1", "--look-ahead-ms"),
        ("--scene", "none.toml", "none.toml"),
        ("--rig", "none.toml", "none.toml"),
    ):
        assert named in refused(capsys, "live", bank, "--rig", bank.parent / "rig.toml", option, value)
