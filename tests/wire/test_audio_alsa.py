"""Routing and samples, by an ALSA device that writes a file."""

from __future__ import annotations

import sys
from contextlib import ExitStack

import numpy as np
import pytest

from drivers.errors import InstrumentError
from mocks.wire.jack_server import AlsaFile
from tests.wire.audio_bench import CHANNELS, FULL_SCALE_V, RATE_HZ, AudioBench, as_played, noise, sounding

pytestmark = [
    pytest.mark.may_skip("ALSA is Linux's"),
    pytest.mark.skipif(sys.platform != "linux", reason="needs ALSA"),
]


@pytest.fixture
def bench():
    with ExitStack() as stack:
        yield AudioBench(stack)


def heard(interface, player, channels=CHANNELS):
    player.close()
    return interface.played(channels)


def test_given_a_signal_for_every_channel_then_each_has_its_own_to_the_sample(bench, tmp_path):
    interface, signals = AlsaFile(tmp_path), noise(3000, range(24))
    player = bench.player(interface, channels=24, channel_full_scale_v=(2.0,) * 24)
    player.play(signals, RATE_HZ)
    player.wait(10)
    meant = np.stack([(signals[channel] / 2.0).astype(np.float32) for channel in range(24)])
    np.testing.assert_array_equal(sounding(heard(interface, player, 24)), meant)


def test_given_a_full_scale_for_each_channel_then_equal_voltages_are_unlike_parts_of_it(bench, tmp_path):
    interface = AlsaFile(tmp_path)
    player = bench.player(interface)
    player.play({channel: np.full(100, 0.75) for channel in range(CHANNELS)}, RATE_HZ)
    player.wait(10)
    levels = sounding(heard(interface, player))
    np.testing.assert_array_equal(levels, np.tile(0.75 / np.array(FULL_SCALE_V, np.float32)[:, None], (1, 100)))
    assert player.full_scale_v == min(FULL_SCALE_V)


def test_given_a_signal_that_was_refused_then_the_next_play_of_its_neighbours_is_whole(bench, tmp_path):
    interface, signals = AlsaFile(tmp_path), noise(480, (0, 1))
    player = bench.player(interface)
    overshooting = np.sign(np.sin(np.pi / 2 * np.arange(480) + np.pi / 4)) * np.hanning(480)
    with pytest.raises(InstrumentError, match=r"between its samples the signal of channel 4 reaches 1\.4"):
        player.play({0: np.hanning(480), 4: overshooting}, 10_000)
    player.play({0: np.hanning(480), 4: np.hanning(480)}, 10_000)
    player.wait(10)
    player.play(signals, RATE_HZ)
    player.wait(10)
    frames = sounding(heard(interface, player))
    np.testing.assert_array_equal(frames[:, -480:], as_played(signals, CHANNELS))
    assert np.abs(frames[4]).max() == pytest.approx(1.0, abs=1e-3)


def test_given_an_output_without_a_clock_then_it_is_held_to_real_time(bench, tmp_path):
    interface = AlsaFile(tmp_path)
    player = bench.player(interface)
    player.play({0: np.full(RATE_HZ, 0.5)}, RATE_HZ)
    player.wait(20)
    frames = heard(interface, player).shape[1]
    # It takes a hundred times as many in that time when it is not held.
    assert frames < 10 * RATE_HZ
