"""A rig operated by hand through every wire: the beam is where it was sent, and parked on every way out."""

import signal
import time

import pytest

from tests.lab_files import change_text
from tests.system.lines import Lines
from wavefocus.drivers.process import SILENT_S

pytestmark = pytest.mark.long


def spot_of(sides):
    """Where the emulated beam falls on its plate."""
    return sides.say("spot")


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
            words = spot_of(sides).split()
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
        assert spot_of(sides) == "spot: not on the plate"


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
