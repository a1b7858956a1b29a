"""``wavefocus play`` and ``live`` on an emulated audio interface: what leaves its outputs, to the end and not."""

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, contextmanager

import numpy as np
import pytest

from tests.lab_files import ABSENT_RIG, change_text, wire_fault, write_bank
from tests.system.lines import Lines, wait_until
from tests.wire.audio_bench import AudioBench, needs_audio_server, sounding
from wavefocus.drivers.process import SILENT_S
from wavefocus.storage.drive_file import Drive, write_drive

pytestmark = [pytest.mark.long, pytest.mark.timeout(300), *needs_audio_server]

RATE_HZ = 48_000
PLAYER = """host_api = "JACK Audio Connection Kit"
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
    """The folder of a rig whose mirror and recorder are nowhere: play needs neither."""
    (tmp_path / "rig.toml").write_text(ABSENT_RIG.format(folder=tmp_path), encoding="utf-8")
    change_text(tmp_path / "rig.toml", 'device = "no such interface"\n', PLAYER)
    return tmp_path


def playing(lab, drive_v, *options):
    """The command that plays a drive."""
    none = np.zeros(0, np.int64)
    write_drive(lab / "drive.h5", Drive(drive_v, RATE_HZ, 0.0, "sampled", 1.0, 0.0, none, none, none))
    command = [sys.executable, "-m", "wavefocus", "play", str(lab / "drive.h5"), "--rig", str(lab / "rig.toml")]
    return [*command, *options]


def cut_short(code, told):
    """Whether a machine that is too busy made an underflow, which ends in 3 and says so."""
    return code == 3 and "underflow" in told


@contextmanager
def sounding_play(command, server):
    """A play under way, begun again where it was cut short before it sounded."""
    environment = {**os.environ, **server.environment}
    for _ in range(10):
        with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as child:
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
    command, environment = playing(lab, drive_v, "--loop", "2"), {**os.environ, **server.environment}
    meant = np.tile(drive_v[[1, 2, 0]] / 4.0, (1, 2)).astype(np.float32)
    for _ in range(10):
        begun = int(server.played.frame_at(time.monotonic_ns()))
        child = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, check=False)
        if not cut_short(child.returncode, child.stderr):
            break
    assert child.returncode == 0, child.stderr
    heard = sounding(server.played.read(begun, int(server.played.frame_at(time.monotonic_ns()))))
    np.testing.assert_array_equal(heard[:3], meant)
    assert not heard[3:].any()


@pytest.mark.parametrize(
    ("lost", "code", "last"), [(False, 130, "stopped by the user; the outputs are muted"), (True, 3, "reconnect")]
)
def test_a_terminal_that_closes_or_a_lost_interface_ends_it_silent_and_said(lab, server, lost, code, last):
    with sounding_play(playing(lab, np.full((3, 60 * RATE_HZ), 1.0)), server) as child:
        if lost:
            server.kill()
        else:
            child.send_signal(signal.SIGHUP)
        told = child.communicate(timeout=60)[1]
    assert child.returncode == code, told
    assert "Traceback" not in told
    assert last in told.splitlines()[-1]
    assert lost or not heard_now(server).any()


def test_an_interface_that_takes_seven_seconds_to_open_is_waited_for():
    # It hangs before the player's process is there; JACK and ASIO drivers with many channels take seconds, too.
    hangs = wire_fault("player", "frozen", "period", at_call=8, seconds=7.0)
    with ExitStack() as stack:
        bench = AudioBench(stack)
        player = bench.player(bench.serve(faults=[hangs]), channels=2, channel_full_scale_v=(1.0, 1.0))
        assert "2 of 24 channels" in player.identify()


# -- wavefocus live ---------------------------------------------------------------------------------------


def move_until(running, event, code=""):
    """Send positions until an event comes."""
    for count in range(6000):
        running.send(order="move", name="a", at_mm=[count % 9, 0.0], amplitude=0.5)
        time.sleep(0.01)
        told = running.next_of(event)
        if told is not None and (not code or told["code"] == code) and (event != "state" or told["sources"]):
            return told
    raise AssertionError(f"no {event} {code} came")


def test_live_outlives_the_loss_of_its_server_and_is_silent_in_the_end(lab, server):
    places_mm = np.array([[x, y] for y in (0.0, 4.0) for x in (0.0, 4.0, 8.0)])
    green = np.random.default_rng(1).standard_normal((len(places_mm), 3, 400))
    write_bank(lab / "plate.h5", green, places_mm, band_hz=(50.0, 450.0))
    environment = {**os.environ, **server.environment}
    rig = ("--rig", lab / "rig.toml", "--json")
    with Lines("live", lab / "plate.h5", *rig, environment=environment) as running:
        assert running.hear("ready")["actuators"] == 3
        begun = int(server.played.frame_at(time.monotonic_ns()))
        move_until(running, "state")
        time.sleep(0.3)
        now = int(server.played.frame_at(time.monotonic_ns()))
        frames = server.played.read(begun, now)
        assert np.flatnonzero(frames.any(axis=1)).tolist() == [0, 1, 2]
        assert np.abs(frames).max() <= 3.0 / 4.0
        server.kill()
        move_until(running, "notice", "lost")
        server.restart()
        move_until(running, "notice", "reconnected")
        move_until(running, "state")
        running.process.send_signal(signal.SIGSTOP)
        time.sleep(SILENT_S + 3.0)
        now = int(server.played.frame_at(time.monotonic_ns()))
        assert not server.played.read(now - 48_000, now).any()
        running.process.send_signal(signal.SIGCONT)
        assert "was stopped" in move_until(running, "notice", "lost")["sentence"]
        move_until(running, "notice", "reconnected")
        move_until(running, "state")
        running.close_input()
        assert running.rest()[-1]["event"] == "ended"
        assert running.end() == 0
    ended = int(server.played.frame_at(time.monotonic_ns()))
    assert not server.played.read(ended, ended + 24_000).any()
