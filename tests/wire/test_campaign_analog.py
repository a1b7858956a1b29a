"""A campaign whose mirror and shutter hang on outputs of the box that records: unplugged, and the program stopped."""

import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

from tests.lab_files import POSITIONS, write_positions
from tests.wire.analog_bench import analog_rig
from tests.wire.audio_bench import wait_until
from tests.wire.emulated import emulated_instruments, free_port
from tests.wire.test_campaign_through_wires import errors_db, write_run
from wavefocus.drivers.process import SILENT_S

pytestmark = pytest.mark.long


@pytest.mark.timeout(300)
def test_box_unplugged_and_program_stopped_then_bank_is_good_and_beam_was_parked(tmp_path):
    address = f"localhost:{free_port()}"
    analog_rig(tmp_path, address)
    with (tmp_path / "rig.toml").open("a", encoding="utf-8") as file:
        file.write(f'\n[shutter]\ndriver = "nidaqmx"\ndevice = "Dev1"\naddress = "{address}"\nopens_s = 0.01\n')
    write_run(tmp_path, "run.toml", "rig.toml")
    write_positions(tmp_path, POSITIONS)
    bank = tmp_path / "plate.h5"
    command = [sys.executable, "-m", "wavefocus", "capture", str(tmp_path / "run.toml"), "--bank", str(bank), "--json"]
    with emulated_instruments(tmp_path / "rig.toml") as sides:
        spots, states, reasons = [], [], []
        with subprocess.Popen(command, env=dict(sides.environment), stdout=subprocess.PIPE, text=True) as capture:
            assert capture.stdout is not None
            for line in capture.stdout:
                event = json.loads(line)
                states.append(event.get("state"))
                reasons.append(event.get("reason") or "")
                if event["event"] == "position_committed" and len(spots) < 3:
                    spots.append(event["position"])
                    if len(spots) == 2:
                        sides.say("unplug recorder")
                    if len(spots) == 3:
                        capture.send_signal(signal.SIGSTOP)
                        wait_until(lambda: sides.say("spot") == "spot: not on the plate", "the beam is parked")
                        time.sleep(SILENT_S)  # the player's process, too
                        capture.send_signal(signal.SIGCONT)
                if event["event"] == "reconnect_tried":
                    sides.say("plug recorder")
            code = capture.wait()
        assert code == 0
        assert states.count("recovering") >= 2
        assert any("this program was stopped for more than 5 s" in reason for reason in reasons)
        assert sides.say("spot") == "spot: not on the plate"
    errors = errors_db(bank, tmp_path / "rig.toml")
    assert np.median(errors) < -40.0
    assert errors.max() < -30.0
