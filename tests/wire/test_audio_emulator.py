"""The emulated interface itself: a clock that goes on, samples that are never silently missing, nothing left behind."""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import pytest

from tests.wire.audio_bench import RATE_HZ, AudioBench, alive, needs_audio_server, run_python, wait_until
from wavefocus.mocks.wire.jack_capture import AudioNotCapturedError, PlayedAudio, RingWriter, make_ring
from wavefocus.mocks.wire.jack_server import JackServer

PERIOD = 480
SECOND_NS = 1_000_000_000


@pytest.fixture
def ring():
    made = make_ring(2, RATE_HZ, PERIOD, 0.1)
    yield made
    made.close()


@pytest.fixture
def larger_ring():
    made = make_ring(2, RATE_HZ, PERIOD, 0.2)
    yield made
    made.close()


def left_of(server_name):
    """What a server has in shared memory, its entry among the eight of the registry included."""
    memory = Path("/dev/shm")
    registered = server_name.encode() in (memory / "jack-shm-registry").read_bytes()
    return [one.name for one in memory.glob(f"*{server_name}_*")] + ["registry"] * registered


def cycle(number):
    """The block of one cycle, no two frames alike."""
    ramp = np.arange(number * PERIOD + 1, (number + 1) * PERIOD + 1, dtype=np.float32)
    return [ramp, -ramp]


class TestOfTheRing:
    """Frames and time, without a server."""

    def written(self, ring, cycles, *, late_ns=(), xruns=(), returns=(), silent=()):
        writer, now_ns = RingWriter(ring), 5 * SECOND_NS
        for number in range(cycles):
            now_ns += dict(late_ns).get(number, 0)
            if number in xruns:
                writer.note_xrun()
            if number in returns:
                writer.note_return()
            writer.take(now_ns, [np.zeros_like(one) for one in cycle(number)] if number in silent else cycle(number))
            now_ns += SECOND_NS // 100
        return PlayedAudio(ring, lambda: True), now_ns

    def test_given_cycles_then_frames_are_read_as_written_across_the_rings_end(self, ring):
        played, _ = self.written(ring, 14)
        frames = played.read(6 * PERIOD + 7, 13 * PERIOD - 3)
        np.testing.assert_array_equal(frames[0], np.arange(6 * PERIOD + 8, 13 * PERIOD - 2))
        np.testing.assert_array_equal(frames[1], -frames[0])

    def test_given_frames_that_are_gone_then_it_says_so(self, ring):
        played, _ = self.written(ring, 30)
        with pytest.raises(AudioNotCapturedError, match="keep more seconds"):
            played.read(19 * PERIOD, 21 * PERIOD)

    def test_given_a_capture_that_died_then_it_says_so(self, ring):
        self.written(ring, 2)
        with pytest.raises(AudioNotCapturedError, match="is gone"):
            PlayedAudio(ring, lambda: False).read(0, 3 * PERIOD)

    def test_given_an_instant_then_its_frame_is_one_period_behind_and_the_slope_is_the_rate(self, ring):
        played, now_ns = self.written(ring, 5)
        assert played.frame_at(now_ns) == pytest.approx(4 * PERIOD, abs=0.5)
        for later_s in (0.001, 0.37, 7.0, -2.0):
            step = played.frame_at(now_ns + round(later_s * SECOND_NS)) - played.frame_at(now_ns)
            assert step == pytest.approx(later_s * RATE_HZ, abs=1e-3)

    def test_given_a_server_that_stood_still_then_the_clock_went_on_and_nothing_sounded(self, ring):
        played, now_ns = self.written(ring, 10, late_ns=[(7, 25_000_000)], returns=(7,))
        ((first, frames),) = played.interruptions
        assert (first, frames) == (7 * PERIOD, pytest.approx(1200, abs=1))
        assert not played.read(first, first + frames).any()
        np.testing.assert_array_equal(played.read(first + frames, first + frames + PERIOD)[0], cycle(7)[0])
        assert played.frame_at(now_ns) == pytest.approx(9 * PERIOD + frames, abs=1)

    @pytest.mark.parametrize("late_ns", [3_000_000, 25_000_000])
    @pytest.mark.parametrize("silent", [(), range(10, 14)])
    def test_given_a_cycle_that_was_late_then_it_is_told_and_sound_stays_whole_and_silence_makes_up(
        self, larger_ring, late_ns, silent
    ):
        played, now_ns = self.written(larger_ring, 14, late_ns=[(4, late_ns)], xruns=(5,), silent=silent)
        np.testing.assert_array_equal(played.read(0, 10 * PERIOD)[0], np.arange(10 * PERIOD) + 1)
        assert played.interruptions == ((5 * PERIOD, 0),)
        moved = late_ns * RATE_HZ // SECOND_NS
        made_up = larger_ring["written"] - 14 * PERIOD
        assert made_up == (pytest.approx(moved, abs=1) if silent else 0)
        assert played.frame_at(now_ns) == pytest.approx(13 * PERIOD + moved, abs=1)


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
        assert played.interruptions

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
