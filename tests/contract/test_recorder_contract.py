"""What every recorder must do."""

import numpy as np
import pytest

from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Recorder, RecordLabel, RecordRequest

TAKE = RecordLabel(3, 1, 2)


def ask(bench, samples=2000, range_v=None):
    return RecordRequest(samples, bench.sample_rate_hz, range_v or bench.range_v, TAKE)


def test_given_a_recorder_then_it_has_the_role_and_a_name(bench):
    assert isinstance(bench.instruments.recorder, Recorder)
    assert bench.instruments.recorder.identify().strip()
    assert bench.instruments.recorder.identity.product.strip()


def test_given_a_request_then_both_channels_have_that_many_counts_within_the_range(bench):
    for samples in (1, 1999, 2000):
        bench.instruments.recorder.start(ask(bench, samples))
        recording = bench.instruments.recorder.read(5.0)
        assert recording.volts.shape == (2, samples)
        assert recording.volts.dtype == np.float32
        assert np.all(np.isfinite(recording.volts))
        for volts, step_v, range_v in zip(recording.volts, recording.volts_per_count, bench.range_v, strict=True):
            counts = volts.astype(np.float64) / step_v
            assert np.abs(counts - np.rint(counts)).max() < 0.01
            assert np.abs(volts).max() <= range_v * (1 + 1e-6)


def test_given_a_record_then_reading_takes_its_length(bench):
    clock = bench.instruments.clock
    before_s = clock.now_s()
    bench.instruments.recorder.start(ask(bench, 5000))
    bench.instruments.recorder.read(5.0)
    assert clock.now_s() - before_s >= 0.99 * 5000 / bench.sample_rate_hz


def test_given_too_little_time_then_reading_fails_and_names_the_take(bench):
    bench.instruments.recorder.start(ask(bench, 20_000))
    with pytest.raises(InstrumentError, match="position 3, attempt 1, record 2"):
        bench.instruments.recorder.read(0.01)
    bench.instruments.recorder.abort()


def test_given_no_record_then_reading_is_refused_and_under_one_another_start(bench):
    recorder = bench.instruments.recorder
    with pytest.raises(InstrumentError):
        recorder.read(0.1)
    recorder.start(ask(bench))
    with pytest.raises(InstrumentError):
        recorder.start(ask(bench))
    assert recorder.read(5.0).volts.shape == (2, 2000)


def test_given_an_aborted_record_then_a_new_one_starts_clean(bench):
    recorder = bench.instruments.recorder
    recorder.abort()
    recorder.start(ask(bench, 20_000))
    recorder.abort()
    recorder.start(ask(bench, 100))
    assert recorder.read(5.0).volts.shape == (2, 100)


def test_given_a_range_it_has_not_then_it_says_who_what_why_and_what_to_do(bench):
    with pytest.raises(InstrumentError) as caught:
        bench.instruments.recorder.start(ask(bench, range_v=bench.unknown_range_v))
    error = caught.value
    assert "recorder" in error.instrument
    assert all(text.strip() for text in (error.operation, error.cause, error.remedy))


def looped_back(bench, tone, range_v=None):
    """Record a tone of the loopback output; begun again when the audio server ran dry, as an attempt would be."""
    recorder, player, clock = (bench.instruments.recorder, bench.instruments.player, bench.instruments.clock)

    def take():
        samples = len(tone) + round((0.1 + bench.latency_s) * bench.sample_rate_hz)
        recorder.start(ask(bench, samples, range_v))
        clock.sleep(0.02)
        player.play({bench.loopback_channel: tone}, bench.sample_rate_hz)
        player.wait(5.0)
        return recorder.read(10.0)

    return bench.undisturbed(take)


def test_given_a_looped_back_tone_then_it_arrives_with_its_voltage_within_the_roll(bench):
    rate_hz = bench.sample_rate_hz
    tone = 0.5 * np.sin(2 * np.pi * 200 * np.arange(round(0.2 * rate_hz)) / rate_hz)
    recording = looped_back(bench, tone)
    reference = recording.volts[0].astype(np.float64)
    assert recording.over_range == (False, False)
    assert np.abs(reference).max() == pytest.approx(0.5, rel=0.02)
    assert np.sum(reference**2) == pytest.approx(np.sum(tone**2), rel=0.02)
    first_s = np.argmax(np.abs(reference) > 0.1) / rate_hz
    assert 0.02 <= first_s <= 0.02 + bench.latency_s + 0.001


def test_given_a_tone_beyond_the_range_then_the_flag_of_that_channel_is_up(bench):
    tone = 0.5 * np.sin(2 * np.pi * 200 * np.arange(2000) / bench.sample_rate_hz)
    assert looped_back(bench, tone, (0.2, bench.range_v[1])).over_range[0]


def test_given_a_closed_recorder_then_closing_is_harmless_and_starting_is_refused(bench):
    recorder = bench.instruments.recorder
    recorder.close()
    recorder.close()
    with pytest.raises(InstrumentError):
        recorder.start(ask(bench))
