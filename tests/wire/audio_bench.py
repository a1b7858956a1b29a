"""Players on emulated interfaces, closed whatever happens."""

import os
import sys
import time
from pathlib import Path

import numpy as np
import pytest

import wavefocus
from wavefocus.drivers.audio.stream.player import StreamPlayer
from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.mocks.wire.jack_server import JackServer

ROOT = Path(wavefocus.__file__).parents[1]
CHANNELS = 21
RATE_HZ = 48_000
# Powers of two: what is divided by them is exact.
FULL_SCALE_V = tuple(2.0 ** (channel % 4) for channel in range(CHANNELS))

# One worker runs all tests that need an audio server: each takes 42 MB of shared memory, of which containers have 64.
needs_audio_server = [
    pytest.mark.xdist_group("audio server"),
    pytest.mark.may_skip("an audio server's dummy driver runs on Linux"),
    pytest.mark.skipif(sys.platform != "linux", reason="needs jackd"),
]


class AudioBench:
    """An emulated interface and the players on it.

    Opening and closing take a period for each channel: a short one is quick, a long one keeps the sound going.
    """

    def __init__(self, stack, period_frames=1024):
        self._stack = stack
        self._period_frames = period_frames

    def serve(self, **settings):
        """An interface."""
        return self._stack.enter_context(JackServer(**{"period_frames": self._period_frames, **settings}))

    def player(self, interface, **settings):
        usual = {
            "device": interface.device, "channels": CHANNELS, "channel_full_scale_v": FULL_SCALE_V,
            "interface_rate_hz": RATE_HZ, "environment": interface.environment,
        }  # fmt: skip
        opened = StreamPlayer(interface.host_api, **(usual | settings))
        self._stack.callback(opened.close)
        return opened


def undisturbed(player, take):
    """Do it again, as the engine does, where the machine was too busy to keep the sound going."""
    for _ in range(20):
        try:
            return take()
        except TransientInstrumentError as error:
            if "underflow" not in error.cause:
                raise
            player.mute()
    return take()


def played_between(server, asked_ns):
    """What left the outputs since an instant."""
    first, stop = (int(server.played.frame_at(instant_ns)) for instant_ns in (asked_ns, time.monotonic_ns()))
    return server.played.read(first, stop)


def heard_of(server, player, signals_v, sample_rate_hz=RATE_HZ):
    """What leaves the outputs between the call of play and the end of wait, nothing disturbing it."""

    def take():
        asked_ns = time.monotonic_ns()
        player.play(signals_v, sample_rate_hz)
        player.wait(30)
        return played_between(server, asked_ns)

    return undisturbed(player, take)


def sounding(frames):
    """The stretch of (channels, frames) from the first to the last frame in which anything sounds."""
    at = np.flatnonzero(frames.any(axis=0))
    return frames[:, at[0] : at[-1] + 1] if at.size else frames[:, :0]


def assert_ends_with(frames, signals_v):
    """The last that sounds is these signals; what was cut short before may just be leaving."""
    meant = as_played(signals_v)
    np.testing.assert_array_equal(sounding(frames)[:, -meant.shape[1] :], meant)


def noise(samples, channels=range(CHANNELS)):
    """Different noise for each channel, no sample of it zero."""
    generator = np.random.default_rng(5)
    return {channel: generator.uniform(0.1, 0.9, samples) * generator.choice([-1, 1], samples) for channel in channels}


def as_played(signals_v, channels=24):
    """What is heard of signals at the interface's own rate, in parts of full scale."""
    heard = np.zeros((channels, len(next(iter(signals_v.values())))), dtype=np.float32)
    for channel, volts in signals_v.items():
        heard[channel] = (volts / FULL_SCALE_V[channel]).astype(np.float32)
    return heard


def wait_until(happened, what, timeout_s=30.0):
    """Come back when it happened; a bound, not a measurement."""
    latest_s = time.monotonic() + timeout_s
    while not happened():
        assert time.monotonic() < latest_s, f"{what}: not within {timeout_s} s"
        time.sleep(0.01)


def alive(process_id):
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0]
    return state != "Z"
