"""Doctor and calibrate through every wire at once: real drivers, emulated instruments, one plate behind them."""

import json
import re
import subprocess
import sys

import pytest

from tests.lab_files import change_text
from tests.wire.emulated import ACTUATORS
from wavefocus.mocks.virtual.synthesis import output_errors

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]

SEED, SPREAD_S, SPREAD_DB = 4, 2e-5, 1.0  # the seed is that of the rig's text
MAP = ((1.02e-3, 3e-5, 0.01), (-2e-5, 0.98e-3, -0.005), (1e-4, -5e-5, 1.0))
FLAWS = f"""
output_latency_spread_s = {SPREAD_S}
output_gain_spread_db = {SPREAD_DB}
mirror_map = {[list(row) for row in MAP]}
reversed_actuators = [2]
"""


@pytest.fixture
def rig(rig):
    # Without a mirror there is no light on a spot: its noise is nothing beside the widest range. The interface answers
    # within the post-roll.
    text = rig.read_text(encoding="utf-8").replace("period_frames = 8192", "period_frames = 4096")
    rig.write_text(text + FLAWS, encoding="utf-8")
    return rig


def doctor(rig, sides):
    command = [sys.executable, "-m", "wavefocus", "doctor", str(rig), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=sides.environment)
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)


def failures(told):
    return [(one["instrument"], one["check"]) for one in told["findings"] if one["verdict"] == "fail"]


def calibrate(rig, sides, *options):
    """Calibrate with a person who plugs what is asked for into the emulated rig's response input."""
    command = [sys.executable, "-m", "wavefocus", "calibrate", str(rig), "--json", *options]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen(command, text=True, env=sides.environment, **pipes) as person:
        told = []
        for line in person.stderr:
            told.append(line)
            if "press Enter" in line:
                words = {"both inputs": "both", "summing box": "sum", "the vibrometer": "vibrometer"}
                found = re.search(r"output \d+|both inputs|summing box|the vibrometer", line)
                assert found is not None, line
                word = words.get(found[0], found[0])
                while f"response input is connected to: {word}" not in sides.say(f"patch {word}"):
                    pass  # other lines came between
                person.stdin.write("\n")
                person.stdin.flush()
        out = person.stdout.read()
    assert out, "".join(told)
    return person.returncode, json.loads(out)


def test_the_doctor_asks_every_instrument_and_a_missing_one_hides_no_other(rig, sides):
    # Where the loopback's full scale is not calibrated, every position would be poor.
    full_scale_v = 5.0 * output_errors(len(ACTUATORS) + 1, SPREAD_S, SPREAD_DB, SEED)[1][-1]
    change_text(rig, "[player]", f"[player]\nfull_scale_v = {full_scale_v}\nlimit_v = 4.0")
    for _ in range(5):
        _, told = doctor(rig, sides)
        verdicts = {(one["instrument"], one["check"]): one["verdict"] for one in told["findings"]}
        assert told["good"], told["findings"]
        if verdicts["player", "latency"] == "ok":  # a busy machine's is worth a warning
            break
    for key in (("mirror", "corners"), ("recorder", "record"), ("player", "latency"), ("vibrometer", "response")):
        assert verdicts[key] == "ok"
    (corners,) = [one for one in told["findings"] if one["check"] == "corners"]
    assert "read back within 0.0" in corners["what"]
    sides.say("unplug mirror")
    code, told = doctor(rig, sides)
    assert (code, failures(told)) == (1, [("mirror", "opening")])
    verdicts = {(one["instrument"], one["check"]): one["verdict"] for one in told["findings"]}
    assert verdicts["player", "clock ratio"] == "ok"
