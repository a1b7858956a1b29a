"""Devices that vanish or hang, parents that die: every call comes back, every process ends, every output is silent."""

import os
import signal
import subprocess
import sys
import time
from contextlib import ExitStack, suppress

import numpy as np
import pytest

from tests.wire.audio_bench import (
    RATE_HZ,
    ROOT,
    AudioBench,
    alive,
    assert_ends_with,
    heard_of,
    needs_audio_server,
    noise,
    wait_until,
)
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError

pytestmark = [pytest.mark.nightly, *needs_audio_server]

PLAYING = """
import sys, time
import numpy as np
from wavefocus.drivers.audio.stream.player import StreamPlayer
player = StreamPlayer("JACK Audio Connection Kit", "wavefocus interface", channels=21,
                      channel_full_scale_v=[1.0] * 21, interface_rate_hz=48_000)
player.play({0: np.full(60 * 48_000, 0.5)}, 48_000)
print(player.process_id, flush=True)
"""
# A program that nobody tidies up: it meets the loss, prints it and ends.
MEETING_THE_LOSS = (
    PLAYING
    + """
from wavefocus.drivers.errors import InstrumentLostError, TransientInstrumentError
sys.stdin.readline()
try:
    player.wait(90)
except TransientInstrumentError:
    pass
except InstrumentLostError as error:
    print(error.cause, flush=True)
time.sleep(1)
for call in (lambda: player.play({0: np.ones(9)}, 48_000), lambda: player.wait(90), player.reconnect):
    try:
        call()
    except InstrumentLostError as error:
        print(error.cause, flush=True)
player.mute()
player.close()
print("closed", flush=True)
"""
)


@pytest.fixture
def bench():
    with ExitStack() as stack:
        yield AudioBench(stack, period_frames=4096)


def program_of(text, server):
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    environment = {**os.environ, **server.environment, "PYTHONPATH": str(ROOT)}
    return subprocess.Popen([sys.executable, "-W", "error", "-c", text], env=environment, text=True, **pipes)


def start_playing(player):
    player.play({0: np.full(60 * RATE_HZ, 0.5)}, RATE_HZ)
    time.sleep(0.2)


def loss_of(player):
    """The error of a player that is about to be lost, underflows of a busy machine apart."""
    while True:
        try:
            player.wait(90)
            player.play({0: np.full(60 * RATE_HZ, 0.5)}, RATE_HZ)
        except InstrumentLostError as lost:
            return lost
        except TransientInstrumentError as underflow:
            if "underflow" not in underflow.cause:
                raise
            player.mute()
            with suppress(InstrumentLostError):
                player.play({0: np.full(60 * RATE_HZ, 0.5)}, RATE_HZ)


def test_device_is_away_then_reconnecting_says_so_until_it_is_back_and_then_it_plays(bench):
    server = bench.serve()
    player = bench.player(server)
    start_playing(player)
    server.kill()
    lost = loss_of(player)
    assert "unplugged, switched off, or its server ended" in lost.cause
    assert "then reconnect" in lost.remedy
    assert (lost.instrument, lost.operation) == ("player wavefocus interface", "playing on channels [0]")
    player.mute()
    for refused in (lambda: player.play({0: np.full(9, 0.5)}, RATE_HZ), player.identify):
        with pytest.raises(InstrumentLostError, match="its server ended"):
            refused()
    for _ in range(2):
        with pytest.raises(InstrumentLostError, match="there is no host API 'JACK Audio Connection Kit'"):
            player.reconnect()
        with pytest.raises(InstrumentLostError):
            player.play({0: np.full(9, 0.5)}, RATE_HZ)
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


def test_ctrl_c_leaves_a_stream_alone_and_reconnecting_mutes_it_and_opens_it_anew(bench):
    player = bench.player(bench.serve())
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


@pytest.mark.parametrize(
    ("number", "cause"), [(signal.SIGKILL, "ended with code -9"), (signal.SIGSTOP, "and was killed")]
)
def test_a_stream_process_that_is_killed_or_hangs_then_a_mute_silences_it(bench, number, cause):
    player = bench.player(bench.serve())
    start_playing(player)
    os.kill(player.process_id, number)
    player.mute()
    wait_until(lambda: not alive(player.process_id), "the end of the stream's process")
    assert cause in loss_of(player).cause


@pytest.mark.parametrize("fault", ["kill", "freeze"])
def test_given_a_loss_then_a_program_gets_its_errors_closes_and_exits(bench, fault):
    server = bench.serve()
    with program_of(MEETING_THE_LOSS, server) as program:
        stream_process = int(program.stdout.readline())
        getattr(server, fault)()
        output, errors = program.communicate("go\n", timeout=90)
    assert errors == ""
    assert program.returncode == 0
    told = output.strip().splitlines()
    assert all(("frozen: it asked for nothing more for" if fault == "freeze" else "its server ended") in line
               for line in told[:-2])  # fmt: skip
    assert len(told) >= 4
    assert told[-1] == "closed"
    assert not alive(stream_process)


@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_parent_that_dies_in_play_then_stream_ends_and_outputs_are_silent(bench, end):
    server = bench.serve()
    with program_of(PLAYING + "time.sleep(60)", server) as program:
        stream_process = int(program.stdout.readline())
        heard = server.played

        def latest():
            now = int(heard.frame_at(time.monotonic_ns()))
            return heard.read(now - 2048, now)

        wait_until(lambda: latest().any(), "sound")
        program.send_signal(end)
        program.wait(60)
        wait_until(lambda: not latest().any(), "silence")
        wait_until(lambda: not alive(stream_process), "the end of the stream's process")
    assert not latest().any()
