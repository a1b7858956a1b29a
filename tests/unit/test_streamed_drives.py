"""Drives written block by block against the render in memory, limits and figures included."""

import itertools
import tracemalloc
from dataclasses import replace

import numpy as np
import pytest
import soundfile

from tests.unit.plate_banks import NOISE_MM, noise_bank
from tests.unit.test_drive import MOVING, REPEATING, STANDING
from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.coil_limits import levels_of
from wavefocus.rendering.drive.rendering import SceneRenderer, render_with_report
from wavefocus.rendering.drive.wav import Interface, InterfaceRate, stream_wav
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle, Line, Point
from wavefocus.rendering.scene.signals import Impulse, Noise, Sine
from wavefocus.storage.drive_file import drive_pieces, read_drive
from wavefocus.storage.errors import InputError


def limited(**limits):
    return Output(interpolation="nearest", **limits)


NEAREST = limited()

RATE_HZ = 1000.0


@pytest.mark.parametrize("scale", [1.0, 1e-12])
def test_drives_of_several_sources_are_the_sum_of_each_source_s(scale):
    """Sources that begin and end at other times and of other lengths share blocks and transforms."""
    output, bank = Output(interpolation="bilinear"), noise_bank(scale=scale)
    sources = (MOVING, REPEATING, STANDING, Source(Point((-3, 5)), Impulse(), 9.0))
    whole, _ = render_with_report(Scene("s", sources, output=output), bank)
    summed = np.zeros_like(whole.drive_v)
    for source in sources:
        drive, _ = render_with_report(Scene("s", (source,), output=output), bank)
        summed[:, : drive.drive_v.shape[1]] += drive.drive_v
    np.testing.assert_allclose(whole.drive_v, summed, rtol=0, atol=1e-13 * np.abs(summed).max())
    blocks = np.concatenate(list(SceneRenderer(Scene("s", sources, output=output), bank).unlimited_blocks()), axis=1)
    np.testing.assert_array_equal(blocks, whole.drive_v)


def test_blocks_come_before_the_scene_is_rendered_to_its_end():
    """The last row of this path cannot be used; what is before it comes all the same."""
    status = np.full(len(NOISE_MM), 4, np.uint8)
    status[np.argmin(((NOISE_MM - (15, 10)) ** 2).sum(axis=1))] = 8
    bank = noise_bank(status=status)
    source = Source(Line((-15, -11), (15, 10)), Noise((50, 400), 60.0, 4), 0.0, 0.6, 0.3)
    blocks = SceneRenderer(Scene("s", (source,), output=NEAREST), bank, method="sampled").unlimited_blocks()
    assert len(list(itertools.islice(blocks, 3))) == 3
    with pytest.raises(InputError, match="marked as failed"):
        list(blocks)


@pytest.mark.parametrize("interface_rate_hz", [1000, 4800, 44_100])
def test_a_streamed_wav_is_the_whole_one(tmp_path, interface_rate_hz):
    scene = Scene("s", (MOVING, REPEATING), output=NEAREST)
    whole, _ = render_with_report(scene, noise_bank())
    scale_v = 1.5 * float(np.abs(whole.drive_v).max())
    renderer = SceneRenderer(scene, noise_bank())
    stream_wav(
        tmp_path / "a.wav", [whole.drive_v], renderer.shape, RATE_HZ,
        interface_rate_hz=interface_rate_hz, full_scale_v=scale_v,
    )  # fmt: skip
    stream_wav(
        tmp_path / "b.wav", renderer.unlimited_blocks(), renderer.shape, RATE_HZ,
        interface_rate_hz=interface_rate_hz, full_scale_v=scale_v, chunk_samples=128,
    )  # fmt: skip
    expected, rate_hz = soundfile.read(tmp_path / "a.wav")
    found, _ = soundfile.read(tmp_path / "b.wav")
    assert rate_hz == interface_rate_hz
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-7)


def test_a_streamed_wav_beyond_full_scale_is_refused_and_leaves_no_file(tmp_path):
    renderer = SceneRenderer(Scene("s", (MOVING,), output=NEAREST), noise_bank())
    blocks = renderer.unlimited_blocks()
    with pytest.raises(InputError, match="beyond the interface's full scale"):
        stream_wav(tmp_path / "b.wav", blocks, renderer.shape, RATE_HZ, interface_rate_hz=1000, full_scale_v=1e-9)
    assert not list(tmp_path.iterdir())


LIMITS = [limited(limit_v=1e-3), limited(limit_rms_v=2e-4), limited(limit_v=1e-3, limit_rms_v=2e-4), NEAREST]


@pytest.mark.parametrize("output", LIMITS)
@pytest.mark.parametrize("tolerance_db", [None, -40.0])
def test_a_written_drive_is_the_one_in_memory_scaled_by_the_same_limits(output, tolerance_db, tmp_path):
    scene = Scene("s", (MOVING, REPEATING, STANDING), Regularisation(saturation=0.5), output)
    whole, report = render_with_report(scene, noise_bank(), tolerance_db=tolerance_db)
    streamed = SceneRenderer(scene, noise_bank(), tolerance_db=tolerance_db)
    told = streamed.write(tmp_path / "d.h5")
    written = read_drive(tmp_path / "d.h5")
    drive_v = written.drive_v
    assert written.verified
    assert (written.scale, written.omitted_bound) == (told.scale, told.omitted_bound)
    for name in ("focus_sample", "focus_position", "focus_source", "focus_mm", "start_s", "method"):
        np.testing.assert_array_equal(getattr(written, name), getattr(whole, name))
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
        assert levels_of(drive_v, RATE_HZ).rms_v.max() <= output.limit_rms_v
    assert streamed.peak_v == pytest.approx(np.abs(drive_v).max(), rel=1e-12)


def test_a_written_drive_stays_within_full_scale_between_its_samples(tmp_path):
    scene = Scene("s", (MOVING, REPEATING), output=limited(limit_v=5e-4))
    interface = Interface(4800, np.array([6e-4, 5e-4, 5e-4]))
    streamed = SceneRenderer(scene, noise_bank(), interface=interface)
    told = streamed.write(tmp_path / "d.h5")
    with drive_pieces(tmp_path / "d.h5") as pieces:
        played_v = np.concatenate(list(InterfaceRate(RATE_HZ, 4800).pieces(pieces, *streamed.shape, 4096)), axis=1)
    share = np.abs(played_v).max(axis=1) / interface.full_scale_v
    assert share.max() == pytest.approx(1.0, rel=1e-9)
    assert share.max() <= 1.0
    assert int(np.argmax(share)) == told.limiting.actuator
    assert "between samples" in str(told.limiting)


def test_memory_does_not_grow_with_the_drives():
    """A scene 16 times as long takes 16 times as much for its signal (8 bytes a sample), and no more for its drives."""
    most = {}
    for turns in (2.0, 32.0):
        source = Source(Circle((0, 0), 10.0, turns), Sine(70, 1.0), 0.0, 40.0, 3.0)
        streamed = SceneRenderer(Scene("s", (source,), output=limited(limit_v=1e-3, limit_rms_v=1e-3)), noise_bank())
        tracemalloc.start()
        for _ in streamed.unlimited_blocks():
            pass
        most[turns] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert streamed.shape[1] > 1500 * turns
    drives_bytes = 3 * 8 * 30 * 1570
    assert most[32.0] - most[2.0] < drives_bytes / 4


def test_a_scene_of_one_sample_is_written(tmp_path):
    scene = Scene("s", (Source(Point((3, 3)), Impulse(), 0.0),), output=limited(limit_rms_v=1e-3))
    whole, _ = render_with_report(scene, noise_bank())
    SceneRenderer(scene, noise_bank()).write(tmp_path / "d.h5")
    np.testing.assert_allclose(read_drive(tmp_path / "d.h5").drive_v, whole.drive_v, rtol=1e-9, atol=1e-18)


def test_drives_beyond_single_precision_are_written_and_larger_ones_refused(tmp_path):
    source = Source(Point((3, 3)), Noise((50, 400), 0.7, 3), amplitude=1e42)
    streamed = SceneRenderer(Scene("s", (source,), output=NEAREST), noise_bank(), tolerance_db=-40.0)
    report = streamed.write(tmp_path / "d.h5")
    drive_v = read_drive(tmp_path / "d.h5").drive_v
    assert not report.single
    plain, _ = render_with_report(Scene("s", (replace(source, amplitude=1.0),), output=NEAREST), noise_bank())
    np.testing.assert_allclose(drive_v, plain.drive_v * 1e42, rtol=1e-9, atol=1e-12 * streamed.peak_v)
    with pytest.raises(InputError, match="does not fit into float64"):
        render_with_report(Scene("s", (replace(source, amplitude=1e200),), output=NEAREST), noise_bank())
