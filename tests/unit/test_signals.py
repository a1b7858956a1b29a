"""Signals that a source emits."""

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.rendering.scene.signals import Noise, Sine, SoundFile
from wavefocus.storage.errors import InputError


@given(seed=st.integers(0, 2**63), low=st.floats(0, 2000), width=st.floats(100, 3000), duration_s=st.floats(0.02, 0.3))
def test_noise_has_peak_one_and_nothing_outside_its_band(seed, low, width, duration_s):
    found = Noise((low, low + width), duration_s, seed).samples(10_000.0)
    assert np.abs(found).max() == 1.0
    np.testing.assert_array_equal(found, Noise((low, low + width), duration_s, seed).samples(10_000.0))
    power = np.abs(np.fft.rfft(found)) ** 2
    frequency = np.fft.rfftfreq(len(found), 1e-4)
    outside = (frequency < low - 1e-9) | (frequency > low + width + 1e-9)
    assert power[outside].sum() < 1e-24 * power.sum()


def test_a_sound_file_gives_its_first_channel_at_peak_one(tmp_path):
    time = np.arange(800) / 8000
    frames = np.stack([0.25 * np.sin(2 * np.pi * 100 * time), np.ones(800)], axis=1)
    soundfile.write(tmp_path / "a.wav", frames, 8000, subtype="DOUBLE")
    found = SoundFile(tmp_path / "a.wav").samples(8000.0)
    np.testing.assert_allclose(found, frames[:, 0] / np.abs(frames[:, 0]).max(), atol=1e-12)


@pytest.mark.parametrize("rate_hz", [44_100, 48_000, 8_000])
def test_a_sound_file_is_resampled_without_changing_its_tone(tmp_path, rate_hz):
    time = np.arange(rate_hz) / rate_hz
    soundfile.write(tmp_path / "a.wav", 0.5 * np.sin(2 * np.pi * 230 * time), rate_hz, subtype="DOUBLE")
    found = SoundFile(tmp_path / "a.wav").samples(10_000.0)
    expected = np.sin(2 * np.pi * 230 * np.arange(len(found)) / 10_000)
    assert len(found) == pytest.approx(10_000, abs=1)
    middle = slice(1000, 9000)
    scale = found[middle] @ expected[middle] / (expected[middle] @ expected[middle])
    np.testing.assert_allclose(found[middle] / scale, expected[middle], atol=1e-4)


def test_a_tone_above_the_banks_nyquist_does_not_fold_back(tmp_path):
    time = np.arange(44_100) / 44_100
    wave = np.sin(2 * np.pi * 7000 * time) + 1e-3 * np.sin(2 * np.pi * 200 * time)
    soundfile.write(tmp_path / "a.wav", wave / 2, 44_100, subtype="DOUBLE")
    found = SoundFile(tmp_path / "a.wav").samples(10_000.0)[1000:9000]
    power = np.abs(np.fft.rfft(found * np.hanning(len(found)))) ** 2
    assert power.argmax() == pytest.approx(200 * len(found) / 10_000, abs=1)


@pytest.mark.parametrize(
    ("signal", "message"),
    [
        (Sine(0.0, 1.0), "frequency_hz is 0.0"),
        (Sine(5000.0, 1.0), "below 5000"),
        (Sine(100.0, 0.0), "duration_s is 0.0"),
        (Sine(100.0, float("nan")), "duration_s is nan"),
        (Sine(100.0, 1e-5), "no sample to emit"),
        (Sine(100.0, 1e-4), "empty or silent"),
        (Sine(100.0, 1e9), "more than"),
        (Noise((400, 50), 1.0), "band_hz"),
        (Noise((50, 6000), 1.0), "band_hz"),
        (Noise((50, 60), 0.01), "empty or silent"),
        (Noise((50, 60), 1.0, -1), "seed is -1"),
    ],
)
def test_a_signal_that_cannot_be_emitted_is_refused(signal, message):
    with pytest.raises(InputError, match=message):
        signal.samples(10_000.0)


def test_a_sound_file_that_is_missing_broken_or_silent_is_refused(tmp_path):
    (tmp_path / "broken.wav").write_bytes(b"no sound")
    soundfile.write(tmp_path / "silent.wav", np.zeros(100), 8000)
    soundfile.write(tmp_path / "empty.wav", np.zeros(0), 8000)
    for name in ("missing", "broken", "silent", "empty"):
        with pytest.raises(InputError, match=f"{name}.wav"):
            SoundFile(tmp_path / f"{name}.wav").samples(10_000.0)
