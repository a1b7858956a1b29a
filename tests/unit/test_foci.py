"""Figures of a drive's foci."""

import numpy as np
import pytest

from tests.unit.plate_banks import SPACING_MM, plate_bank
from wavefocus.config.scene import Output
from wavefocus.drives import render
from wavefocus.rendering.field.foci import focus_figures, predicted_at
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Line
from wavefocus.rendering.scene.signals import Impulse
from wavefocus.storage.errors import InputError

NEAREST = Output(interpolation="nearest")

STROKE = Scene(
    "stroke", (Source(Line((-8.0, 0.0), (8.0, 0.0)), Impulse(), 0.0, 400.0, 4.0, emission="per_point"),), output=NEAREST
)


@pytest.fixture(scope="module")
def bank():
    return plate_bank()


@pytest.fixture(scope="module")
def drive(bank):
    return render(STROKE, bank)


def test_the_field_at_instants_is_that_of_the_whole_prediction(bank, drive):
    field = predict(drive, bank)
    first = round(drive.start_s * drive.sample_rate_hz)
    sample = np.array([first, 0, 20, first + field.field.shape[1] - 1, first + field.field.shape[1] + 5, first - 3])
    rows = np.array([3, 100, 84])
    values = predicted_at(drive, bank, rows, sample)
    assert np.abs(values[:4] - field.field[np.ix_(rows, sample[:4] - first)].T).max() < 1e-12 * np.abs(values).max()
    assert not values[4:].any()


def test_given_a_stroke_then_each_focus_is_on_its_path_point_and_a_wavelength_wide(bank, drive):
    found = focus_figures(drive, bank)
    assert len(found) == 5
    assert found.time_s == pytest.approx([0.0, 0.01, 0.02, 0.03, 0.04])
    assert found.intended_mm[:, 0].tolist() == [-8.0, -4.0, 0.0, 4.0, 8.0]
    assert (found.off_mm < SPACING_MM).all()
    assert found.peak == pytest.approx(np.ones(5), rel=0.1)
    assert np.nanmedian(found.width_mm) == pytest.approx(9.0, abs=3.0)
    assert (found.artefact_db < 0).all()


def test_given_a_field_at_another_rate_then_it_is_refused(bank, drive):
    field = predict(drive, bank, rate_hz=1000.0)
    with pytest.raises(InputError, match="1000 Hz"):
        focus_figures(drive, bank, field)
