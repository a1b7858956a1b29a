"""Players on emulated interfaces, closed whatever happens."""

import numpy as np
import pytest

from tests.system.lines import of_linux
from wavefocus.drivers.audio.stream.player import StreamPlayer
from wavefocus.mocks.wire.jack_server import JackServer

CHANNELS = 21
RATE_HZ = 48_000
# Powers of two: what is divided by them is exact.
FULL_SCALE_V = tuple(2.0 ** (channel % 4) for channel in range(CHANNELS))

# One worker runs all tests that need an audio server: each takes 42 MB of shared memory, of which containers have 64.
needs_audio_server = [pytest.mark.xdist_group("audio server"), *of_linux("jackd's dummy driver runs on Linux")]


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


def sounding(frames):
    """The stretch of (channels, frames) from the first to the last frame in which anything sounds."""
    at = np.flatnonzero(frames.any(axis=0))
    return frames[:, at[0] : at[-1] + 1] if at.size else frames[:, :0]
