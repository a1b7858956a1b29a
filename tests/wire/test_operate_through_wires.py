"""A rig operated by hand, and examined, through every wire: the beam is where it was sent, and parked in the end."""

import json
import signal
import subprocess
import sys
import time

import pytest

from tests.lab_files import change_text
from tests.system.lines import Lines
from tests.wire.emulated import ACTUATORS, emulated_instruments, free_port, rig_text
from wavefocus.drivers.process import SILENT_S
from wavefocus.mocks.virtual.synthesis import output_errors

pytestmark = [pytest.mark.long, pytest.mark.timeout(300)]


@pytest.fixture
def rig(tmp_path):
    """A rig file whose response range is the widest."""
    file = tmp_path / "rig.toml"
    text = rig_text(tmp_path, f"localhost:{free_port()}", period_frames=8192)
    file.write_text(text.replace("response_range_v = 1.0\n", ""), encoding="utf-8")
    return file


@pytest.fixture
def sides(rig):
    """Its emulated instruments."""
    with emulated_instruments(rig) as sides:
        yield sides


def swept(lines, actuator):
    """A sweep, ordered again where the machine was too busy to keep the sound going."""
    for _ in range(10):
        lines.send(order="sweep", actuator=actuator, level_v=1.0)
        told = lines.hear("sweep", "refused")
        if told["event"] == "refused":
            assert "underflow" in told["sentence"]
        elif told["figures"] is not None or "clock skew" not in told["trouble"]:  # a stall of the machine
            break
    assert told["event"] == "sweep", told
    assert told["figures"] is not None, told["trouble"]
    return told


def test_real_drivers_then_beam_goes_where_it_is_sent_and_is_parked_however_it_ends(rig, sides):
    change_text(rig, "inter_channel_delay_s = 1.4e-5", "")
    for ending in ("end", "input", "signal"):
        with Lines("operate", rig, environment=sides.environment) as lines:
            lines.hear("ready")
            lines.send(order="jog", x_mm=30, y_mm=-12)
            assert lines.hear("mirror")["x_mm"] == pytest.approx(30.0, abs=0.01)
            words = sides.say("spot").split()
            assert float(words[1]) == pytest.approx(30.0, abs=0.1)
            assert float(words[2]) == pytest.approx(-12.0, abs=0.1)
            if ending == "end":
                lines.send(order="level")
                assert lines.hear("level")["response"]["rms_v"] > 0
                assert swept(lines, actuator=0)["figures"]["snr_db"] > 10
                with Lines("operate", rig, environment=sides.environment) as second:
                    assert second.end() == 3
                    assert "mirror" in second.said[-1]
                lines.send(order="end")
                assert lines.end() == 0
                assert any("14.00 us" in line for line in lines.said)  # the device's delay, which the rig file lacks
            elif ending == "input":
                lines.close_input()
                assert lines.end() == 0
            else:
                lines.send(order="sweep", actuator=0, level_v=1.0, duration_s=10.0)
                lines.hear("sweeping")
                lines.process.send_signal(signal.SIGTERM)
                assert lines.end() == 130
        assert sides.say("spot") == "spot: not on the plate"


def test_a_mute_ends_a_sweep_before_its_time_and_so_does_a_program_that_is_stopped(rig, sides):
    with Lines("operate", rig, environment=sides.environment) as lines:
        lines.hear("ready")
        lines.send(order="jog", x_mm=30, y_mm=-12)
        lines.send(order="sweep", actuator=0, level_v=1.0, duration_s=5.0, id="long")
        lines.hear("sweeping")
        lines.send(order="sweep", actuator=1, level_v=1.0, id="dropped")
        lines.send(order="mute", id="mute")
        done = [lines.hear("done") for _ in range(2)]
        assert [one["id"] for one in done] == ["long", "mute"]
        assert not done[0]["ok"]
        assert swept(lines, actuator=1)["figures"]["snr_db"] > 10
        lines.send(order="sweep", actuator=0, level_v=1.0, duration_s=10.0, id="stopped")
        lines.hear("sweeping")
        lines.process.send_signal(signal.SIGSTOP)
        time.sleep(SILENT_S + 3.0)
        lines.process.send_signal(signal.SIGCONT)
        told = lines.hear("fault")
        assert "was stopped" in str(told), told
        lines.send(order="end")
        assert lines.end() == 0


# The interface answers within the post-roll; without a mirror there is no light on a spot.
FLAWS = """period_frames = 4096
output_latency_spread_s = 2e-5
output_gain_spread_db = 1.0
mirror_map = [[1.02e-3, 3e-5, 0.01], [-2e-5, 0.98e-3, -0.005], [1e-4, -5e-5, 1.0]]
reversed_actuators = [2]
"""


@pytest.fixture
def flawed_rig(rig):
    change_text(rig, "period_frames = 8192\n", FLAWS)
    return rig


def doctor(rig, sides):
    command = [sys.executable, "-m", "wavefocus", "doctor", str(rig), "--json"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, env=sides.environment)
    assert done.stdout, done.stderr
    findings = json.loads(done.stdout)["findings"]
    verdicts = {(one["instrument"], one["check"]): one["verdict"] for one in findings}
    return done.returncode, verdicts, findings


def test_the_doctor_asks_every_instrument_and_a_missing_one_hides_no_other(flawed_rig, sides):
    rig = flawed_rig
    # Where the loopback's full scale is not calibrated, every position would be poor; the seed is that of the rig.
    full_scale_v = 5.0 * output_errors(len(ACTUATORS) + 1, 2e-5, 1.0, 4)[1][-1]
    change_text(rig, "[player]", f"[player]\nfull_scale_v = {full_scale_v}\nlimit_v = 4.0")
    for _ in range(5):
        code, verdicts, findings = doctor(rig, sides)
        assert code == 0, findings
        if verdicts["player", "latency"] == "ok":  # a busy machine's is worth a warning
            break
    for key in (("mirror", "corners"), ("recorder", "record"), ("player", "latency"), ("vibrometer", "response")):
        assert verdicts[key] == "ok"
    (corners,) = [one for one in findings if one["check"] == "corners"]
    assert "read back within 0.0" in corners["what"]
    sides.say("unplug mirror")
    code, verdicts, _ = doctor(rig, sides)
    assert (code, [where for where, verdict in verdicts.items() if verdict == "fail"]) == (1, [("mirror", "opening")])
    assert verdicts["player", "clock ratio"] == "ok"
