"""The emulated interface itself: a clock that goes on, samples that are never silently missing, nothing left behind."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.wire.audio_bench import RATE_HZ, AudioBench, alive, needs_audio_server, run_python, wait_until
from wavefocus.mocks.wire.jack_server import JackServer

PERIOD = 480
SECOND_NS = 1_000_000_000


def left_of(server_name):
    """What a server has in shared memory, its entry among the eight of the registry included."""
    memory = Path("/dev/shm")
    registered = server_name.encode() in (memory / "jack-shm-registry").read_bytes()
    return [one.name for one in memory.glob(f"*{server_name}_*")] + ["registry"] * registered


class TestOfTheServer:
    """Frames and time, with one."""

    pytestmark = needs_audio_server

    @pytest.fixture
    def bench(self):
        with ExitStack() as stack:
            yield AudioBench(stack)

    def test_given_a_server_that_freezes_and_is_killed_then_its_clock_goes_on_in_silence(self, bench):
        server = bench.serve()
        played = server.played
        assert (played.rate_hz, played.channels) == (RATE_HZ, 24)

        def latest(frames):
            now = int(played.frame_at(time.monotonic_ns()))
            return played.read(now - frames, now)

        assert latest(100).shape == (24, 100)
        before_ns = time.monotonic_ns()
        before = played.frame_at(before_ns)
        server.freeze()
        time.sleep(0.05)
        assert not latest(10).any()
        server.thaw()
        time.sleep(0.05)
        assert latest(100).shape == (24, 100)
        server.kill()
        time.sleep(0.05)
        assert not latest(10).any()
        server.restart()
        after_ns = time.monotonic_ns()
        passed_s = (played.frame_at(after_ns) - before) / RATE_HZ
        assert passed_s == pytest.approx((after_ns - before_ns) / SECOND_NS, abs=0.1)

    def test_given_a_server_that_was_killed_then_nothing_of_it_is_left_behind(self):
        with JackServer(period_frames=1024, channels=2) as server:
            name = server.environment["JACK_DEFAULT_SERVER"]
            assert left_of(name)
            server.kill()
            assert left_of(name)
        assert not left_of(name)

    def test_given_a_program_that_dies_then_its_server_goes_too(self):
        code = (
            "import os, signal\n"
            "from wavefocus.mocks.wire.jack_server import JackServer\n"
            "server = JackServer(period_frames=1024)\n"
            "print(server.process_id, server.server_process_id, flush=True)\n"
            "os.kill(os.getpid(), signal.SIGKILL)\n"
        )
        _, output, _ = run_python(code, {})
        for process_id in map(int, output.split()):
            wait_until(lambda process_id=process_id: not alive(process_id), "the end of the emulated interface")
