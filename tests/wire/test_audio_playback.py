"""Periods as a stream asks for them, and the signals in them at the interface's rate."""

from fractions import Fraction

import numpy as np
import pytest

from wavefocus.drivers.audio.resampling import HALF_STEP, converted, converted_frames, lead_samples, rate_ratio
from wavefocus.drivers.audio.stream import FADE_S, PLAYED, UNDERFLOW, Playback, StreamPlay

RATE_HZ = 48_000
PERIOD = 512
CHANNELS = 3
RAMP = np.linspace(0.1, 0.9, 100 * PERIOD, dtype=np.float32)


class Host:
    """Asks for periods as an audio host does, on a clock of its own."""

    def __init__(self, *, pieces=1):
        self.playback = Playback(RATE_HZ, latency_s=0.0)
        self.heard = np.zeros((0, CHANNELS), dtype=np.float32)
        self.now_s = 100.0
        self._pieces = pieces

    def periods(self, count, *, flagged=False, late_s=0.0):
        self.now_s += late_s
        for _ in range(count):
            for _ in range(self._pieces):
                out = np.full((PERIOD // self._pieces, CHANNELS), np.nan, dtype=np.float32)
                self.playback.fill(out, self.now_s, flagged=flagged)
                self.heard = np.concatenate([self.heard, out])
                self.now_s += 1e-5
            self.now_s += PERIOD / RATE_HZ - 1e-5 * self._pieces

    def ends(self):
        """Numbers and outcomes of the plays that have ended, and what was noticed of the latest."""
        ends = []
        while not self.playback.events.empty():
            kind, *event = self.playback.events.get()
            if kind == "ended":
                *ended, self.notice = event
                ends.append(tuple(ended))
        return ends


def signal_play(number, samples):
    """A play of one channel, all of which is there from the start."""
    play = StreamPlay(number, (0,), 96, lambda taken: None)
    play.add(samples[:, None])
    play.end()
    return play


@pytest.mark.parametrize("clean_periods", [0, 1, 3, 4, 8])
def test_underflow_flag_from_first_period_to_after_last_then_play_is_void(clean_periods):
    host = Host()
    host.periods(1)
    host.playback.start(signal_play(1, RAMP[: 3 * PERIOD]))
    host.periods(clean_periods)
    host.periods(1, flagged=True)
    host.playback.start(signal_play(2, RAMP[:PERIOD]))
    host.periods(6)
    assert host.ends() == [(1, UNDERFLOW if clean_periods < 8 else PLAYED), (2, PLAYED)]


@pytest.mark.parametrize("pieces", [1, 4])
def test_uneven_callbacks_in_time_are_good_and_a_host_that_stood_still_is_not(pieces):
    even, still = Host(pieces=pieces), Host(pieces=pieces)
    even.playback.start(signal_play(1, RAMP))
    for late_s in np.random.default_rng(3).uniform(0, PERIOD / RATE_HZ, 110):
        even.periods(1, late_s=late_s)
        even.now_s -= late_s
    assert even.ends() == [(1, PLAYED)]
    still.playback.start(signal_play(1, RAMP[: 20 * PERIOD]))
    still.periods(5)
    still.periods(15, late_s=0.1)  # and does not say so
    assert still.ends() == [(1, UNDERFLOW)]


def test_given_a_sound_clock_200_ppm_slow_for_ten_minutes_then_the_play_is_good():
    host = Host()
    host.playback.start(signal_play(1, np.zeros(600 * RATE_HZ, np.float32)))
    out = np.zeros((48_000, CHANNELS), dtype=np.float32)
    for _ in range(605):
        host.playback.fill(out, host.now_s, flagged=False)
        host.now_s += 1.0002
    assert host.ends() == [(1, PLAYED)]


def test_a_piece_that_comes_too_late_then_it_fades_and_the_play_ends_as_an_underflow():
    host = Host()
    play = StreamPlay(1, (2, 0), 96, host.playback.events.put)
    values = np.linspace(0.2, 0.8, 8 * PERIOD, dtype=np.float32).reshape(-1, 2)
    pieces = np.split(values, [3 * PERIOD])
    play.add(pieces[0])
    host.playback.start(play)
    host.periods(3)
    play.add(pieces[1])
    assert host.ends() == []  # its last sound is still on its way to the outputs
    host.periods(6)
    fade = round(FADE_S * RATE_HZ)
    np.testing.assert_array_equal(host.heard[: 2 * PERIOD, [2, 0]], pieces[0][: 2 * PERIOD])
    assert np.abs(np.diff(host.heard[:, 0])).max() < 0.05
    assert not host.heard[2 * PERIOD + fade :].any()
    assert host.ends() == [(1, UNDERFLOW)]
    assert host.notice == "the next piece of the signal did not come in time"


@pytest.mark.parametrize("factor", [44_100 / 48_000, 1.0, 192_000 / 44_100])
def test_given_an_interface_at_another_rate_then_its_callbacks_tell_it(factor):
    playback, now_s = Playback(48_000, 0.02), 100.0
    period = np.zeros((512, 2), np.float32)
    for _ in range(round(8 * factor * 48_000 / 512)):
        playback.fill(period, now_s, flagged=False)
        now_s += 512 / (48_000 * factor)
    assert playback.measured_rate_hz == pytest.approx(48_000 * factor, rel=1e-3)


# -- at the interface's rate: to -100 dB, sample 0 in its place ----------------------------------------


RATES_HZ = [(10_000, 48_000), (12_500, 44_100), (48_000, 96_000), (44_100, 48_000), (96_000, 48_000), (50_000, 44_100)]


def faded_tone(frequency_hz, rate_hz, seconds=0.2):
    """A tone under a bell that is below -200 dB at either end, as a function of time."""
    time_s = np.arange(round(seconds * rate_hz)) / rate_hz - seconds / 2
    return np.exp(-((time_s / (seconds / 16)) ** 2)) * np.sin(2 * np.pi * frequency_hz * time_s + 0.3)


@pytest.mark.parametrize(("from_hz", "to_hz"), RATES_HZ)
def test_a_tone_in_the_band_then_it_is_the_same_tone_at_the_other_rate_to_100_db(from_hz, to_hz):
    ratio = rate_ratio(from_hz, to_hz)
    lead = lead_samples(ratio)
    for share in (0.003, 0.1, 0.5, 0.8, 0.89):
        made, meant = (faded_tone(share * min(from_hz, to_hz) / 2, rate_hz) for rate_hz in (from_hz, to_hz))
        made = converted(made, ratio)
        made[lead : lead + meant.size] -= meant
        assert np.abs(made).max() < 1e-5 * min(1.0, np.abs(meant).max())


def test_nothing_begins_before_a_faded_signal_and_all_that_rings_before_a_sudden_one():
    ratio = Fraction(24, 5)
    frames, first = converted_frames(faded_tone(200, 10_000), ratio)
    assert (frames.size, first) == (9600, 0)
    sudden = np.cos(np.arange(1000) / 5)
    frames, first = converted_frames(sudden / 2.0, ratio)
    assert -lead_samples(ratio) <= first < -100
    dropped = converted(sudden, ratio)[: lead_samples(ratio) + first] / 2.0
    assert np.abs(dropped).max(initial=0) <= HALF_STEP
    assert abs(frames[-first] - 0.5) < 0.2
