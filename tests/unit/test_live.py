"""Drives block by block against the whole render."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import soundfile

from config.scene import Output
from rendering.drive.live import LiveDrive
from rendering.drive.rendering import render_with_report
from rendering.drive.wav import in_chunks, stream_wav
from rendering.greens.source import GreenArray
from rendering.scene.model import Scene, Source
from rendering.scene.paths import Circle, Line, Point
from rendering.scene.signals import Noise, Sine
from storage.errors import InputError

RATE_HZ = 1000.0
MOVING = Source(Circle((0, 0), 10.0, 1.3, 20.0), Noise((50, 400), 0.7, 3), 0.01, 100.0, 3.0, 2.0)
REPEATING = Source(Line((-15, -11), (15, 10)), Noise((50, 400), 0.05, 4), 0.2, 100.0, 3.0, 1.5, "per_point")
STANDING = Source(Point((3, 3)), Sine(70, 0.3), 0.3)


def make_bank(scale=1.0):
    position_mm = np.array([(4.0 * x - 16.0, 4.0 * y - 12.0) for y in range(7) for x in range(9)])
    values = np.random.default_rng(0).standard_normal((len(position_mm), 3, 60))
    return GreenArray(values * scale, position_mm, RATE_HZ)


@pytest.mark.parametrize("block_samples", [1, 7, 100, 5000])
@pytest.mark.parametrize("tolerance_db", [None, -30.0])
def test_one_source_comes_in_blocks_to_the_same_bits_as_in_one_piece(block_samples, tolerance_db):
    scene = Scene("s", (MOVING,))
    whole, _ = render_with_report(scene, make_bank(), tolerance_db=tolerance_db)
    live = LiveDrive(scene, make_bank(), block_samples=block_samples, tolerance_db=tolerance_db)
    blocks = list(live.blocks())
    assert {block.shape[1] for block in blocks[:-1]} <= {block_samples}
    np.testing.assert_array_equal(np.concatenate(blocks, axis=1), whole.drive_v)
    assert (live.shape, live.sampled.start_s) == (whole.drive_v.shape, whole.start_s)


@pytest.mark.parametrize("scale", [1.0, 1e-200])
def test_several_sources_come_in_blocks_as_in_one_piece(scale):
    scene = Scene("s", (MOVING, REPEATING, STANDING), output=Output(interpolation="bilinear"))
    whole, _ = render_with_report(scene, make_bank(scale))
    blocks = np.concatenate(list(LiveDrive(scene, make_bank(scale), block_samples=64).blocks()), axis=1)
    assert blocks.shape == whole.drive_v.shape
    np.testing.assert_allclose(blocks, whole.drive_v, rtol=0, atol=1e-13 * np.abs(whole.drive_v).max())


def test_blocks_come_before_the_scene_is_rendered_to_its_end():
    """The last row of this path cannot be used; what is before it comes all the same."""
    bank = make_bank()
    last = int(np.argmin(((bank.position_mm - (15, 10)) ** 2).sum(axis=1)))
    status = np.ones(63, np.uint8)
    status[last] = 8
    bank = GreenArray(bank.values, bank.position_mm, RATE_HZ, status=status)
    source = Source(Line((-15, -11), (15, 10)), Noise((50, 400), 60.0, 4), 0.0, 0.6, 0.3)
    blocks = LiveDrive(Scene("s", (source,)), bank, method="sampled").blocks()
    assert len(list(itertools.islice(blocks, 3))) == 3
    with pytest.raises(InputError, match="marked as failed"):
        list(blocks)


def test_a_drive_beyond_the_limit_is_refused_and_a_gain_keeps_it_below():
    scene = Scene("s", (MOVING,), output=Output(limit_v=1e-3))
    whole, report = render_with_report(scene, make_bank())
    with pytest.raises(InputError, match="more than limit_v"):
        list(LiveDrive(scene, make_bank()).blocks())
    with pytest.raises(InputError, match=r"V rms from sample .* more than limit_rms_v"):
        list(LiveDrive(Scene("s", (MOVING,), output=Output(limit_rms_v=1e-3)), make_bank()).blocks())
    live = LiveDrive(scene, make_bank())
    live.gain = report.scale
    blocks = np.concatenate(list(live.blocks()), axis=1)
    np.testing.assert_allclose(blocks, whole.drive_v, rtol=1e-12, atol=1e-18)


@pytest.mark.parametrize("options", [{"block_samples": 0}, {"method": "fast"}])
def test_what_cannot_be_given_out_is_refused(options):
    with pytest.raises(InputError):
        LiveDrive(Scene("s", (MOVING,)), make_bank(), **options)


@pytest.mark.parametrize("interface_rate_hz", [1000, 4800, 44_100])
@pytest.mark.parametrize("block_samples", [97, 4096])
def test_a_streamed_wav_is_the_whole_one(tmp_path, interface_rate_hz, block_samples):
    scene = Scene("s", (MOVING, REPEATING))
    whole, _ = render_with_report(scene, make_bank())
    scale_v = 1.5 * float(np.abs(whole.drive_v).max())
    live = LiveDrive(scene, make_bank(), block_samples=block_samples)
    stream_wav(
        tmp_path / "a.wav", in_chunks(whole.drive_v), live.shape, RATE_HZ,
        interface_rate_hz=interface_rate_hz, full_scale_v=scale_v,
    )  # fmt: skip
    stream_wav(
        tmp_path / "b.wav", live.blocks(), live.shape, RATE_HZ,
        interface_rate_hz=interface_rate_hz, full_scale_v=scale_v, chunk_samples=128,
    )  # fmt: skip
    expected, rate_hz = soundfile.read(tmp_path / "a.wav")
    found, _ = soundfile.read(tmp_path / "b.wav")
    assert rate_hz == interface_rate_hz
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-7)


def test_a_streamed_wav_beyond_full_scale_is_refused_and_leaves_no_file(tmp_path):
    live = LiveDrive(Scene("s", (MOVING,)), make_bank())
    with pytest.raises(InputError, match="beyond the interface's full scale"):
        stream_wav(tmp_path / "b.wav", live.blocks(), live.shape, RATE_HZ, interface_rate_hz=1000, full_scale_v=1e-9)
    assert not list(tmp_path.iterdir())
