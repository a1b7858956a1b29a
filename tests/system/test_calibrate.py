"""Calibration through the real command: a person's or a program's answers, a file, and what becomes of it."""

import io
import json
import os
import subprocess
import sys
from contextlib import redirect_stderr, redirect_stdout
from datetime import date
from pathlib import Path

import numpy as np
import pytest

from tests.lab_files import RUN, write_positions
from tests.system.captures import captured, refused, wavefocus
from tests.system.lines import in_process, of_posix
from wavefocus.__main__ import run
from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.config.calibration import CalibrationRecord, load_calibration
from wavefocus.mocks.virtual.synthesis import output_errors
from wavefocus.storage.bank.reading import open_bank

SEED, SPREAD_S, SPREAD_DB, DELAY_S = 7, 20e-6, 1.0, 8.3e-6
MAP = ((1.02e-3, 3e-5, 0.01), (-2e-5, 0.97e-3, -0.005), (1e-4, -5e-5, 1.0))
ACTUATORS = [[110.0, 0.0], [40.0, 66.0], [-40.0, 66.0], [-110.0, 0.0], [-40.0, -66.0], [40.0, -66.0]]
OUTPUTS = len(ACTUATORS) + 1
PRACTICE = f"""
[rig]
name = "practice"

[actuators]
position_mm = {ACTUATORS}

[player]
limit_v = 4.0

[emulation]
mirror_map = {[list(row) for row in MAP]}
"""
RIG = f"""{PRACTICE}seed = {SEED}
clock_ppm = 41.0
inter_channel_delay_s = {DELAY_S}
output_latency_spread_s = {SPREAD_S}
output_gain_spread_db = {SPREAD_DB}
"""
TRUE = MirrorMap(MAP)
TRUE_LATE_S, TRUE_GAIN = output_errors(OUTPUTS, SPREAD_S, SPREAD_DB, SEED)


@pytest.fixture
def rig(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    return tmp_path / "rig.toml"


def calibrate(rig, *options, lines=None, code=0):
    """Run the command with a person who types, and return its JSON and what the person was told."""
    out, told = io.StringIO(), io.StringIO()
    with pytest.MonkeyPatch.context() as person, redirect_stdout(out), redirect_stderr(told):
        # These lines, or Enter as often as it takes.
        typed = "\n" * 50 if lines is None else "".join(f"{line}\n" for line in lines)
        person.setattr(sys, "stdin", io.StringIO(typed))
        assert run(["calibrate", str(rig), "--json", *map(str, options)]) == code, told.getvalue()
    return json.loads(out.getvalue()) if out.getvalue() else {}, told.getvalue()


def marks_file(folder, sigma_mm=0.1):
    """Marks, and the angles at which a person who errs a little found the beam on them."""
    rng = np.random.default_rng(0)
    lines = ["x_mm,y_mm,x_mrad,y_mrad"]
    for x_mm, y_mm in [(0, 0), (80, 45), (-80, 45), (-80, -45), (80, -45), (100, 0), (-100, 0)]:
        x_mrad, y_mrad = TRUE.angles_mrad(x_mm + rng.normal(0, sigma_mm), y_mm + rng.normal(0, sigma_mm))
        lines.append(f"{x_mm},{y_mm},{float(x_mrad)},{float(y_mrad)}")
    file = folder / "marks.csv"
    file.write_text("\n".join(lines), encoding="utf-8")
    return file


def beam_error_mm(map_rows):
    """How far from where it should be the beam falls, rms over the surface."""
    x_mm, y_mm = np.meshgrid(np.linspace(-100, 100, 9), np.linspace(-50, 50, 5))
    found = MirrorMap(tuple(tuple(row) for row in map_rows))
    there = TRUE.surface_mm(*found.angles_mrad(x_mm, y_mm))
    return float(np.sqrt(np.mean((there[0] - x_mm) ** 2 + (there[1] - y_mm) ** 2)))


def test_given_a_rig_then_calibrate_finds_what_it_is_really_like(rig):
    told, people = calibrate(rig, "--fiducials", marks_file(rig.parent))
    file = rig.parent / f"calibration-{date.today().isoformat()}.toml"
    assert told["file"] == str(file)
    assert told["measured"] == ["inputs", "outputs", "mirror", "actuators"]
    assert told["problems"] == []
    assert f'[calibration] file = "{file.name}"' in people
    record = load_calibration(file)
    assert record == CalibrationRecord.model_validate(told["calibration"])
    assert record.inputs.inter_channel_delay_s == pytest.approx(DELAY_S, abs=1e-7)
    found = {one.channel: one for one in record.outputs.channel}
    relative_s = TRUE_LATE_S - TRUE_LATE_S[-1]
    late_s = np.array([found[channel].latency_s for channel in range(OUTPUTS)]) - relative_s
    assert np.sqrt(np.mean(late_s**2)) < 1e-6
    full_scale_v = np.array([found[channel].full_scale_v for channel in range(OUTPUTS)])
    assert np.abs(full_scale_v / (5.0 * TRUE_GAIN) - 1).max() < 1e-3
    assert record.mirror.residual_rms_mm < 0.3
    assert beam_error_mm(record.mirror.map) < 0.2
    assert {one.verdict for one in record.actuators.actuator} == {"good"}


def test_given_a_person_who_jogs_then_the_map_is_as_good_as_their_eye(rig):
    marks = [(-80, -40), (80, -40), (80, 40), (-80, 40), (0, 0)]
    file = rig.parent / "marks.csv"
    file.write_text("# corners\nx_mm,y_mm\n" + "".join(f"{x},{y}\n" for x, y in marks), encoding="utf-8")
    lines = []
    for x_mm, y_mm in marks:
        x_mrad, y_mrad = (float(angle) for angle in TRUE.angles_mrad(x_mm, y_mm))
        lines += ["what?", "1000 0", "0.5 -0.5", f"= {x_mrad - 1:.4f} {y_mrad + 2:.4f}", "1, -2", ""]
    told, people = calibrate(rig, "--only", "mirror", "--fiducials", file, lines=lines)
    record = load_calibration(Path(told["file"]))
    assert record.mirror.residual_rms_mm < 1e-3
    assert beam_error_mm(record.mirror.map) < 1e-3
    assert record.inputs is record.outputs is record.actuators is None
    assert people.count("'what?' is not understood") == 5
    assert people.count("beyond the limit of 250 mrad: not moved") == 5
    # The fifth mark is approached with the map through the first four, so the beam is there already.
    x_mrad, y_mrad = (float(angle) for angle in TRUE.angles_mrad(0, 0))
    (last, *_) = [line for line in people.splitlines() if line.startswith("mark 5 of 5")]
    assert last.endswith(f"mirror at ({x_mrad:.3f}, {y_mrad:.3f}) mrad")


@of_posix
def test_given_keys_pressed_before_a_question_then_they_are_no_answer_to_it(rig):
    import pty

    ours, theirs = pty.openpty()
    os.write(ours, b"\n\n\n")  # in the terminal before the command begins
    command = [sys.executable, "-m", "wavefocus", "calibrate", str(rig), "--only", "inputs"]
    with subprocess.Popen(command, stdin=theirs, stderr=subprocess.PIPE, text=True) as process:
        os.close(theirs)
        told = next(line for line in process.stderr if "press Enter" in line)
        os.write(ours, b"\x04")  # the end of input: the question still waits for its answer
        rest = process.stderr.read()
    os.close(ours)
    assert "both inputs" in told
    assert "standard input: ended before a cable was plugged" in rest
    assert process.returncode == 2
    assert list(rig.parent.iterdir()) == [rig]


def test_given_flaws_then_each_is_named_with_what_to_do(rig):
    flaws = "dead_actuators = [1]\nweak_actuators = [2]\nreversed_actuators = [3]\nreversed_outputs = [5]\n"
    rig.write_text(RIG + flaws, encoding="utf-8")
    told, _ = calibrate(rig, "--only", "outputs,mirror,actuators", "--fiducials", marks_file(rig.parent), code=1)
    problems = "\n".join(told["problems"])
    assert "outputs: output 5 is reversed: swap its two wires" in problems
    assert "actuator 1 on output 1 is dead" in problems
    assert "check its cable, its amplifier channel and its coil" in problems
    assert "actuator 2 on output 2 is weak (-1" in problems
    assert "actuator 3 on output 3 is reversed" in problems
    assert len(told["problems"]) == 5
    record = load_calibration(Path(told["file"]))
    assert [one.polarity for one in record.actuators.actuator] == [1, 1, 1, -1, 1, -1]


def test_a_name_that_is_taken_meanwhile_then_what_was_measured_has_the_next_one(rig, monkeypatch):
    out = rig.with_name("c.toml")

    class Keyboard(io.StringIO):
        """While a person reads the question, another program writes a file under the name that was asked for."""

        def readline(self, size=-1):
            out.write_text("of somebody else", encoding="utf-8")
            return super().readline()

    monkeypatch.setattr(sys, "stdin", Keyboard("\n\n"))
    assert run(["calibrate", str(rig), "--only", "inputs", "--out", str(out)]) == 0
    assert out.read_text(encoding="utf-8") == "of somebody else"
    assert load_calibration(rig.with_name("c-2.toml")).inputs is not None


@pytest.mark.parametrize(
    ("options", "told"),
    [
        (["--amplitude-v", "4.5"], "--amplitude-v 4.5: must be above 0 and at most 4"),
        (["--amplitude-v", "0"], "--amplitude-v 0: must be above 0"),
        (["--only", "lenses"], "--only: 'lenses' is not known; allowed: inputs, outputs, mirror, actuators"),
        (["--fiducials", "nowhere.csv"], "nowhere.csv: no such file"),
        (["--only", "mirror", "--fiducials", "four.csv"], "four.csv"),  # too few to show a wrong one
        (["--only", "inputs", "--out", "rig.toml"], "rig.toml: is there already and is not overwritten"),
        (["--only", "inputs", "--out", "nowhere/c.toml"], "nowhere: no calibration can be written there"),
    ],
)
def test_given_a_wrong_option_then_it_is_one_line_and_exit_2(rig, capsys, options, told):
    header, _, *marks = marks_file(rig.parent).read_text(encoding="utf-8").splitlines()
    (rig.parent / "four.csv").write_text("\n".join([header, *marks[:4]]), encoding="utf-8")
    options = [str(rig.parent / option) if option in ("rig.toml", "four.csv") else option for option in options]
    assert told in refused(capsys, "calibrate", rig, *options)


def test_given_coils_of_limited_power_then_no_larger_amplitude_is_taken(rig, capsys):
    coil = "limit_v = 4.0\ncoil_resistance_ohm = 8.0\nlimit_power_w = 0.1"
    rig.write_text(RIG.replace("limit_v = 4.0", coil), encoding="utf-8")
    told = refused(capsys, "calibrate", rig, "--amplitude-v", "1.3")
    assert "at most 1.26491 (the rig's player.limit_v, player.limit_power_w" in told


def test_given_a_person_who_leaves_half_way_then_what_was_measured_is_kept(rig):
    _, people = calibrate(rig, lines=[""] * (1 + OUTPUTS - 1), code=2)
    assert "standard input: ended before a cable was plugged" in people
    (file,) = rig.parent.glob("calibration-*.toml")
    record = load_calibration(file)
    assert (record.inputs is None, record.outputs is None, record.mirror is None) == (False, False, True)


def test_given_a_calibrated_rig_then_capture_uses_it_and_the_bank_alone_goes_on(rig, capsys):
    told, _ = calibrate(rig, "--only", "inputs,outputs,mirror", "--fiducials", marks_file(rig.parent, 0.01))
    file = Path(str(told["file"]))
    rig.write_text(f'{RIG}\n[calibration]\nfile = "{file.name}"\n', encoding="utf-8")
    of_no_virtual_rig = RUN.partition("[quality]")[0].replace("duration_s", "amplitude_v = 0.5\nduration_s")
    (rig.parent / "run.toml").write_text(of_no_virtual_rig, encoding="utf-8")
    write_positions(rig.parent, [(0, 0), (4, 0)])
    bank = rig.parent / "plate.h5"
    people = captured(capsys, rig.parent).err
    assert f"{file.name}: mirror map (residual 0.01 mm), inter-channel delay 8.30 us, full scale of 7 outputs" in people
    assert "warning" not in people
    with open_bank(bank) as view:
        held = json.loads(str(view.rig_json))
    assert held["calibration"]["measured"]["outputs"]["channel"][0]["channel"] == OUTPUTS - 1
    file.unlink()
    rig.unlink()
    assert wavefocus("remeasure", bank, "--positions", "1") == 0


def converse(rig, *answers, only="mirror", code=0):
    """Events of a calibration that a program is asked for, and that gives these answers."""
    events = []

    def script(asked):
        for answer in answers:
            asked.send(**answer)
        asked.close_input()
        events.extend(event for event in asked.rest() if event["event"] in ("ask", "refused", "done"))

    assert in_process(script, "calibrate", rig, "--only", only, "--operator", "lines") == code
    return events


def test_answers_that_are_not_understood_then_each_is_sentence_and_question_stays(rig):
    wrong = [
        ({"answer": "yes"}, "allowed: here, by, to, cancel"),
        ({"answer": ["here"]}, "answer ['here'] is not understood"),
        ({"answer": "by", "x_mrad": 1}, "answer 'by' lacks y_mrad"),
        ({"answer": "by", "x_mrad": "1", "y_mrad": 1}, "x_mrad: Expected `float`"),
        ({"reply": "here"}, "answer None"),
    ]
    far = {"answer": "to", "x_mrad": 900, "y_mrad": 0}
    _, *refused, last = converse(rig, *(answer for answer, _ in wrong), far, {"answer": "cancel"}, code=130)
    assert all(why in event["sentence"] for event, (_, why) in zip(refused, wrong, strict=True))
    assert "beyond the limit of 250 mrad" in last["note"]


def test_given_a_person_who_leaves_the_map_then_nothing_is_written(rig):
    here = [{"answer": "here"}] * 7
    *_, judged, refused, again, done = converse(rig, *here, {"answer": "keep"}, {"answer": "drop"}, code=1)
    assert (judged["what"], judged["rms_mm"], judged["off_mm"]) == ("map", None, [])
    assert refused["sentence"] == judged["problem"]  # no mark was moved
    assert again["what"] == "map"
    assert done["problems"] == ["mirror: its map was looked at and left"]
    assert list(rig.parent.iterdir()) == [rig]
    assert rig.read_text(encoding="utf-8") == RIG


# Marks that are met, one of them wrong, are in tests/gui/test_rig_tab.py: the window asks this command.
def test_given_cables_to_plug_then_the_program_is_asked_for_each(rig):
    both, vibrometer, done = converse(rig, *[{"answer": "done"}] * 2, only="inputs")
    assert (both["what"], both["source"], vibrometer["source"]) == ("connect", "both", "vibrometer")
    assert "plug the loopback into both inputs" in both["sentence"]
    assert done["measured"] == ["inputs"]
