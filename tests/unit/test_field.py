"""Predicted fields against plain convolution, eqs. (4) and (17), on any device; and the figures of a drive's foci."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.plate_banks import SPACING_MM, plate_bank
from tests.unit.test_drive import STRICT, relative_error
from wavefocus import Drive, GreenArray, Impulse, InputError, Line, Scene, Source, render
from wavefocus.config.scene import Output
from wavefocus.rendering.device import host_device
from wavefocus.rendering.field.convolution import BankSpectra
from wavefocus.rendering.field.foci import focus_figures
from wavefocus.rendering.field.prediction import Prediction, predict, share_above
from wavefocus.storage.field_file import LowPass

NONE = np.zeros(0, np.int64)


def make_drive(volts, rate_hz=1000.0, start_s=-0.1):
    return Drive(np.asarray(volts, float), rate_hz, start_s, "exact", 1.0, 0.0, NONE, NONE, NONE)


def make_bank(values, **options):
    position_mm = np.stack([4.0 * np.arange(len(values)), np.zeros(len(values))], axis=1)
    return GreenArray(values, position_mm, 1000.0, **options)


def convolved(bank, drive, positions):
    rows = (zip(bank.values[position].astype(float), drive.drive_v, strict=True) for position in positions)
    return np.array([sum(np.convolve(green, volts) for green, volts in row) for row in rows])


@settings(max_examples=12)
@given(
    seed=st.integers(0, 2**31),
    positions=st.integers(1, 5),
    actuators=st.integers(1, 4),
    taps=st.integers(1, 200),
    samples=st.sampled_from([1, 7, 500, 9000, 20000]),
    scale=st.sampled_from([1.0, 2.0**-50, 2.0**50]),
    silent=st.booleans(),
)
def test_a_field_is_the_full_convolution_in_any_unit_and_order_on_any_device(
    seed, positions, actuators, taps, samples, scale, silent
):
    rng = np.random.default_rng(seed)
    bank = make_bank(rng.standard_normal((positions, actuators, taps)) * scale)
    volts = rng.standard_normal((actuators, samples)) / scale
    if silent and actuators > 1:
        volts[0] = 0.0
    drive, asked = make_drive(volts), [*range(positions), 0]
    expected = convolved(bank, drive, asked)
    for device in (host_device(), STRICT):
        field = predict(drive, bank, asked, device=device)
        assert relative_error(field.field, expected) < 1e-12
        assert field.position_index.tolist() == asked
    single = predict(drive, bank, asked, dtype=np.float32)
    assert single.field.dtype == np.float32
    assert relative_error(single.field, expected) < 2e-6


def test_a_field_starts_with_its_drive_and_leaves_out_unmeasured_positions():
    bank = make_bank(np.ones((5, 1, 3)), status=np.array([1, 0, 4, 16, 8], np.uint8))
    field = predict(make_drive([[1.0, 2.0]], start_s=-0.002), bank)
    np.testing.assert_allclose(field.field, [[1, 3, 3, 2]] * 2)
    assert (field.start_s, field.sample_rate_hz, field.response_unit) == (-0.002, 1000.0, "m/s")
    assert field.position_index.tolist() == [0, 2]
    with pytest.raises(InputError, match="positions holds 1, 3: not measured"):
        predict(make_drive([[1.0]]), bank, [0, 1, 3])
    with pytest.raises(InputError, match="no measured position"):
        predict(make_drive([[1.0]]), make_bank(np.ones((2, 1, 3)), status=np.zeros(2, np.uint8)))


def test_parameters_that_do_not_fit_the_bank_are_refused():
    for drive, options, message in (
        (make_drive(np.ones((2, 5))), {}, "the drive has 2 actuators, the bank 1"),
        (make_drive([[1.0]], rate_hz=2000.0), {}, "the drive is at 2000 Hz"),
        (make_drive([[1.0]]), {"positions": []}, "positions is empty"),
        (make_drive([[1.0]]), {"positions": [0, 7]}, "positions holds 7; allowed are 0 to 1"),
        (make_drive([[1e300]]), {}, "does not fit into float64"),
        (make_drive([[1.0]]), {"dtype": np.float16}, "dtype is float16"),
        (make_drive([[1.0]]), {"rate_hz": 300.0}, "whole number"),
    ):
        with pytest.raises(InputError, match=message):
            predict(drive, make_bank(np.full((2, 1, 3), 1e100)), **options)


def band_limited(rng, shape, share=0.25):
    spectrum = np.fft.rfft(rng.standard_normal(shape))
    frequency = np.linspace(0, 1, spectrum.shape[-1])
    return np.fft.irfft(spectrum / (1 + (frequency / (0.5 * share)) ** 8), shape[-1])


def test_a_field_at_a_lower_rate_is_the_field_without_what_lies_above():
    rng = np.random.default_rng(3)
    bank = make_bank(band_limited(rng, (4, 2, 400), 0.2))
    drive = make_drive(band_limited(rng, (2, 3000), 0.2))
    whole = convolved(bank, drive, range(4))
    for prediction in (
        Prediction(drive, BankSpectra(bank, range(4), rate_hz=250.0), range(4)),
        Prediction(drive, bank, range(4), rate_hz=250.0),
    ):
        found = prediction.field()
        assert (found.sample_rate_hz, found.start_s) == (250.0, drive.start_s)
        assert found.low_pass == LowPass(100.0, 4)
        assert relative_error(found.field, whole[:, ::4]) < 1e-3
    assert Prediction(drive, bank, range(4), rate_hz=bank.sample_rate_hz).field().low_pass is None
    power = np.square(np.abs(np.fft.rfft(whole)))
    frequency_hz = np.fft.rfftfreq(3399, 1e-3)
    shares = [power[:, frequency_hz > highest_hz].sum(axis=1) / power.sum(axis=1) for highest_hz in (60.0, 100.0)]
    by_spectra = [share_above(drive, bank, np.arange(4), highest_hz) for highest_hz in (60.0, 100.0)]
    assert by_spectra == pytest.approx([share.max() for share in shares], rel=0.01, abs=1e-7)


STROKE = Source(Line((-8.0, 0.0), (8.0, 0.0)), Impulse(), 0.0, 400.0, 4.0, emission="per_point")


def test_given_a_stroke_then_each_focus_is_on_its_path_point_and_a_wavelength_wide():
    bank = plate_bank()
    drive = render(Scene("stroke", (STROKE,), output=Output(interpolation="nearest")), bank)
    field = predict(drive, bank)
    found = focus_figures(drive, bank)
    assert len(found) == 5
    assert found.time_s == pytest.approx([0.0, 0.01, 0.02, 0.03, 0.04])
    assert found.intended_mm[:, 0].tolist() == [-8.0, -4.0, 0.0, 4.0, 8.0]
    assert (found.off_mm < SPACING_MM).all()
    assert found.peak == pytest.approx(np.ones(5), rel=0.1)
    assert np.nanmedian(found.width_mm) == pytest.approx(9.0, abs=3.0)
    assert (found.artefact_db < 0).all()
    of_field = focus_figures(drive, bank, field)
    for name in ("at_mm", "peak", "width_mm", "artefact_db"):
        np.testing.assert_allclose(getattr(of_field, name), getattr(found, name), rtol=1e-9)
    part = focus_figures(drive, bank, predict(drive, bank, bank.position_mm[:, 0] <= 4.0))
    assert np.isnan(part.peak).tolist() == [False, True, True, True, True]
    with pytest.raises(InputError, match="1000 Hz"):
        focus_figures(drive, bank, predict(drive, bank, rate_hz=1000.0))
    bare = replace(drive, focus_sample=NONE, focus_position=NONE, focus_source=NONE, focus_mm=None)
    assert len(focus_figures(bare, bank)) == len(focus_figures(bare, bank, field)) == 0
