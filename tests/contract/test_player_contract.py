"""What every player must do."""

import numpy as np
import pytest

from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Player, RecordLabel, RecordRequest


def tone(bench, seconds=0.2, volts=0.5):
    time_s = np.arange(round(seconds * bench.sample_rate_hz)) / bench.sample_rate_hz
    return volts * np.sin(2 * np.pi * 200 * time_s)


def asked_for(bench, seconds):
    samples = round(seconds * bench.sample_rate_hz)
    return RecordRequest(samples, bench.sample_rate_hz, bench.range_v, RecordLabel(0, 1, 0))


def recorded_reference(bench, signals_v, *, mute_after_s=None):
    # Opened before anything is timed: with real drivers that takes seconds.
    recorder, player = bench.instruments.recorder, bench.instruments.player

    def take():
        duration_s = len(next(iter(signals_v.values()))) / bench.sample_rate_hz + 2 * bench.latency_s
        recorder.start(asked_for(bench, duration_s))
        player.play(signals_v, bench.sample_rate_hz)
        if mute_after_s is not None:
            bench.instruments.clock.sleep(mute_after_s)
            player.mute()
        player.wait(5.0)
        return recorder.read(10.0).volts[0].astype(np.float64)

    return bench.undisturbed(take)


def test_given_a_player_then_it_has_the_role_a_name_and_its_limits(bench):
    player = bench.instruments.player
    assert isinstance(player, Player)
    assert player.identify().strip()
    assert player.identity.product.strip()
    assert player.channels > bench.loopback_channel
    assert player.full_scale_v > 0


def test_given_a_signal_then_waiting_takes_its_length(bench):
    clock = bench.instruments.clock

    def take():
        before_s = clock.now_s()
        bench.instruments.player.play({bench.actuator_channel: tone(bench)}, bench.sample_rate_hz)
        bench.instruments.player.wait(5.0)
        return clock.now_s() - before_s

    assert bench.undisturbed(take) >= 0.2


def test_given_nothing_to_play_then_waiting_returns_and_in_too_little_time_it_fails(bench):
    player, clock = bench.instruments.player, bench.instruments.clock
    before_s = clock.now_s()
    player.wait(1.0)
    assert clock.now_s() - before_s < 1.0
    player.play({bench.actuator_channel: tone(bench)}, bench.sample_rate_hz)
    with pytest.raises(InstrumentError):
        player.wait(0.01)


def test_given_a_signal_then_only_its_channel_sounds(bench):
    silent = recorded_reference(bench, {bench.actuator_channel: tone(bench)})
    assert np.abs(silent).max() < 0.05


def test_given_full_scale_then_it_is_played_and_no_more_is(bench):
    player = bench.instruments.player
    channel = bench.actuator_channel

    def take():
        player.play({channel: np.full(10, player.full_scale_v)}, bench.sample_rate_hz)
        player.wait(5.0)

    bench.undisturbed(take)
    with pytest.raises(InstrumentError):
        player.play({channel: np.full(10, 1.01 * player.full_scale_v)}, bench.sample_rate_hz)


def with_sample(bench, wrong):
    volts = tone(bench)
    volts[7] = wrong
    return {bench.actuator_channel: volts}


WRONG_SIGNALS = {
    "not a number": lambda bench: with_sample(bench, np.nan),
    "infinite": lambda bench: with_sample(bench, np.inf),
    "unknown channel": lambda bench: {bench.instruments.player.channels: tone(bench)},
    "unlike lengths": lambda bench: {bench.actuator_channel: np.zeros(100), bench.loopback_channel: np.zeros(101)},
    "no length": lambda bench: {bench.actuator_channel: np.zeros(0)},
}


@pytest.mark.parametrize("wrong", WRONG_SIGNALS)
def test_signals_that_cannot_be_played_then_it_says_who_what_why_and_what_to_do(bench, wrong):
    with pytest.raises(InstrumentError) as caught:
        bench.instruments.player.play(WRONG_SIGNALS[wrong](bench), bench.sample_rate_hz)
    error = caught.value
    assert "player" in error.instrument
    assert all(text.strip() for text in (error.operation, error.cause, error.remedy))


def test_given_a_mute_then_the_rest_is_silent_and_the_wait_short(bench):
    sounding_s = bench.latency_s + 0.1
    volts = tone(bench, sounding_s + bench.latency_s + 0.2)
    reference = recorded_reference(bench, {bench.loopback_channel: volts}, mute_after_s=sounding_s)
    quiet = reference[round((sounding_s + bench.latency_s) * bench.sample_rate_hz) :]
    assert np.abs(reference).max() > 0.4
    assert np.abs(quiet).max() < 0.05


def test_given_a_signal_changed_after_the_call_then_what_was_given_is_played(bench):
    recorder, player = bench.instruments.recorder, bench.instruments.player

    def take():
        volts = tone(bench)
        recorder.start(asked_for(bench, 0.2 + 2 * bench.latency_s))
        player.play({bench.loopback_channel: volts}, bench.sample_rate_hz)
        volts[:] = 0
        player.wait(5.0)
        return recorder.read(10.0).volts[0]

    assert np.abs(bench.undisturbed(take)).max() == pytest.approx(0.5, rel=0.02)


def test_given_any_state_then_muting_is_safe(bench):
    player = bench.instruments.player
    for _ in range(2):
        player.mute()
        player.play({bench.actuator_channel: tone(bench)}, bench.sample_rate_hz)
        player.mute()


def test_given_a_closed_player_then_closing_is_harmless_and_playing_is_refused(bench):
    player = bench.instruments.player
    player.close()
    player.close()
    with pytest.raises(InstrumentError):
        player.play({bench.actuator_channel: tone(bench)}, bench.sample_rate_hz)
