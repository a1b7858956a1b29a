"""``wavefocus play`` on an emulated audio interface: what leaves its outputs, to the end and interrupted."""

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from tests.wire.audio_bench import AudioBench, needs_audio_server, sounding, wait_until
from wavefocus.storage.drive_file import Drive, write_drive

pytestmark = [pytest.mark.long, *needs_audio_server]

RATE_HZ = 48_000
# The mirror and the recorder of this rig are nowhere: play needs neither.
RIG = """
[actuators]
position_mm = [[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0]]

[mirror]
driver = "asi-tiger"
port = "/nowhere"

[recorder]
driver = "nidaqmx"
device = "Dev1"
address = "localhost:1"

[player]
driver = "sounddevice"
host_api = "JACK Audio Connection Kit"
device = "wavefocus interface"
channels = [2, 0, 1]
full_scale_v = 4.0
limit_v = 3.0
"""


@pytest.fixture
def server():
    with ExitStack() as stack:
        yield AudioBench(stack, period_frames=8192).serve()


@pytest.fixture
def lab(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    return tmp_path


def write(lab, drive_v):
    none = np.zeros(0, np.int64)
    write_drive(lab / "drive.h5", Drive(drive_v, RATE_HZ, 0.0, "sampled", 1.0, 0.0, none, none, none))


def playing(lab, *options):
    command = [sys.executable, "-m", "wavefocus", "play", str(lab / "drive.h5"), "--rig", str(lab / "rig.toml")]
    return [*command, *options]


def cut_short(code, told):
    """Whether a machine that is too busy made an underflow, which ends in 3 and says so."""
    return code == 3 and "underflow" in told


def play_whole(server, command):
    """Play to the end, again where it was cut short; the frame before it began, and what was put out."""
    environment = {**os.environ, **server.environment}
    for _ in range(10):
        begun = int(server.played.frame_at(time.monotonic_ns()))
        child = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
        if not cut_short(child.returncode, child.stderr):
            break
    assert child.returncode == 0, child.stderr
    return begun, child.stdout


@contextmanager
def sounding_play(lab, server):
    """A play under way, begun again where it was cut short before it sounded."""
    environment = {**os.environ, **server.environment}
    for _ in range(10):
        with subprocess.Popen(playing(lab), env=environment, stderr=subprocess.PIPE, text=True) as child:
            wait_until(lambda child=child: child.poll() is not None or heard_now(server).any(), "the drive sounds")
            if child.poll() is None:
                yield child
                return
            told = child.communicate()[1]
        assert cut_short(child.returncode, told), told
    raise AssertionError(told)


def heard_now(server, seconds=0.1):
    now = int(server.played.frame_at(time.monotonic_ns()))
    return server.played.read(now - round(seconds * RATE_HZ), now)


def test_given_a_loop_then_every_sample_leaves_its_output_twice_without_a_gap(lab, server):
    drive_v = np.random.default_rng(1).uniform(0.5, 2.0, (3, RATE_HZ // 2))
    write(lab, drive_v)
    meant = np.tile(drive_v[[1, 2, 0]] / 4.0, (1, 2)).astype(np.float32)
    begun, _ = play_whole(server, playing(lab, "--loop", "2"))
    heard = sounding(server.played.read(begun, int(server.played.frame_at(time.monotonic_ns()))))
    np.testing.assert_array_equal(heard[:3], meant)
    assert not heard[3:].any()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP])
def test_given_a_signal_then_the_outputs_fall_silent_and_it_ends_in_130(lab, server, number):
    write(lab, np.full((3, 60 * RATE_HZ), 1.0))
    with sounding_play(lab, server) as child:
        child.send_signal(number)
        told = child.communicate(timeout=60)[1]
    assert child.returncode == 130, told
    assert "Traceback" not in told
    assert told.splitlines()[-1] == "stopped by the user; the outputs are muted"
    assert not heard_now(server).any()


def test_given_an_interface_that_is_lost_then_it_ends_in_3_and_says_what_to_do(lab, server):
    write(lab, np.full((3, 60 * RATE_HZ), 1.0))
    with sounding_play(lab, server) as child:
        server.kill()
        told = child.communicate(timeout=60)[1]
    assert child.returncode == 3, told
    assert "Traceback" not in told
    assert "reconnect" in told.splitlines()[-1]
