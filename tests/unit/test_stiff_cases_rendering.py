"""Rows of the table of stiff and extreme cases that banks, scenes, drives and fields meet; scenes of any numbers."""

import functools
import itertools
import re
import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
import scipy.fft
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.unit.plate_banks import NOISE_MM, SQUARE_MM, errors_at, noise_bank, plate_bank
from wavefocus import GreenArray, Impulse, InputError, Noise, Sine, TrajectoryPath, predict
from wavefocus.benchmarks.plate import ThinPlate
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.config.scene import Output, Regularisation, SceneConfig
from wavefocus.rendering.drive.rendering import SceneRenderer, render_with_report
from wavefocus.rendering.greens.interpolation.base import interpolation_method
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.greens.regularisation import focus_gain_map
from wavefocus.rendering.scene.model import Scene, Source, build_scene, read_scene
from wavefocus.rendering.scene.paths import Circle, Line, Point, Polyline
from wavefocus.rendering.scene.sampling import check_scene_size
from wavefocus.rendering.scene.scene_rows import scene_rows

RATE_HZ, TAPS = 1000.0, 50
GRID_MM = np.array([(4.0 * x, 4.0 * y) for y in range(5) for x in range(7)])
PATH = Line((0.0, 0.0), (24.0, 16.0))
CONTINUOUS = Source(PATH, Noise((50, 400), 0.3, 1), 0.0, 100.0, 3.0)
PER_POINT = Source(PATH, Noise((50, 400), 0.05, 1), 0.0, 100.0, 3.0, emission="per_point")
STILL = Source(Point((4.0, 4.0)), Impulse())
SATURATED = Regularisation(saturation=0.9)
VALUES = np.random.default_rng(0).standard_normal((len(GRID_MM), 3, TAPS))


def make_bank(values=VALUES, **options):
    # All doubtful: to judge what lies between the positions takes longer than a render.
    return GreenArray(values, GRID_MM, RATE_HZ, **{"status": np.full(len(GRID_MM), 4, np.uint8), **options})


def rendered(source, bank, regularisation=None, *, method=None, tolerance_db=None, **output):
    output = Output(**{"interpolation": "nearest", **output})
    scene = Scene("s", (source,), regularisation or Regularisation(), output)
    return render_with_report(scene, bank, method=method, tolerance_db=tolerance_db)


@pytest.fixture
def relative_error(record_property):
    """Tells tools/stiff_cases.py the largest error that the test found."""
    errors = []

    def relative_error(found, expected):
        assert found.shape == expected.shape
        errors.append(float(np.linalg.norm(found - expected) / np.linalg.norm(expected)))
        return errors[-1]

    yield relative_error
    record_property("measured", f"relative error {max(errors):.1g}")


def static_drive(green, signal, lead_samples=0):
    """n * sum_s u[s] g[s - n] of one focus, without saturation."""
    drive = np.array([np.convolve(signal, one[::-1]) for one in green]) / np.sum(green**2)
    return np.pad(drive, [(0, 0), (lead_samples, 0)])


@pytest.mark.parametrize("regularisation", [Regularisation(), SATURATED], ids=["plain", "saturated"])
def test_row_1_dead_actuator_drives_nothing_and_leaves_the_others_untouched(regularisation, relative_error):
    values = VALUES.copy()
    values[:, 1] = 0.0
    drive, report = rendered(CONTINUOUS, make_bank(values), regularisation)
    assert not drive.drive_v[1].any()
    assert any(text.startswith("actuator 1:") for text in report.warnings)
    if regularisation is SATURATED:  # the median rms counts the dead actuator too
        rms = np.sqrt(np.mean(values**2, axis=2))
        regularisation = Regularisation(saturation_absolute=0.9 * float(np.median(rms)))
    alive, _ = rendered(CONTINUOUS, make_bank(values[:, [0, 2]]), regularisation)
    assert relative_error(drive.drive_v[[0, 2]], alive.drive_v) < 1e-12
    assert not predict(drive, make_bank(np.zeros_like(values))).field.any()


def test_row_2_path_over_a_row_that_may_not_be_used_is_refused_by_name():
    bits, values = np.ones(len(GRID_MM), np.uint8), VALUES.copy()
    for source, bits[16] in ((CONTINUOUS, 0), (PER_POINT, 8), (CONTINUOUS, 16), (PER_POINT, 17)):
        with pytest.raises(InputError, match=r"position 16 at \(8, 8\) mm is .* path point \d of source 0"):
            rendered(source, make_bank(status=bits))
    values[0] = 0.0
    for held in (Regularisation(), Regularisation(normalise=False)):
        with pytest.raises(InputError, match=r"position 0 at \(0, 0\) mm is all zeros.* path point 0 of source 0 at"):
            rendered(CONTINUOUS, make_bank(values), held)


@pytest.mark.parametrize(
    ("scale", "dtype"), [(2.0**-40, np.float32), (2.0**30, np.float32), (1e-15, np.float64), (1e15, np.float64)]
)
def test_rows_3_to_5_bank_in_another_unit_gives_the_same_drive_in_that_unit(scale, dtype, relative_error):
    """Powers of two near 1e-12 and 1e9: float32 itself rounds any other factor to 6e-8."""
    values = VALUES.astype(np.float32).astype(dtype)
    scaled_bank = make_bank((values * dtype(scale)).astype(dtype))
    for regularisation in (Regularisation(), SATURATED):
        drive, _ = rendered(CONTINUOUS, make_bank(values), regularisation)
        scaled, _ = rendered(CONTINUOUS, scaled_bank, regularisation)
        assert relative_error(scaled.drive_v * scale, drive.drive_v) < 1e-12
    assert relative_error(predict(scaled, scaled_bank).field, predict(drive, make_bank(values)).field) < 1e-12
    copy, _ = rendered(CONTINUOUS, make_bank(scaled_bank.values.astype(np.float64)), SATURATED)
    assert np.array_equal(scaled.drive_v, copy.drive_v)


def test_rows_3_to_5_a_unit_beyond_the_range_of_numbers_is_refused():
    for scale in (1e-200, 1e200):
        with pytest.raises(InputError, match="give the bank a unit in which its values are nearer to 1"):
            rendered(CONTINUOUS, make_bank(VALUES * scale))


def test_row_6_denormals_render_like_the_zeros_that_they_nearly_are(relative_error):
    late = np.arange(TAPS) >= TAPS // 2
    tail, cut = (rendered(CONTINUOUS, make_bank(VALUES * np.where(late, one, 1.0)))[0] for one in (1e-310, 0.0))
    assert relative_error(tail.drive_v, cut.drive_v) < 1e-12


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_row_7_a_value_that_is_not_finite_is_refused_by_position_and_actuator(bad):
    values = VALUES.copy()
    values[8, 2, 5] = bad
    bank, elsewhere = make_bank(values), Source(Point((0.0, 0.0)), Impulse())
    drive, _ = rendered(elsewhere, bank)
    for use in (
        lambda: rendered(STILL, bank),
        lambda: rendered(elsewhere, bank, SATURATED),
        lambda: focus_gain_map(bank, Regularisation()),
        lambda: predict(drive, bank),
    ):
        with pytest.raises(InputError, match="position 8, actuator 2"):
            use()


def test_rows_8_to_9_no_positive_saturation_is_refused_and_a_huge_one_is_none():
    for threshold in (-1.0, np.nan, np.inf, -np.inf):
        for kind in ("saturation_absolute", "saturation"):
            with pytest.raises(ValueError, match="saturation"):
                Regularisation(**{kind: threshold})
    free, *held = (
        rendered(CONTINUOUS, make_bank(VALUES * 1e3), one)[0].drive_v
        for one in (None, Regularisation(saturation=1e308), Regularisation(saturation_absolute=1e308))
    )
    assert all(np.array_equal(one, free) for one in held)


SIGNAL = Noise((80.0, 450.0), 0.4, 3)
OFF_GRID = Source(Circle((0.9, 1.3), 14.0), SIGNAL, 0.0, 200.0, 3.0)
BETWEEN_MM = np.array([0.9, 1.3]) + 14.0 * np.stack([np.cos(np.arange(40) / 6.4), np.sin(np.arange(40) / 6.4)], axis=1)


@functools.lru_cache
def plate(spacing_mm=4.0):
    axis = np.arange(-24.0, 24.1, spacing_mm)
    return plate_bank(np.stack(np.meshgrid(axis, axis), axis=-1).reshape(-1, 2), noise_db=-60.0)


@pytest.mark.parametrize("kind", ["nearest", "bilinear"])
def test_rows_10_to_12_path_off_grid_is_warned_about_with_error_per_frequency(kind):
    """On 6 mm, fewer than two positions per wave length at 450 Hz, the error is larger."""
    (_, report), (_, coarse) = (rendered(OFF_GRID, plate(spacing_mm), interpolation=kind) for spacing_mm in (4.0, 6.0))
    said = rf"{kind!r} between the grid positions is wrong by about \d+ % at \d+ Hz"
    assert len([text for text in report.warnings if re.search(said, text)]) == 1
    errors = report.interpolation_errors
    # The truth: nearest 42 % at 250 Hz and 67 % at 450 Hz (notes/rendering.md).
    nodes = interpolation_method(kind)(PositionGrid(plate().position_mm)).nodes(BETWEEN_MM)
    greens = np.einsum("pn,pnat->pat", nodes.weights, plate().values[nodes.rows])
    for hertz in (250.0, 450.0):
        true = np.median(errors_at(hertz, greens, BETWEEN_MM))
        told = np.exp(np.interp(np.log(hertz), np.log(errors.frequency_hz), np.log(errors.median)))
        assert told == pytest.approx(true, rel=0.6)
    assert any("wrong by about" in text and "a finer grid" in text for text in coarse.warnings)
    assert coarse.interpolation_errors.overall > 1.2 * errors.overall


def test_row_13_path_outside_the_surface_is_refused_with_its_place():
    beyond, bulge = Line((20.0, 8.0), (40.0, 8.0)), Polyline([(20.0, 8.0), (32.0, 8.0), (20.0, 8.1)])
    point, between = r"path point 3, lies at \(32, 8\) mm", r"sample \d+ after its start, lies at \(28\.\d+, 8\) mm"
    for path, step_mm, interpolation, method, where in (
        (beyond, 4.0, "nearest", "exact", point),
        (beyond, 4.0, "bilinear", "sampled", point),
        (beyond, 4.0, "auto", None, point),
        (bulge, bulge.length_mm, "nearest", "exact", between),
    ):
        source = Source(path, Noise((50, 400), 1.0), 0.0, 100.0, step_mm)
        with pytest.raises(InputError, match=f"source 0, {where}"):
            rendered(source, make_bank(), interpolation=interpolation, method=method)


def test_row_14_source_faster_than_the_waves_renders_with_a_warning():
    """A medium of 4 m/s: every Green's function a short pulse after distance over speed."""
    actuator_mm = np.array([[-40.0, -30.0], [60.0, -20.0], [10.0, 70.0]])
    distance_mm = np.hypot(*(GRID_MM[:, None] - actuator_mm[None]).transpose(2, 0, 1))
    values = np.exp(-0.5 * ((np.arange(TAPS) - distance_mm[..., None] / 4000.0 * RATE_HZ) / 1.5) ** 2)
    bank, signal = make_bank(values, actuator_mm=actuator_mm), Noise((50, 400), 0.02)
    zigzag_mm = ((0.0, 0.0), (24.0, 16.0), (24.0, 0.0), (0.0, 16.0))
    for source, faster in (
        (Source(PATH, signal, 0.0, 4800.0, 4.0, emission="per_point"), True),
        (Source(PATH, signal, 0.0, 400.0, 4.0), False),
        (Source(TrajectoryPath((0.0, 0.006, 0.0093, 0.0153), zigzag_mm), signal), True),
        (Source(TrajectoryPath((0.0, 0.06, 0.093, 0.153), zigzag_mm), signal, speed_mm_s=4800.0), False),
    ):
        drive, report = rendered(source, bank)
        assert np.isfinite(drive.drive_v).all()
        assert any("faster than the waves (about 4 m/s" in text for text in report.warnings) == faster


RESTING = [
    (Point((4.0, 4.0)), 0.0, 0.0), (Point((4.0, 4.0)), 80.0, 4.0), (Line((4.0, 4.0), (4.0, 4.0)), 80.0, 4.0),
    (Polyline([(4.0, 4.0)] * 5, closed=True), 0.0, 4.0), (Circle((4.0, 4.0), 0.0), 80.0, 0.0),
    (Circle((4.0, 0.0), 4.0, 0.0, 90.0), 80.0, 4.0), (Line((4.0, 4.0), (5.0, 4.0)), 0.0, 4.0),
]  # fmt: skip


def test_rows_15_to_16_source_that_does_not_move_is_the_static_focus(relative_error):
    signal = Noise((50, 400), 0.2, 5)
    expected = static_drive(VALUES[8], signal.samples(RATE_HZ), lead_samples=30)
    for motion, (emission, method) in itertools.product(RESTING, (("continuous", "exact"), ("per_point", "sampled"))):
        path, speed_mm_s, step_mm = motion
        source = Source(path, signal, 0.03, speed_mm_s, step_mm, emission=emission)
        drive, _ = rendered(source, make_bank(), method=method)
        assert relative_error(drive.drive_v, expected) < 1e-12
        assert (drive.focus_sample.tolist(), drive.focus_position.tolist()) == ([30], [8])


def test_rows_17_and_18_firs_alike_and_a_longer_source_make_one_linear_convolution(relative_error):
    bank, long = make_bank(np.broadcast_to(VALUES[8], VALUES.shape)), Noise((50, 400), 20.0, 2)
    methods = (("nearest", "exact"), ("bilinear", "sampled"))
    around = Source(Circle((12.0, 8.0), 8.0, 50.0), long, 0.0, 100.0, 3.0)
    for source, (interpolation, method) in itertools.product((CONTINUOUS, around), methods):
        drive, _ = rendered(source, bank, interpolation=interpolation, method=method)
        emitted = source.signal.samples(RATE_HZ)[: drive.drive_v.shape[1] - TAPS + 1]
        signal = np.pad(emitted, (0, drive.drive_v.shape[1] - TAPS + 1 - len(emitted)))
        assert relative_error(drive.drive_v, static_drive(VALUES[8], signal)) < 1e-12


def test_row_19_many_path_points_take_bounded_memory():
    """1e5 points, 10 s; all the points' windows apart would take 1e5 * 50 * 8 * 3 = 120 MB."""
    turns = 1e5 * 0.01 / (2 * np.pi * 8.0)
    source = Source(Circle((12.0, 8.0), 8.0, turns), Noise((50, 400), 0.05), 0.0, 100.0, 0.01, emission="per_point")
    tracemalloc.start()
    drive, _ = rendered(source, make_bank())
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert len(drive.focus_sample) in (99_999, 100_000, 100_001)
    assert np.isfinite(drive.drive_v).all()
    assert peak < 40e6 + 4 * drive.drive_v.nbytes


def test_rows_20_to_21_focus_instants_do_not_drift():
    source = Source(Circle((12.0, 8.0), 8.0, 100.0), Impulse(), 0.0123, 97.3, 1.0, emission="per_point")
    drive, _ = rendered(source, make_bank())
    wanted = (0.0123 + np.arange(len(drive.focus_sample)) * 1.0 / 97.3) * RATE_HZ
    assert len(drive.focus_sample) > 5000
    assert np.abs(drive.focus_sample - wanted).max() <= 0.5


def glass_bank(quality, taps=400, rate_hz=2000.0):
    glass = ThinPlate(0.6, 0.4, 1.566)
    x, y = np.meshgrid(np.arange(5) * 0.004 + 0.2, np.arange(5) * 0.004 + 0.15)
    points_m = np.stack([x.ravel(), y.ravel()], axis=1)
    sources_m = np.array([[0.03, 0.05], [0.55, 0.06], [0.31, 0.37]])
    values = glass.impulse_velocity(points_m, sources_m, taps, rate_hz, quality=quality, band_hz=(60.0, 400.0))
    return GreenArray(values, 1e3 * points_m, rate_hz, band_hz=(50.0, 450.0))


def test_row_22_a_response_longer_than_its_window_is_a_warning_with_its_tail():
    """A stiff plate, Q = 1e4: at 200 Hz energy falls by e in 8 s, and the window has 0.2 s: 3 % of it."""
    point = Source(Point((200.0, 150.0)), Impulse())
    (drive, beyond), (_, within) = (rendered(point, glass_bank(quality)) for quality in (1e4, 8.0))
    assert np.isfinite(drive.drive_v).all()
    assert beyond.tail.beyond_share > 0.9
    assert any("% of the response lies beyond the bank's window" in text for text in beyond.warnings)
    assert within.tail.beyond_share < 1e-6
    assert not within.warnings


def test_row_23_a_bank_that_wraps_round_is_warned_about_when_its_last_tenth_is_loud():
    """A synthetic spectrum with its phase the wrong way round puts the response at the window's end: -11 dB."""
    values = plate_bank().values
    _, report = rendered(STILL, GreenArray(np.roll(values, -60, axis=2), SQUARE_MM, 2000.0))
    assert report.tail.last_tenth_db > -11.0
    assert any("the last tenth of the Green's functions holds" in text for text in report.warnings)
    _, report = rendered(STILL, GreenArray(values, SQUARE_MM, 2000.0))
    assert report.tail.last_tenth_db < -40.0
    assert not report.warnings
    values = np.zeros((1, 1, 100))
    values[..., 0] = 1.0
    for level_db, warned in ((-39.0, True), (-41.0, False)):
        values[..., -1] = 10.0 ** (level_db / 20.0)
        _, report = rendered(Source(Point((0.0, 0.0)), Impulse()), GreenArray(values, np.zeros((1, 2)), RATE_HZ))
        assert any("last tenth" in text for text in report.warnings) == warned
        assert report.tail.last_tenth_db == pytest.approx(level_db, abs=0.01)


def test_row_24_the_estimate_does_not_divide_by_the_sweep_outside_its_band(record_property):
    """At 60 dB plain division is 200 % wrong (noise where nothing was played); least squares at most 1 %."""
    excitation = PlayedExcitation(10_000.0, 20.0, 500.0, 0.5, 0.2, 1.0, 3)
    taps, rng = 2000, np.random.default_rng(5)
    time_s = np.arange(taps) / 10_000.0
    modes_hz = rng.uniform(40.0, 450.0, 20)
    green = (rng.standard_normal(20) @ (np.exp(-time_s / 0.02) * np.sin(2.0 * np.pi * modes_hz[:, None] * time_s))) / 50
    reference = np.concatenate([np.zeros(200), excitation.signal_v(), np.zeros(1000)])
    response = np.convolve(reference, green)[: len(reference)]
    response += 1e-3 * np.sqrt(np.mean(response**2)) * rng.standard_normal(len(response))
    records = [part[None].astype(np.float32) for part in (reference, response)]
    found = SequentialEstimator(excitation, taps).estimate(*records, range_v=(10.0, 10.0)).green[0]
    hertz = scipy.fft.rfftfreq(4000, 1e-4)
    band = (hertz >= 20.0) & (hertz <= 500.0)
    wrong, right = (scipy.fft.rfft(part, 4000)[band] for part in (found - green, green))
    record_property("measured", f"{100 * np.linalg.norm(wrong) / np.linalg.norm(right):.2g} % in the band")
    assert np.linalg.norm(wrong) <= 0.01 * np.linalg.norm(right)
    divided = scipy.fft.irfft(scipy.fft.rfft(response) / scipy.fft.rfft(reference), len(reference))[:taps]
    assert np.linalg.norm(divided - green) > np.linalg.norm(green)
    assert np.linalg.norm(found) < 1.1 * np.linalg.norm(green)


def banded(leak, taps=400):
    spectrum = np.fft.rfft(np.random.default_rng(0).standard_normal((len(GRID_MM), 3, taps)), axis=2)
    frequency = np.fft.rfftfreq(taps, 1 / RATE_HZ)
    spectrum[..., (frequency < 50) | (frequency > 150)] = 0.0
    values = np.fft.irfft(spectrum, taps, axis=2) * np.exp(-np.arange(taps) / 60)
    values += leak * values.std() * np.random.default_rng(1).standard_normal(values.shape)
    return make_bank(values, band_hz=(50.0, 150.0))


@pytest.mark.parametrize(("leak", "tolerance_db"), [(0.0, -60.0), (1e-1, -20.0)])
def test_row_25_leaky_bank_keeps_the_tolerance_with_the_bound_reported(leak, tolerance_db, relative_error):
    exact, _ = rendered(CONTINUOUS, banded(leak))
    drive, report = rendered(CONTINUOUS, banded(leak), tolerance_db=tolerance_db)
    assert 0 < relative_error(drive.drive_v, exact.drive_v) <= drive.omitted_bound
    assert report.omitted_bound == drive.omitted_bound <= 10 ** (tolerance_db / 20)


def test_row_26_segments_too_short_for_the_band_render_right_and_are_warned_about():
    for speed_mm_s, seconds, warned in ((2000.0, 0.05, True), (40.0, 0.5, False)):
        source = Source(PATH, Sine(100.0, seconds), 0.0, speed_mm_s, 2.0)
        _, report = rendered(source, banded(0.0), method="sampled")
        assert any("lies outside the bank's band" in text for text in report.warnings) == warned
        assert (report.out_of_band[0] > 0.3) == warned


CONVERSIONS = {
    "int16": lambda v: v.astype(np.int16),
    "float16": lambda v: v.astype(np.float16),
    "big-endian": lambda v: v.astype(">f4"),
    "big-endian int16": lambda v: v.astype(">i2"),
    "Fortran": np.asfortranarray,
    "strided": lambda v: np.repeat(v, 2, axis=2)[..., ::2],
    "longdouble": lambda v: v[:, ::-1][:, ::-1].astype(np.longdouble),
}


def test_rows_27_and_37_bank_of_any_number_type_is_float64_and_no_complex(relative_error):
    whole = np.round(VALUES * 300)
    plain, _ = rendered(CONTINUOUS, make_bank(whole), SATURATED)
    field = predict(plain, make_bank(whole)).field
    for converted in CONVERSIONS.values():
        bank = make_bank(converted(whole))
        drive, _ = rendered(CONTINUOUS, bank, SATURATED)
        assert relative_error(drive.drive_v, plain.drive_v) < 1e-12
        assert relative_error(predict(drive, bank).field, field) < 1e-12
    with pytest.raises(InputError, match=r"complex128, .* real numbers are needed"):
        rendered(CONTINUOUS, make_bank(VALUES + 0j))


def test_row_34_limit_no_factor_can_reach_is_refused():
    with pytest.raises(InputError, match="limit_v"):
        rendered(Source(Point((4.0, 4.0)), Impulse(), amplitude=1e150), make_bank(), limit_v=1e-300)


def test_row_35_emissions_that_overlap_add_up(relative_error):
    """Points 2 ms apart that each emit 50 ms: the drive is the sum of the points' own drives."""
    source = Source(Line((0.0, 4.0), (24.0, 4.0)), Noise((50, 400), 0.05, 1), 0.0, 2000.0, 4.0, emission="per_point")
    together, _ = rendered(source, make_bank())
    total = np.zeros_like(together.drive_v)
    for m in range(7):
        alone, _ = rendered(Source(Point((4.0 * m, 4.0)), source.signal, m * 0.002), make_bank())
        total[:, : alone.drive_v.shape[1]] += alone.drive_v
    assert relative_error(together.drive_v, total) < 1e-12


def test_row_36_positions_that_repeat_count_once_and_on_one_line_bilinear_is_refused():
    doubtful = np.full(2 * len(GRID_MM), 4, np.uint8)
    values, position_mm = np.concatenate([VALUES, 7 * VALUES]), np.concatenate([GRID_MM, GRID_MM])
    twice = GreenArray(values, position_mm, RATE_HZ, status=doubtful)
    for interpolation in ("nearest", "bilinear"):
        drive, once = (rendered(CONTINUOUS, one, interpolation=interpolation)[0] for one in (twice, make_bank()))
        assert np.array_equal(drive.drive_v, once.drive_v)
    on_a_line = GRID_MM[:, :1] * [1.0, 0.0] + np.arange(len(GRID_MM))[:, None] * [0.001, 0.0]
    bank = GreenArray(VALUES, on_a_line, RATE_HZ)
    rendered(Source(Point((4.007, 0.0)), Impulse()), bank)
    with pytest.raises(InputError, match="same y"):
        rendered(CONTINUOUS, bank, interpolation="bilinear")


# --- sizes and numbers of scenes


LINE = '{ kind = "line", start_mm = [-12, 0], end_mm = [12, 0] }'
POINT = '{ kind = "point", at_mm = [0, 0] }'
IMPULSE = '{ kind = "impulse" }'
LARGE = {
    "late": ("start_s = 1e6\nspeed_mm_s = 80\nstep_mm = 4", LINE, IMPULSE),
    "long noise": ("", POINT, '{ kind = "noise", band_hz = [50, 400], duration_s = 1e6 }'),
    "longest sine": ("", POINT, '{ kind = "sine", frequency_hz = 200, duration_s = 1e308 }'),
    "many points": ("speed_mm_s = 80\nstep_mm = 1e-6", LINE, IMPULSE),
    "one long step": ("speed_mm_s = 80\nstep_mm = 1e9", LINE, IMPULSE),
    "slow": ("speed_mm_s = 1e-5\nstep_mm = 4", LINE.replace("-12", "8"), IMPULSE),
    "many turns": ("speed_mm_s = 80\nstep_mm = 4", '{ kind = "circle", radius_mm = 8, turns = 1e12 }', IMPULSE),
    "a sound file by what it declares": ("", POINT, '{ kind = "file", path = "a.flac" }'),
}


def read(keys, path, signal, folder=Path()):
    return read_scene(f"[[source]]\n{keys}\npath = {path}\nsignal = {signal}\n", folder / "scene.toml")


def declare(path, frames):
    """Write a FLAC file whose header declares another number of frames than it holds."""
    soundfile.write(path, np.random.default_rng(0).standard_normal(5000) * 0.1, 8000)
    content = bytearray(path.read_bytes())
    packed = int.from_bytes(content[18:26], "big")
    content[18:26] = ((packed >> 36 << 36) | frames).to_bytes(8, "big")
    path.write_bytes(content)


@pytest.mark.parametrize("name", LARGE)
def test_a_large_scene_is_refused_by_its_size_before_anything_is_made(name, tmp_path):
    declare(tmp_path / "a.flac", 10**8)
    scene, small = read(*LARGE[name], tmp_path), noise_bank(40)
    if "many turns" in name:
        with pytest.raises(InputError, match="points"):
            scene_rows(scene, NOISE_MM)
    sentence = "8 GiB of drives are allowed: split it" if name == "slow" else "allowed"
    tracemalloc.start()
    try:
        for make in (render_with_report, SceneRenderer):
            with pytest.raises(InputError, match=sentence):
                make(scene, small)
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_a_sound_file_is_sized_by_its_frames_read_one_channel_and_refused_if_cut(tmp_path):
    with soundfile.SoundFile(tmp_path / "c.flac", "w", 8000, 8, "PCM_16") as file:
        file.write(np.ones((2**18, 8), np.int16))
    scene = read("", POINT, '{ kind = "file", path = "c.flac" }', tmp_path)
    size = check_scene_size(scene, sample_rate_hz=RATE_HZ, taps=40, actuators=3)
    assert (size.signal_samples, round(size.seconds, 2)) == (2**18, round(2**18 / 8000 + 0.039, 2))
    import scipy.signal  # noqa: F401  # loading it would count as memory

    tracemalloc.start()
    try:
        samples = scene.sources[0].signal.samples(RATE_HZ)
        assert tracemalloc.get_traced_memory()[1] < 4 * 8 * 2**20
    finally:
        tracemalloc.stop()
    assert len(samples) == 2**18 // 8
    declare(tmp_path / "a.flac", 10**8)
    with pytest.raises(InputError, match=r"a\.flac cannot be read"):
        read("", POINT, '{ kind = "file", path = "a.flac" }', tmp_path).sources[0].signal.samples(RATE_HZ)


EXTREMES = [5e-324, 1e-200, 1e-12, 1.0, 30.0, 1e12, 1e200, 1.7e308]
ABOVE_ZERO = st.sampled_from(EXTREMES)
FINITE = st.sampled_from([0.0, *EXTREMES, *(-value for value in EXTREMES)])
NEAR = st.tuples(st.sampled_from([-8.0, 0.0, 1e-200, 8.0]), st.sampled_from([-8.0, 0.0, 8.0]))
PLACE = NEAR | st.tuples(FINITE, FINITE)


def table(kind, **values):
    return st.fixed_dictionaries({"kind": st.just(kind), **values})


PATHS = (
    table("point", at_mm=PLACE)
    | table("line", start_mm=PLACE, end_mm=PLACE)
    | table("circle", centre_mm=NEAR, radius_mm=ABOVE_ZERO, turns=FINITE)
    | table("polyline", points_mm=st.lists(PLACE, min_size=1, max_size=4), closed=st.booleans())
    | table("text", string=st.just("o"), height_mm=ABOVE_ZERO, centre_mm=NEAR)
)
SIGNALS = (
    table("impulse")
    | table("sine", frequency_hz=ABOVE_ZERO, duration_s=ABOVE_ZERO)
    | table("noise", band_hz=st.tuples(ABOVE_ZERO, ABOVE_ZERO), duration_s=ABOVE_ZERO)
)
SOURCES = st.fixed_dictionaries({
    "start_s": st.just(0.0) | ABOVE_ZERO, "speed_mm_s": st.just(80.0) | ABOVE_ZERO,
    "step_mm": st.just(4.0) | ABOVE_ZERO, "amplitude": st.just(1.0) | FINITE, "path": PATHS, "signal": SIGNALS,
    "emission": st.sampled_from(["per_point", "continuous"]),
})  # fmt: skip
SCENES = st.fixed_dictionaries({
    "source": st.lists(SOURCES, min_size=1, max_size=2),
    "regularisation": st.fixed_dictionaries({
        "saturation": st.just(0.0) | ABOVE_ZERO, "saturation_absolute": st.sampled_from([0.0, 0.0, *EXTREMES]),
        "normalise": st.booleans(),
    }),
    "output": st.fixed_dictionaries({
        "interpolation": st.sampled_from(["nearest", "bilinear"]),
        "limit_v": st.none() | ABOVE_ZERO, "limit_rms_v": st.none() | ABOVE_ZERO,
    }),
})  # fmt: skip


@given(SCENES)
def test_any_numbers_of_a_scene_give_finite_drives_or_one_sentence(tables):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            scene = build_scene(SceneConfig.model_validate(tables), Path("scene.toml"))
            drive, _ = render_with_report(scene, noise_bank(40))
        except (InputError, ValidationError):
            return
    assert np.isfinite(drive.drive_v).all()
    assert 0 <= drive.scale <= 1
