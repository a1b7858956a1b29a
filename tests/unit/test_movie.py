"""Movies and snapshots of fields: which instants they show, and what the files hold."""

import itertools

import numpy as np
import pytest
from PIL import Image, ImageSequence

from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.report.movie import (
    Foci,
    colour_limit,
    plan_frames,
    read_frames,
    snapshots,
    surface_of,
    write_movie,
)
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import Field, FieldRowReader, write_field

RATE_HZ, START_S, SAMPLES = 1000.0, -0.05, 400
PLACES_MM = np.array([[x, y] for y in (0.0, 4.0, 8.0) for x in (0.0, 4.0, 8.0, 12.0)])


def bank():
    return GreenArray(np.ones((12, 2, 51)), PLACES_MM, RATE_HZ, actuator_mm=np.array([[20.0, 4.0], [np.nan, np.nan]]))


def drive():
    """Two sources: one moves over rows 4, 5, 6 every 40 ms, the other focuses once on row 11 at 0.15 s."""
    return Drive(
        drive_v=np.zeros((2, 300)), sample_rate_hz=RATE_HZ, start_s=START_S, method="sampled", scale=1.0,
        omitted_bound=0.0, focus_sample=np.array([60, 100, 140, 150]), focus_position=np.array([4, 5, 6, 11]),
        focus_source=np.array([0, 0, 0, 1]),
    )  # fmt: skip


def values():
    """Row k is k + 1 all the time, but peaks of 100 where the foci of rows 4 and 6 are, somewhat late."""
    field = np.tile(np.arange(1.0, 13.0, dtype=np.float32)[:, None], (1, SAMPLES))
    field[4, 60 + 50 + 7] = -100.0
    field[6, 140 + 50 + 3] = 100.0
    return field


@pytest.fixture
def field_file(tmp_path):
    write_field(tmp_path / "field.h5", Field(values(), np.arange(12), RATE_HZ, START_S, "m/s"))
    return tmp_path / "field.h5"


def test_given_foci_then_the_movie_is_of_them_and_of_what_was_asked_for_else(field_file):
    with FieldRowReader(field_file) as field:
        plan = plan_frames(field, drive())
        assert plan.sample[0] == 60 + 50 - 20
        assert plan.sample[-1] == 150 + 50 + 20
        assert plan.slowed == pytest.approx(RATE_HZ / 25)
        whole = plan_frames(field, None, frame_rate_hz=10.0)
        assert (whole.sample[0], whole.sample[-1]) == (0, SAMPLES - 2)
        some = plan_frames(field, drive(), from_s=0.0, to_s=0.1, slow=10.0, frame_rate_hz=20.0)
        assert some.sample.tolist() == list(range(50, 151, 5))
        assert some.slowed == pytest.approx(10.0)
        with pytest.raises(InputError, match="nothing to show"):
            plan_frames(field, None, from_s=5.0)
        with pytest.raises(InputError, match="lower --slow"):
            plan_frames(field, None, slow=1e5)


def test_given_a_field_then_frames_hold_it_and_the_scale_goes_to_the_largest_focus(field_file):
    sample = np.array([0, 117, 193])
    with FieldRowReader(field_file) as field:
        frames = read_frames(field, sample)
        focus, at, peak = Foci.of(drive()).seen(field)
    assert np.array_equal(frames, values()[:, sample].T)
    found = {focus: (at, peak) for focus, at, peak in zip(focus.tolist(), at.tolist(), peak.tolist(), strict=True)}
    assert sorted(found) == [0, 1, 2, 3]
    assert (np.diff(at) >= 0).all()
    assert (found[0][0], found[2][0]) == (117, 193)
    assert [found[index][1] for index in range(4)] == [100.0, 6.0, 100.0, 12.0]
    assert colour_limit(frames, peak) == 100.0
    assert colour_limit(frames, None) <= 100.0
    assert colour_limit(np.zeros((2, 3), np.float32), None) == 1.0


def test_given_a_movie_then_the_gif_has_its_frames(field_file, tmp_path):
    out = tmp_path / "field.gif"
    with FieldRowReader(field_file) as field:
        plan = plan_frames(field, drive(), from_s=0.0, to_s=0.1, slow=10.0, frame_rate_hz=20.0)
        limit = write_movie(out, field, surface_of(bank(), drive(), None), drive(), plan, width_px=400)
    assert limit == 100.0
    with Image.open(out) as gif:
        assert (gif.n_frames, gif.width, gif.info["duration"], gif.info["loop"]) == (21, 400, 50, 0)
        frames = [np.asarray(frame.convert("RGB"), dtype=int) for frame in ImageSequence.Iterator(gif)]
    assert all(np.any(one != other) for one, other in itertools.pairwise(frames))  # the time in the title


def test_snapshots_then_the_picture_is_drawn_and_a_field_without_foci_is_refused(field_file, tmp_path):
    with FieldRowReader(field_file) as field:
        picture = snapshots(field, surface_of(bank(), drive(), None), drive())
    assert picture.png.startswith(b"\x89PNG")
    assert (picture.width_px, picture.height_px) > (1000, 200)
    write_field(tmp_path / "other.h5", Field(values()[:2], np.arange(2), RATE_HZ, START_S, "m/s"))
    with FieldRowReader(tmp_path / "other.h5") as field, pytest.raises(InputError, match="holds no focus"):
        snapshots(field, surface_of(bank(), drive(), None), drive())
