"""Frequency responses that no causal system has are named: conjugated or leading, aliased in time; others are not."""

import numpy as np
import pytest

from wavefocus.calibration.imports.bank import import_bank
from wavefocus.options import ImportOptions

RATE_HZ, POSITIONS, ACTUATORS = 2000.0, 6, 2
NAMES = ("conjugated", "aliased")


def modes(taps, decay_s, delay_s=0.0, seed=1):
    """Responses of five decaying modes each, (positions, actuators, taps)."""
    random, time_s = np.random.default_rng(seed), np.arange(taps) / RATE_HZ - delay_s
    shape = (POSITIONS, ACTUATORS, 5, 1)
    turn = 2 * np.pi * random.uniform(60, 700, shape) * time_s
    ringing = random.standard_normal(shape) * np.sin(turn) * np.exp(-np.maximum(time_s, 0) / decay_s)
    return np.asarray(np.where(time_s >= 0, ringing, 0.0).sum(axis=2))


@pytest.fixture
def found(tmp_path):
    """Names of the warnings of an import of frequency responses from `first` steps on."""
    places = tmp_path / "places.csv"
    places.write_text("x_m,y_m\n" + "".join(f"{0.004 * (i % 3)},{0.004 * (i // 3)}\n" for i in range(POSITIONS)))

    def do(spectra, step_hz, first=0):
        np.save(tmp_path / "a.npy", spectra)
        frequencies = (first * step_hz, step_hz)
        options = ImportOptions(places=places, unit="m/s/V", frequencies=frequencies, sample_rate_hz=RATE_HZ)
        facts = import_bank(tmp_path / "a.npy", tmp_path / f"{len(list(tmp_path.iterdir()))}.h5", options).facts
        return [name for name in NAMES for text in facts["warnings"] if name in text], facts

    return do


@pytest.mark.parametrize("band", [None, (50, 226)])
@pytest.mark.parametrize(
    ("kind", "decay_s", "wanted"),
    [
        ("causal", 0.06, []), ("late", 0.03, []), ("weak noise", 0.03, []),
        ("conjugated", 0.02, ["conjugated"]), ("leading", 0.02, ["conjugated"]), ("aliased", 0.5, ["aliased"]),
    ],
)  # fmt: skip
def test_only_responses_that_are_not_causal_then_are_named(found, band, kind, decay_s, wanted):
    period = 1000
    green = modes(8000, decay_s, delay_s=0.05 if kind == "late" else 0.0)
    spectra = np.fft.rfft(green, 8000)[..., :: 8000 // period]  # samples of the spectrum: the response wraps round
    if kind == "weak noise":
        random = np.random.default_rng(5)
        spectra += 0.002 * np.abs(spectra).max() * np.exp(2j * np.pi * random.uniform(size=spectra.shape))
    if kind == "conjugated":
        spectra = spectra.conj()
    if kind == "leading":
        spectra = spectra * np.exp(2j * np.pi * np.arange(spectra.shape[-1]) * 24 / period)  # 12 ms
    low, high = band or (0, spectra.shape[-1])
    names, facts = found(spectra[..., low:high], RATE_HZ / period, low)
    assert names == wanted
    assert any("last tenth" in text and "before zero" in text for text in facts["read"])
    assert all(text in facts["paragraph"] for text in facts["warnings"])


def test_one_actuator_that_is_conjugated_then_is_named(found):
    spectra = np.fft.rfft(modes(400, 0.02), 1000)
    spectra[:, 1] = spectra[:, 1].conj()
    names, facts = found(spectra, 2.0)
    assert names == ["conjugated"]
    assert "1 of 2 actuators (the first is 1)" in facts["warnings"][0]
