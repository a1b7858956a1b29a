"""Pacing, ends, mutes and underflows, by an audio server that keeps time."""

import time
from contextlib import ExitStack

import numpy as np
import pytest

from tests.wire.audio_bench import (
    FULL_SCALE_V,
    RATE_HZ,
    AudioBench,
    as_played,
    assert_ends_with,
    heard_of,
    needs_audio_server,
    noise,
    played_between,
    sounding,
    undisturbed,
)
from wavefocus.drivers.audio.resampling import converted, lead_samples, rate_ratio
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError

pytestmark = needs_audio_server
# Opening and closing take a period for each channel.
SMALL = {"channels": 2, "channel_full_scale_v": FULL_SCALE_V[:2]}


@pytest.fixture(scope="module")
def bench():
    with ExitStack() as stack:
        yield AudioBench(stack)


@pytest.fixture(scope="module")
def server(bench):
    # PortAudio divides periods of more than 1024 frames among several callbacks.
    return bench.serve(period_frames=2048)


@pytest.fixture(scope="module")
def opened(bench, server):
    return bench.player(server)


@pytest.fixture
def player(opened):
    """One player for all tests: each leaves it silent."""
    yield opened
    opened.mute()


def test_a_signal_for_every_channel_then_it_has_left_to_the_sample_when_waiting_ends(server, player):
    signals = noise(9600)
    np.testing.assert_array_equal(sounding(heard_of(server, player, signals)), as_played(signals))


def test_given_a_bank_at_another_rate_then_what_is_heard_is_the_band_limited_signal(server, player):
    time_s = np.arange(3000) / 10_000
    signal = np.hanning(3000) * np.sin(2 * np.pi * (50 + 1200 * time_s) * time_s)
    frames = sounding(heard_of(server, player, {2: signal, 20: 0.5 * signal}, 10_000))
    ratio = rate_ratio(10_000, RATE_HZ)
    meant = converted(signal, ratio)[lead_samples(ratio) :] / 4.0
    np.testing.assert_allclose(frames[2], meant[: frames.shape[1]], atol=2e-7)
    assert np.flatnonzero(frames.any(axis=1)).tolist() == [2, 20]


def test_an_overshooting_signal_is_refused_and_a_sweep_is_heard_where_it_is_played(server, player):
    sweep = np.hanning(1000) * np.sin(np.arange(1000) / 9)
    first = sounding(heard_of(server, player, {0: sweep, 12: sweep}, 10_000))
    overshooting = np.sign(np.sin(np.pi / 2 * np.arange(480) + np.pi / 4)) * np.hanning(480)
    with pytest.raises(InstrumentError, match=r"between its samples the signal of channel 4 reaches 1\.4"):
        player.play({0: np.hanning(480), 4: overshooting}, 10_000)
    frames = sounding(heard_of(server, player, {8: sweep.copy(), 12: sweep}, 10_000))  # of the same full scale
    np.testing.assert_array_equal(frames[[8, 12]], first[[0, 12]])


def test_a_play_that_cannot_be_begun_is_refused_with_the_way_out(player):
    player.play({0: np.full(RATE_HZ, 0.1)}, RATE_HZ)
    with pytest.raises(InstrumentError, match="still playing"):
        player.play({0: np.full(100, 0.1)}, RATE_HZ)
    player.mute()
    with pytest.raises(InstrumentError, match=r"goes evenly into player\.interface_rate_hz"):
        player.play({0: np.full(100, 0.1)}, 10_000.03)
    for channels, rate_hz in (([0, 0], RATE_HZ), ([], RATE_HZ), ([99], RATE_HZ), ([0], 10_000)):
        with pytest.raises(InstrumentError):
            player.begin_pieces(channels, rate_hz, 0.1)
    player.begin_pieces([0], RATE_HZ, 0.1)
    with pytest.raises(InstrumentError, match="within full scale"):
        player.add_piece(np.full((1, 10), 1e3))


def test_given_a_mute_then_silence_follows_within_two_periods_and_no_click(server, player):

    def take():
        player.play({0: np.full(5 * RATE_HZ, 0.5)}, RATE_HZ)
        time.sleep(0.3)
        asked_ns = time.monotonic_ns()
        player.mute()
        returned_ns = time.monotonic_ns()
        player.wait(1)
        first = int(server.played.frame_at(asked_ns))
        return server.played.read(first, int(server.played.frame_at(returned_ns)) + RATE_HZ // 2)[0]

    frames = undisturbed(player, take)
    assert frames[0] == 0.5
    assert np.abs(np.diff(frames)).max() < 0.02
    # one period may be under way, and one more is in the buffer
    assert np.flatnonzero(frames)[-1] < 3 * 2048 + 0.05 * RATE_HZ


def test_server_that_stood_still_then_waiting_says_underflow_and_next_play_is_good(server, player):
    player.play({0: np.full(20 * RATE_HZ, 0.25)}, RATE_HZ)
    time.sleep(0.2)
    server.underflow()
    with pytest.raises(TransientInstrumentError, match=r"underflow.*void.*repeat it") as caught:
        player.wait(30)
    assert caught.value.instrument == "player wavefocus interface"
    assert caught.value.operation == "playing on channels [0]"
    with pytest.raises(TransientInstrumentError, match="underflow"):
        player.wait(30)  # it stays so until something else is played
    signals = noise(4800)
    assert_ends_with(heard_of(server, player, signals), signals)


def test_given_a_closed_player_then_the_outputs_are_silent_and_free_for_the_next(bench, server):
    player = bench.player(server, **SMALL)
    player.play({0: np.full(60 * RATE_HZ, 0.5)}, RATE_HZ)
    time.sleep(0.3)
    player.close()
    for refused in (player.identify, player.reconnect, lambda: player.wait(1)):
        with pytest.raises(InstrumentError, match="it is closed"):
            refused()
    now = int(server.played.frame_at(time.monotonic_ns()))
    assert not server.played.read(now, now + RATE_HZ // 4).any()
    signals = noise(4800, channels=(0, 1))
    player = bench.player(server, **SMALL)
    np.testing.assert_array_equal(sounding(heard_of(server, player, signals)), as_played(signals))


def test_a_signal_in_pieces_leaves_to_the_sample_and_one_too_late_is_told(server, player):
    signals = noise(12_000, channels=(3, 0))
    volts = np.stack([signals[3], signals[0]])

    def take():
        asked_ns = time.monotonic_ns()
        player.begin_pieces([3, 0], RATE_HZ, 0.1)
        for piece in np.array_split(volts, 17, axis=1):
            player.add_piece(piece)
        player.end_pieces()
        player.wait(30)
        return played_between(server, asked_ns)

    np.testing.assert_array_equal(sounding(undisturbed(player, take)), as_played(signals))
    player.begin_pieces([0, 1], RATE_HZ, 0.02)
    player.add_piece(np.full((2, 4800), 0.1))
    with pytest.raises(TransientInstrumentError, match="underflow"):
        player.wait(30)
    player.begin_pieces([0], RATE_HZ, 0.02)
    player.mute()
    player.wait(1)
