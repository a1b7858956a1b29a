"""What every player must do."""

import numpy as np
import pytest

from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Player, RecordLabel, RecordRequest


def tone(bench, seconds=0.2):
    time_s = np.arange(round(seconds * bench.sample_rate_hz)) / bench.sample_rate_hz
    return 0.5 * np.sin(2 * np.pi * 200 * time_s)


def recorded_reference(bench, channel, volts, *, mute_after_s=None):
    """What the loopback records of a signal, which is changed once it was handed over."""
    # Opened before anything is timed: with real drivers that takes seconds.
    recorder, player = bench.instruments.recorder, bench.instruments.player

    def take():
        samples = round(len(volts) + 2 * bench.latency_s * bench.sample_rate_hz)
        recorder.start(RecordRequest(samples, bench.sample_rate_hz, bench.range_v, RecordLabel(0, 1, 0)))
        given = volts.copy()
        player.play({channel: given}, bench.sample_rate_hz)
        given[:] = 0
        if mute_after_s is not None:
            bench.instruments.clock.sleep(mute_after_s)
            player.mute()
        player.wait(5.0)
        return recorder.read(10.0).volts[0].astype(np.float64)

    return bench.undisturbed(take)


def test_waiting_takes_the_signals_length_or_no_time_and_in_too_little_time_it_fails(bench):
    player, clock = bench.instruments.player, bench.instruments.clock
    assert isinstance(player, Player)
    assert player.identify().strip()
    assert player.identity.product.strip()
    assert player.channels > bench.loopback_channel
    assert player.full_scale_v > 0

    def take():
        before_s = clock.now_s()
        player.play({bench.actuator_channel: tone(bench)}, bench.sample_rate_hz)
        player.wait(5.0)
        return clock.now_s() - before_s

    assert bench.undisturbed(take) >= 0.2
    before_s = clock.now_s()
    player.wait(1.0)
    assert clock.now_s() - before_s < 1.0
    player.play({bench.actuator_channel: tone(bench)}, bench.sample_rate_hz)
    with pytest.raises(InstrumentError):
        player.wait(0.01)


def test_given_a_signal_then_only_its_channel_sounds_as_it_was_when_it_was_given(bench):
    sounds, silent = (
        np.abs(recorded_reference(bench, channel, tone(bench))).max()
        for channel in (bench.loopback_channel, bench.actuator_channel)
    )
    assert sounds == pytest.approx(0.5, rel=0.02)
    assert silent < 0.05


def test_given_full_scale_then_it_is_played_and_no_more_is(bench):
    player = bench.instruments.player
    channel = bench.actuator_channel

    def take():
        player.play({channel: np.full(10, player.full_scale_v)}, bench.sample_rate_hz)
        player.wait(5.0)

    bench.undisturbed(take)
    with pytest.raises(InstrumentError):
        player.play({channel: np.full(10, 1.01 * player.full_scale_v)}, bench.sample_rate_hz)


@pytest.mark.parametrize("wrong", ["not a number", "infinite", "unknown channel", "unlike lengths", "no length"])
def test_signals_that_cannot_be_played_then_it_says_who_what_why_and_what_to_do(bench, wrong):
    channel, volts = bench.actuator_channel, tone(bench)
    signals = {
        "not a number": {channel: np.where(np.arange(len(volts)) == 7, np.nan, volts)},
        "infinite": {channel: np.where(np.arange(len(volts)) == 7, np.inf, volts)},
        "unknown channel": {bench.instruments.player.channels: volts},
        "unlike lengths": {channel: np.zeros(100), bench.loopback_channel: np.zeros(101)},
        "no length": {channel: np.zeros(0)},
    }
    with pytest.raises(InstrumentError) as caught:
        bench.instruments.player.play(signals[wrong], bench.sample_rate_hz)
    bench.check_sentence(caught.value, "player")


def test_given_a_mute_in_any_state_then_the_rest_is_silent_and_the_wait_short(bench):
    player, sounding_s = bench.instruments.player, bench.latency_s + 0.1
    for _ in range(2):
        player.mute()
        player.play({bench.actuator_channel: tone(bench)}, bench.sample_rate_hz)
        player.mute()
    volts = tone(bench, sounding_s + bench.latency_s + 0.2)
    reference = recorded_reference(bench, bench.loopback_channel, volts, mute_after_s=sounding_s)
    quiet = reference[round((sounding_s + bench.latency_s) * bench.sample_rate_hz) :]
    assert np.abs(reference).max() > 0.4
    assert np.abs(quiet).max() < 0.05


def test_given_a_closed_player_then_closing_is_harmless_and_playing_is_refused(bench):
    player = bench.instruments.player
    player.close()
    player.close()
    with pytest.raises(InstrumentError):
        player.play({bench.actuator_channel: tone(bench)}, bench.sample_rate_hz)
