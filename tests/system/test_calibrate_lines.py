"""`wavefocus calibrate --operator lines`: a window or a script asks the person."""

import tomllib
from pathlib import Path

import pytest

from tests.system.lines import Lines
from wavefocus.calibration.mirror_map import MirrorMap

MAP = ((1.02e-3, 3e-5, 0.01), (-2e-5, 0.97e-3, -0.005), (1e-4, -5e-5, 1.0))
TRUE = MirrorMap(MAP)
RIG = f"""
[rig]
name = "practice"

[actuators]
position_mm = [[110.0, 0.0], [40.0, 66.0], [-40.0, 66.0]]

[emulation]
mirror_map = {[list(row) for row in MAP]}
"""


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    return tmp_path / "rig.toml"


@pytest.fixture
def asked(rig):
    with Lines("calibrate", rig, "--only", "mirror", "--operator", "lines", "--use") as lines:
        yield lines


def meet(lines, ask, off_mm=0.0):
    """Bring the beam onto the mark that is asked for."""
    x_mrad, y_mrad = (float(angle) for angle in TRUE.angles_mrad(ask["place_mm"][0] + off_mm, ask["place_mm"][1]))
    lines.send(answer="by", x_mrad=x_mrad - ask["at_mrad"][0], y_mrad=y_mrad - ask["at_mrad"][1])
    again = lines.hear("ask")
    assert again["number"] == ask["number"]
    assert again["at_mrad"] == pytest.approx([x_mrad, y_mrad])
    lines.send(answer="here")


def test_a_mark_that_is_off_then_it_is_met_again_and_the_map_is_written_and_named(asked, rig):
    begin = asked.hear("begin")
    assert len(begin["marks_mm"]) == 7
    level = asked.hear("level")  # while a person jogs, both inputs are heard
    assert level["response"]["rms_v"] > 0
    for number in range(1, 8):
        ask = asked.hear("ask") if number > 1 else {"number": 1, "place_mm": [0.0, 0.0], "at_mrad": [0.0, 0.0]}
        meet(asked, ask, off_mm=9.0 if number == 3 else 0.0)
    judged = asked.hear("ask")
    assert judged["what"] == "map"
    assert judged["worst_mm"] > 1.0
    assert judged["suspect"] == 3
    assert "mark 3" in judged["problem"]
    asked.send(answer="keep")
    assert "mark 3" in asked.hear("refused")["sentence"]
    assert asked.hear("ask")["what"] == "map"
    asked.send(answer="redo", mark=3)
    ask = asked.hear("ask")
    assert (ask["what"], ask["number"]) == ("jog", 3)
    meet(asked, ask)
    judged = asked.hear("ask")
    assert judged["problem"] == ""
    assert judged["worst_mm"] < 1e-3
    assert len(judged["off_mm"]) == 7
    asked.send(answer="keep")
    done = asked.hear("done")
    assert done["measured"] == ["mirror"]
    assert asked.end() == 0
    assert Path(done["file"]).is_file()
    assert tomllib.loads(rig.read_text(encoding="utf-8"))["calibration"]["file"] == Path(done["file"]).name


def test_answers_that_are_not_understood_then_each_is_sentence_and_question_stays(asked):
    asked.hear("ask")
    for answer, why in (
        ({"answer": "yes"}, "allowed: here, by, to, cancel"),
        ({"answer": "by", "x_mrad": 1}, "missing required field `y_mrad`"),
        ({"reply": "here"}, "answer None"),
    ):
        asked.send(**answer)
        assert why in asked.hear("refused")["sentence"]
    asked.send(answer="to", x_mrad=900, y_mrad=0)
    assert "beyond the limit of 250 mrad" in asked.hear("ask")["note"]
    asked.send(answer="cancel")
    assert asked.end() == 130


def test_given_a_person_who_leaves_the_map_then_nothing_is_written(asked, rig):
    for _ in range(7):
        asked.hear("ask")
        asked.send(answer="here")
    judged = asked.hear("ask")
    assert (judged["what"], judged["rms_mm"], judged["off_mm"]) == ("map", None, [])
    asked.send(answer="keep")  # no mark was moved
    assert asked.hear("refused")["sentence"] == judged["problem"]
    assert asked.hear("ask")["what"] == "map"
    asked.send(answer="drop")
    assert asked.hear("done")["problems"] == ["mirror: its map was looked at and left"]
    assert asked.end() == 1
    assert list(rig.parent.iterdir()) == [rig]
    assert rig.read_text(encoding="utf-8") == RIG


def test_given_cables_to_plug_then_the_person_is_asked_for_each(rig):
    with Lines("calibrate", rig, "--only", "inputs", "--operator", "lines") as lines:
        ask = lines.hear("ask")
        assert (ask["what"], ask["source"]) == ("connect", "both")
        assert "plug the loopback into both inputs" in ask["sentence"]
        lines.send(answer="done")
        assert lines.hear("ask")["source"] == "vibrometer"
        lines.send(answer="done")
        assert lines.hear("done")["measured"] == ["inputs"]
        assert lines.end() == 0
