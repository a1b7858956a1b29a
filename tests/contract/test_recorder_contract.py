"""What every recorder must do."""

import numpy as np
import pytest

from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Recorder, RecordLabel, RecordRequest

TAKE = RecordLabel(3, 1, 2)


def ask(bench, samples=2000, range_v=None):
    return RecordRequest(samples, bench.sample_rate_hz, range_v or bench.range_v, TAKE)


def test_given_a_request_then_both_channels_have_that_many_counts_within_the_range(bench):
    recorder, clock = bench.instruments.recorder, bench.instruments.clock
    assert isinstance(recorder, Recorder)
    assert recorder.identify().strip()
    assert recorder.identity.product.strip()
    for samples in (1, 1999, 5000):
        before_s = clock.now_s()
        recorder.start(ask(bench, samples))
        recording = recorder.read(5.0)
        assert clock.now_s() - before_s >= 0.99 * samples / bench.sample_rate_hz
        assert recording.volts.shape == (2, samples)
        assert recording.volts.dtype == np.float32
        assert np.all(np.isfinite(recording.volts))
        for volts, step_v, range_v in zip(recording.volts, recording.volts_per_count, bench.range_v, strict=True):
            counts = volts.astype(np.float64) / step_v
            assert np.abs(counts - np.rint(counts)).max() < 0.01
            assert np.abs(volts).max() <= range_v * (1 + 1e-6)


def test_one_record_at_a_time_an_unfinished_one_is_named_and_the_next_is_clean(bench):
    recorder = bench.instruments.recorder
    recorder.abort()
    with pytest.raises(InstrumentError):
        recorder.read(0.1)
    recorder.start(ask(bench, 20_000))
    with pytest.raises(InstrumentError):
        recorder.start(ask(bench))
    with pytest.raises(InstrumentError, match="position 3, attempt 1, record 2"):
        recorder.read(0.01)
    recorder.abort()
    recorder.start(ask(bench, 100))
    assert recorder.read(5.0).volts.shape == (2, 100)


def test_given_a_range_it_has_not_then_it_says_who_what_why_and_what_to_do(bench):
    with pytest.raises(InstrumentError) as caught:
        bench.instruments.recorder.start(ask(bench, range_v=bench.unknown_range_v))
    bench.check_sentence(caught.value, "recorder")


@pytest.mark.parametrize("range_v", [None, 0.2])
def test_a_looped_back_tone_arrives_with_its_voltage_in_time_or_its_flag_is_up(bench, range_v):
    rate_hz, (recorder, player) = bench.sample_rate_hz, (bench.instruments.recorder, bench.instruments.player)
    tone = 0.5 * np.sin(2 * np.pi * 200 * np.arange(round(0.2 * rate_hz)) / rate_hz)

    def take():
        samples = len(tone) + round((0.1 + bench.latency_s) * rate_hz)
        recorder.start(ask(bench, samples, range_v and (range_v, bench.range_v[1])))
        bench.instruments.clock.sleep(0.02)
        player.play({bench.loopback_channel: tone}, rate_hz)
        player.wait(5.0)
        return recorder.read(10.0)

    recording = bench.undisturbed(take)
    assert recording.over_range == (range_v is not None, False)
    if range_v is None:
        reference = recording.volts[0].astype(np.float64)
        assert np.abs(reference).max() == pytest.approx(0.5, rel=0.02)
        assert np.sum(reference**2) == pytest.approx(np.sum(tone**2), rel=0.02)
        first_s = np.argmax(np.abs(reference) > 0.1) / rate_hz
        assert 0.02 <= first_s <= 0.02 + bench.latency_s + 0.001


def test_given_a_closed_recorder_then_closing_is_harmless_and_starting_is_refused(bench):
    recorder = bench.instruments.recorder
    recorder.close()
    recorder.close()
    with pytest.raises(InstrumentError):
        recorder.start(ask(bench))
