"""Pacing, ends, mutes, underflows and losses, by an audio server that keeps time."""

import os
import signal
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress
from pathlib import Path

import numpy as np
import pytest

import wavefocus
from tests.system.lines import wait_until
from tests.wire.audio_bench import CHANNELS, FULL_SCALE_V, RATE_HZ, AudioBench, needs_audio_server, sounding
from wavefocus.drivers.audio.resampling import converted, lead_samples, rate_ratio
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError

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


def alive(process_id):
    try:
        os.kill(process_id, 0)
    except ProcessLookupError:
        return False
    state = Path(f"/proc/{process_id}/stat").read_text().rpartition(")")[2].split()[0]
    return state != "Z"


def start_playing(player):
    player.play({0: np.full(60 * RATE_HZ, 0.5)}, RATE_HZ)
    time.sleep(0.3)


def test_a_signal_for_every_channel_then_it_has_left_to_the_sample_when_waiting_ends(server, player):
    signals = noise(9600)
    np.testing.assert_array_equal(sounding(heard_of(server, player, signals)), as_played(signals))


def test_given_a_bank_at_another_rate_then_what_is_heard_is_the_band_limited_signal(server, player):
    time_s = np.arange(3000) / 10_000
    signal_v = np.hanning(3000) * np.sin(2 * np.pi * (50 + 1200 * time_s) * time_s)
    frames = sounding(heard_of(server, player, {2: signal_v, 20: 0.5 * signal_v}, 10_000))
    ratio = rate_ratio(10_000, RATE_HZ)
    meant = converted(signal_v, ratio)[lead_samples(ratio) :] / 4.0
    np.testing.assert_allclose(frames[2], meant[: frames.shape[1]], atol=2e-7)
    assert np.flatnonzero(frames.any(axis=1)).tolist() == [2, 20]
    again = sounding(heard_of(server, player, {10: signal_v.copy(), 2: signal_v}, 10_000))  # of the same full scale
    np.testing.assert_array_equal(again[[10, 2]], frames[[2, 2]])


def test_a_play_that_cannot_be_begun_is_refused_with_the_way_out(player):
    overshooting = np.sign(np.sin(np.pi / 2 * np.arange(480) + np.pi / 4)) * np.hanning(480)
    with pytest.raises(InstrumentError, match=r"between its samples the signal of channel 4 reaches 1\.4"):
        player.play({0: np.hanning(480), 4: overshooting}, 10_000)
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
        begun_ns = time.monotonic_ns()
        player.play({0: np.full(5 * RATE_HZ, 0.5)}, RATE_HZ)
        wait_until(lambda: np.any(played_between(server, begun_ns)[0]), "sound")
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
    start_playing(player)
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
    start_playing(player)
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


# -- losses: every call comes back, every process ends, every output is silent --------------------------


PLAYING = """
import sys, time
import numpy as np
from wavefocus.drivers.audio.stream.player import StreamPlayer
player = StreamPlayer("JACK Audio Connection Kit", "wavefocus interface", channels=21,
                      channel_full_scale_v=[1.0] * 21, interface_rate_hz=48_000)
player.play({0: np.full(60 * 48_000, 0.5)}, 48_000)
print(player.process_id, flush=True)
sys.stdin.readline()
"""


@pytest.fixture
def slow():
    """Interfaces and players of long periods."""
    with ExitStack() as stack:
        yield AudioBench(stack, period_frames=4096)


def loss_of(player):
    """The error of a player that is about to be lost, underflows of a busy machine apart."""
    while True:
        try:
            player.wait(90)
            start_playing(player)
        except InstrumentLostError as lost:
            return lost
        except TransientInstrumentError as underflow:
            if "underflow" not in underflow.cause:
                raise
            player.mute()
            with suppress(InstrumentLostError):
                start_playing(player)


@pytest.mark.nightly
def test_device_is_away_then_reconnecting_says_so_until_it_is_back_and_then_it_plays(slow):
    server = slow.serve()
    player = slow.player(server)
    start_playing(player)
    server.kill()
    lost = loss_of(player)
    assert "unplugged, switched off, or its server ended" in lost.cause
    assert "then reconnect" in lost.remedy
    assert (lost.instrument, lost.operation) == ("player wavefocus interface", "playing on channels [0]")
    player.mute()
    for refused in (lambda: start_playing(player), player.identify):
        with pytest.raises(InstrumentLostError, match="its server ended"):
            refused()
    for _ in range(2):
        with pytest.raises(InstrumentLostError, match="there is no host API 'JACK Audio Connection Kit'"):
            player.reconnect()
        with pytest.raises(InstrumentLostError):
            start_playing(player)
    server.restart(channels=4)
    with pytest.raises(InstrumentError, match=r"needs 21 channels, 'wavefocus interface' .* 4 channels") as refused:
        player.reconnect()
    assert not isinstance(refused.value, InstrumentLostError)
    server.kill()
    server.restart()
    player.reconnect()
    signals = noise(4800)
    assert_ends_with(heard_of(server, player, signals), signals)
    server.kill()  # while nothing plays
    wait_until(lambda: not alive(player.process_id), "the end of the stream's process")
    with pytest.raises(InstrumentLostError):
        heard_of(server, player, signals)


@pytest.mark.nightly
def test_given_an_interface_that_comes_a_moment_later_then_it_is_opened(slow):
    server = slow.serve()
    server.kill()
    switched_on = threading.Timer(1.0, server.restart)
    switched_on.start()
    signals = noise(4800)
    assert_ends_with(heard_of(server, slow.player(server), signals), signals)
    switched_on.join()


@pytest.mark.nightly
def test_ctrl_c_leaves_a_stream_alone_and_reconnecting_mutes_it_and_opens_it_anew(slow):
    player = slow.player(slow.serve())
    start_playing(player)
    before = player.process_id
    assert os.getpgid(before) != os.getpgid(0)
    os.kill(before, signal.SIGINT)
    player.mute()
    player.wait(1)
    assert player.process_id == before
    assert alive(before)
    start_playing(player)
    player.reconnect()
    player.wait(1)
    assert player.process_id != before
    assert not alive(before)
    assert "wavefocus interface" in player.identify()


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("number", "cause"), [(signal.SIGKILL, "ended with code -9"), (signal.SIGSTOP, "and was killed")]
)
def test_a_stream_process_that_is_killed_or_hangs_then_a_mute_silences_it(slow, number, cause):
    player = slow.player(slow.serve())
    start_playing(player)
    os.kill(player.process_id, number)
    player.mute()
    wait_until(lambda: not alive(player.process_id), "the end of the stream's process")
    assert cause in loss_of(player).cause


@pytest.mark.nightly
def test_given_a_server_that_freezes_then_every_call_says_so_and_closing_ends_it(slow):
    server = slow.serve()
    player = slow.player(server)
    start_playing(player)
    stream_process = player.process_id
    server.freeze()
    assert "frozen: it asked for nothing more for" in loss_of(player).cause
    for call in (lambda: start_playing(player), lambda: player.wait(90)):
        with pytest.raises(InstrumentLostError, match="frozen: it asked for nothing more for"):
            call()
    with pytest.raises(InstrumentLostError):
        player.reconnect()
    player.mute()
    player.close()
    assert not alive(stream_process)


@pytest.mark.nightly
def test_parent_that_is_killed_in_play_then_stream_ends_and_outputs_are_silent(slow):
    server = slow.serve()
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    environment = {**os.environ, **server.environment, "PYTHONPATH": str(Path(wavefocus.__file__).parents[1])}
    command = [sys.executable, "-W", "error", "-c", PLAYING]
    with subprocess.Popen(command, env=environment, text=True, **pipes) as program:
        stream_process = int(program.stdout.readline())

        def latest():
            now = int(server.played.frame_at(time.monotonic_ns()))
            return server.played.read(now - 2048, now)

        wait_until(lambda: latest().any(), "sound")
        program.kill()
        program.wait(60)
        wait_until(lambda: not latest().any(), "silence")
        wait_until(lambda: not alive(stream_process), "the end of the stream's process")
    assert not latest().any()
