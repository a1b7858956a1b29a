"""Scenes rendered in two passes against the render in one piece, limits and figures included."""

from __future__ import annotations

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from config.scene import Output, Regularisation
from rendering.drive.coil_limits import DriveLimits, RunningLevels, largest_rms
from rendering.drive.live import StreamedDrive
from rendering.drive.rendering import render_with_report
from rendering.drive.wav import Interface, InterfaceRate
from rendering.scene.model import Scene, Source
from rendering.scene.paths import Circle, Point
from rendering.scene.signals import Impulse, Sine
from storage.errors import InputError
from tests.unit.test_live import MOVING, RATE_HZ, REPEATING, STANDING, make_bank

LIMITS = [Output(limit_v=1e-3), Output(limit_rms_v=2e-4), Output(limit_v=1e-3, limit_rms_v=2e-4), Output()]


@pytest.mark.parametrize("output", LIMITS)
@pytest.mark.parametrize("tolerance_db", [None, -40.0])
def test_a_streamed_drive_is_the_whole_one_scaled_by_the_same_limits(output, tolerance_db):
    scene = Scene("s", (MOVING, REPEATING, STANDING), Regularisation(saturation=0.5), output)
    whole, report = render_with_report(scene, make_bank(), tolerance_db=tolerance_db)
    streamed = StreamedDrive(scene, make_bank(), tolerance_db=tolerance_db, block_samples=97)
    told = streamed.prepare()
    drive_v = np.concatenate(list(streamed.blocks()), axis=1)
    assert drive_v.shape == streamed.shape == whole.drive_v.shape
    np.testing.assert_allclose(drive_v, whole.drive_v, rtol=0, atol=1e-12 * np.abs(whole.drive_v).max())
    assert told.limiting.decided_by == report.limiting.decided_by
    assert told.limiting.actuator == report.limiting.actuator
    assert told.scale == pytest.approx(report.scale, rel=1e-11)
    assert told.warnings == report.warnings
    assert told.omitted_bound <= (0 if tolerance_db is None else 10 ** (tolerance_db / 20))
    np.testing.assert_allclose(told.relative_rms_drive, report.relative_rms_drive, rtol=1e-9)
    if output.limit_v is not None:
        assert np.abs(drive_v).max() <= output.limit_v
    if output.limit_rms_v is not None:
        assert largest_rms(drive_v, RATE_HZ).max() <= output.limit_rms_v
    assert streamed.peak_v == pytest.approx(np.abs(drive_v).max(), rel=1e-12)


def test_a_streamed_drive_stays_within_full_scale_between_its_samples():
    scene = Scene("s", (MOVING, REPEATING))
    interface = Interface(4800, np.array([1e-3, 5e-4, 2e-3]))
    streamed = StreamedDrive(scene, make_bank(), interface=interface)
    told = streamed.prepare()
    played_v = np.concatenate(
        list(InterfaceRate(RATE_HZ, 4800).pieces(streamed.blocks(), *streamed.shape, 4096)), axis=1
    )
    share = np.abs(played_v).max(axis=1) / interface.full_scale_v
    assert share.max() == pytest.approx(1.0, rel=1e-9)
    assert share.max() <= 1.0
    assert int(np.argmax(share)) == told.limiting.actuator
    assert "between samples" in str(told.limiting)


def test_a_gain_comes_before_the_limits():
    scene = Scene("s", (MOVING,))
    plain, louder = StreamedDrive(scene, make_bank()), StreamedDrive(scene, make_bank(), gain=3.0)
    assert plain.prepare().scale == louder.prepare().scale == 1.0
    assert louder.peak_v == pytest.approx(3 * plain.peak_v, rel=1e-12)
    limited = StreamedDrive(Scene("s", (MOVING,), output=Output(limit_v=2 * plain.peak_v)), make_bank(), gain=3.0)
    assert limited.prepare().scale == pytest.approx(2 / 3, rel=1e-12)
    assert np.abs(np.concatenate(list(limited.blocks()), axis=1)).max() <= 2 * plain.peak_v


@pytest.mark.parametrize("options", [{"gain": 0.0}, {"gain": float("nan")}, {"block_samples": 0}])
def test_what_cannot_be_streamed_is_refused(options):
    with pytest.raises(InputError):
        StreamedDrive(Scene("s", (MOVING,)), make_bank(), **options)


def test_memory_does_not_grow_with_the_drives():
    """A scene 16 times as long takes 16 times as much for its signal (8 bytes a sample), and no more for its drives."""
    most = {}
    for turns in (2.0, 32.0):
        source = Source(Circle((0, 0), 10.0, turns), Sine(70, 1.0), 0.0, 40.0, 3.0)
        streamed = StreamedDrive(Scene("s", (source,), output=Output(limit_v=1e-3, limit_rms_v=1e-3)), make_bank())
        tracemalloc.start()
        streamed.prepare()
        given_out = sum(block.shape[1] for block in streamed.blocks())
        most[turns] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert given_out == streamed.shape[1] > 1500 * turns
    drives_bytes = 3 * 8 * 30 * 1570
    assert most[32.0] - most[2.0] < drives_bytes / 4


@settings(max_examples=40, deadline=None)
@given(
    samples=st.integers(1, 400),
    cuts=st.lists(st.integers(1, 399), max_size=6),
    seed=st.integers(0, 2**32 - 1),
    rate_hz=st.sampled_from([50.0, 100.0, 1000.0]),
)
def test_running_levels_are_those_of_the_whole(samples, cuts, seed, rate_hz):
    random = np.random.default_rng(seed)
    drive_v = random.standard_normal((3, samples)) * np.exp(random.uniform(-12, 3, samples))
    levels = RunningLevels(3, samples, rate_hz, DriveLimits(peak_v=1.0, rms_v=0.3))
    for block in np.split(drive_v, sorted(cut for cut in cuts if cut < samples), axis=1):
        levels.add(block)
    np.testing.assert_array_equal(levels.peaks_v, np.abs(drive_v).max(axis=1))
    np.testing.assert_allclose(levels.norms, np.linalg.norm(drive_v, axis=1), rtol=1e-12)
    np.testing.assert_allclose(levels.rms_v, largest_rms(drive_v, rate_hz), rtol=1e-10)


def test_a_scene_of_one_sample_is_streamed():
    scene = Scene("s", (Source(Point((3, 3)), Impulse(), 0.0),), output=Output(limit_rms_v=1e-3))
    whole, _ = render_with_report(scene, make_bank())
    streamed = StreamedDrive(scene, make_bank())
    streamed.prepare()
    np.testing.assert_allclose(np.concatenate(list(streamed.blocks()), axis=1), whole.drive_v, rtol=1e-9, atol=1e-18)
