"""Processes whose address space is limited: refused before anything is opened, and silent whatever fails."""

import pytest

from tests.system.lines import of_linux, python

pytestmark = of_linux("address space is limited on Linux alone")

LIMITED = """
import resource
from wavefocus.rig.instruments import spare_address_space
import wavefocus.acquisition.engine.campaign, wavefocus.calibration.estimator.sequential
import scipy.linalg, wavefocus.commands.capture
resource.setrlimit(resource.RLIMIT_AS, (1 << 40, -1))
resource.setrlimit(resource.RLIMIT_AS, ((1 << 40) - spare_address_space() + {spare}, -1))
"""


def _limited(code, spare, *arguments, folder):
    return python("-c", LIMITED.format(spare=spare) + code, *arguments, cwd=folder)


@pytest.mark.parametrize("spare", [100 << 20, pytest.param(40 << 20, marks=pytest.mark.nightly)])
def test_given_too_little_address_space_then_capture_ends_at_once_with_one_line(lab, spare):
    code = "from wavefocus.__main__ import main\nmain()"
    done = _limited(code, spare, "capture", "run.toml", "--bank", "plate.h5", folder=lab)
    assert done.returncode == 2, done.stderr
    assert done.stderr.splitlines()[-1].startswith("wavefocus: ")
    assert "Traceback" not in done.stderr


def test_without_a_new_thread_instruments_fall_silent_and_nothing_else_is_done(tmp_path):
    code = """
from wavefocus.drivers.timeouts import bounded
from wavefocus.drivers.errors import InstrumentError
from wavefocus.mocks.virtual.rig import VirtualRig
done = []
class Told:
    def __init__(self, name): self.name = name
    def __getattr__(self, what): return lambda *_: done.append(f"{self.name} {what}")
roles = VirtualRig().instruments
from dataclasses import replace
roles = bounded(replace(roles, mirror=Told("mirror"), player=Told("player"), recorder=Told("recorder")), 5.0)
resource.setrlimit(resource.RLIMIT_AS, (resource.getrlimit(resource.RLIMIT_AS)[0] - spare_address_space(), -1))
try:
    roles.mirror.move_to(1.0, 1.0)
except (RuntimeError, MemoryError):
    done.append("refused")
roles.player.mute(); roles.recorder.abort(); roles.mirror.park(); roles.player.close(); roles.mirror.close()
print(done)
"""
    done = _limited(code, 1 << 30, folder=tmp_path)
    assert done.stdout.strip() == str(
        ["refused", "player mute", "recorder abort", "mirror park", "player close", "mirror close"]
    ), done.stderr
