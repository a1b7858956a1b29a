"""``wavefocus live`` on an emulated audio interface: it sounds, outlives a lost server, and is silent in the end."""

import os
import signal
import time
from contextlib import ExitStack

import numpy as np
import pytest

from tests.lab_files import write_bank
from tests.system.lines import Lines
from tests.wire.audio_bench import AudioBench, needs_audio_server
from tests.wire.test_play import RIG
from wavefocus.drivers.process import SILENT_S

pytestmark = [pytest.mark.long, pytest.mark.timeout(300), *needs_audio_server]

RATE_HZ, TAPS, ACTUATORS = 10_000.0, 400, 3
PLACES_MM = np.array([[x, y] for y in (0.0, 4.0) for x in (0.0, 4.0, 8.0)])


@pytest.fixture
def server():
    with ExitStack() as stack:
        yield AudioBench(stack, period_frames=2048).serve()


@pytest.fixture
def lab(tmp_path):
    (tmp_path / "rig.toml").write_text(RIG, encoding="utf-8")
    green = np.random.default_rng(1).standard_normal((len(PLACES_MM), ACTUATORS, TAPS))
    write_bank(tmp_path / "plate.h5", green, PLACES_MM, band_hz=(50.0, 450.0))
    return tmp_path


def move_until(running, event, code=""):
    """Send positions until an event comes."""
    for count in range(3000):
        running.send(order="move", name="a", at_mm=[count % 9, 0.0], amplitude=0.5)
        time.sleep(0.01)
        told = running.next_of(event)
        if told is not None and (not code or told["code"] == code) and (event != "state" or told["sources"]):
            return told
    raise AssertionError(f"no {event} {code} came")


def test_with_a_real_audio_server_it_outlives_its_loss_and_is_silent_in_the_end(lab, server):
    environment = {**os.environ, **server.environment}
    rig = ("--rig", lab / "rig.toml", "--json")
    with Lines("live", lab / "plate.h5", *rig, environment=environment) as running:
        assert running.hear("ready")["actuators"] == ACTUATORS
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
