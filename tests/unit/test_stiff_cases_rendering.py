"""Rows of the table of stiff and extreme cases that scenes, drives and fields can meet."""

import tracemalloc

import numpy as np
import pytest

from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.greens.regularisation import focus_gain_map
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle, Line, Point, Polyline
from wavefocus.rendering.scene.signals import Impulse, Noise, Sine
from wavefocus.storage.errors import InputError

RATE_HZ = 1000.0
GRID_MM = np.array([(4.0 * x, 4.0 * y) for y in range(5) for x in range(7)])
TAPS = 50
PATH = Line((0.0, 0.0), (24.0, 16.0))
CONTINUOUS = Source(PATH, Noise((50, 400), 0.3, 1), 0.0, 100.0, 3.0)
PER_POINT = Source(PATH, Noise((50, 400), 0.05, 1), 0.0, 100.0, 3.0, emission="per_point")
SATURATED = Regularisation(saturation=0.9)


def random_values(actuators=3, seed=0):
    return np.random.default_rng(seed).standard_normal((len(GRID_MM), actuators, TAPS))


def make_bank(values=None, **options):
    # All doubtful: to judge what lies between the positions takes longer than a render.
    options = {"status": np.full(len(GRID_MM), 4, np.uint8), **options}
    return GreenArray(random_values() if values is None else values, GRID_MM, RATE_HZ, **options)


def rendered(source, bank, regularisation=None, **options):
    scene = Scene(
        "s", (source,), regularisation or Regularisation(), options.pop("output", Output(interpolation="nearest"))
    )
    return render_with_report(scene, bank, **options)


ERRORS = []


@pytest.fixture(autouse=True)
def measured(record_property):
    """Tells tools/stiff_cases.py the largest error that the test found."""
    ERRORS.clear()
    yield
    if ERRORS:
        record_property("measured", f"relative error {max(ERRORS):.1g}")


def relative_error(found, expected):
    assert found.shape == expected.shape
    error = float(np.linalg.norm(found - expected) / np.linalg.norm(expected))
    ERRORS.append(error)
    return error


def static_drive(green, signal, lead_samples=0):
    """n * sum_s u[s] g[s - n] of one focus, without saturation."""
    n = 1.0 / np.sum(green**2)
    drive = np.zeros((len(green), lead_samples + len(signal) + green.shape[1] - 1))
    for sample, value in enumerate(signal, lead_samples):
        drive[:, sample : sample + green.shape[1]] += n * value * green[:, ::-1]
    return drive


@pytest.mark.parametrize("regularisation", [Regularisation(), SATURATED])
def test_row_1_dead_actuator_drives_nothing_and_leaves_the_others_untouched(regularisation):
    values = random_values()
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


@pytest.mark.parametrize("status", [0, 8, 16, 17])
@pytest.mark.parametrize("source", [CONTINUOUS, PER_POINT])
def test_row_2_path_over_a_row_that_may_not_be_used_is_refused_by_name(source, status):
    bits = np.ones(len(GRID_MM), np.uint8)
    bits[16] = status
    with pytest.raises(InputError, match=r"position 16 at \(8, 8\) mm is .* path point \d of source 0"):
        rendered(source, make_bank(status=bits))


def test_row_2_path_over_a_row_of_zeros_is_refused_by_name():
    values = random_values()
    values[0] = 0.0
    with pytest.raises(InputError, match=r"position 0 at \(0, 0\) mm is all zeros.* path point 0 of source 0 at"):
        rendered(CONTINUOUS, make_bank(values))
    with pytest.raises(InputError, match="position 0"):
        rendered(CONTINUOUS, make_bank(values), Regularisation(normalise=False))


@pytest.mark.parametrize("regularisation", [Regularisation(), SATURATED])
@pytest.mark.parametrize(
    ("scale", "dtype"), [(2.0**-40, np.float32), (2.0**30, np.float32), (1e-15, np.float64), (1e15, np.float64)]
)
def test_rows_3_to_5_bank_in_another_unit_gives_the_same_drive_in_that_unit(scale, dtype, regularisation):
    """Powers of two near 1e-12 and 1e9: float32 itself rounds any other factor to 6e-8."""
    values = random_values().astype(np.float32).astype(dtype)
    drive, _ = rendered(CONTINUOUS, make_bank(values), regularisation)
    scaled_bank = make_bank((values * dtype(scale)).astype(dtype))
    scaled, _ = rendered(CONTINUOUS, scaled_bank, regularisation)
    assert relative_error(scaled.drive_v * scale, drive.drive_v) < 1e-12
    field = predict(drive, make_bank(values)).field
    assert relative_error(predict(scaled, scaled_bank).field, field) < 1e-12


@pytest.mark.parametrize("scale", [1e-12, 1e9])
def test_rows_3_to_5_float32_bank_of_any_scale_renders_like_its_float64_copy(scale):
    values = (random_values() * scale).astype(np.float32)
    drive, _ = rendered(CONTINUOUS, make_bank(values), SATURATED)
    copy, _ = rendered(CONTINUOUS, make_bank(values.astype(np.float64)), SATURATED)
    assert np.array_equal(drive.drive_v, copy.drive_v)
    signal = CONTINUOUS.signal.samples(RATE_HZ)
    still, _ = rendered(Source(Point((4.0, 4.0)), CONTINUOUS.signal), make_bank(values))
    assert relative_error(still.drive_v * scale, static_drive(values[8] / scale, signal)) < 1e-6


@pytest.mark.parametrize("scale", [1e-200, 1e200])
def test_rows_3_to_5_a_unit_beyond_the_range_of_numbers_is_refused(scale):
    with pytest.raises(InputError, match="give the bank a unit in which its values are nearer to 1"):
        rendered(CONTINUOUS, make_bank(random_values() * scale))


def test_row_6_denormals_render_like_the_zeros_that_they_nearly_are():
    values = random_values()
    values[..., TAPS // 2 :] *= 1e-310
    tail, _ = rendered(CONTINUOUS, make_bank(values))
    values[..., TAPS // 2 :] = 0.0
    cut, _ = rendered(CONTINUOUS, make_bank(values))
    assert relative_error(tail.drive_v, cut.drive_v) < 1e-12


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_row_7_a_value_that_is_not_finite_is_refused_by_position_and_actuator(bad):
    values = random_values()
    values[8, 2, 5] = bad
    bank = make_bank(values)
    with pytest.raises(InputError, match="position 8, actuator 2"):
        rendered(Source(Point((4.0, 4.0)), Impulse()), bank)
    with pytest.raises(InputError, match="position 8, actuator 2"):
        rendered(Source(Point((0.0, 0.0)), Impulse()), bank, SATURATED)
    with pytest.raises(InputError, match="position 8, actuator 2"):
        focus_gain_map(bank)
    drive, _ = rendered(Source(Point((0.0, 0.0)), Impulse()), bank)
    with pytest.raises(InputError, match="position 8, actuator 2"):
        predict(drive, bank)


@pytest.mark.parametrize("threshold", [-1.0, np.nan, np.inf, -np.inf])
def test_rows_8_to_9_saturation_below_zero_or_not_finite_is_refused(threshold):
    with pytest.raises(ValueError, match="saturation"):
        Regularisation(saturation_absolute=threshold)
    with pytest.raises(ValueError, match="saturation"):
        focus_gain_map(make_bank(), threshold)


@pytest.mark.parametrize(
    "regularisation", [Regularisation(saturation=1e308), Regularisation(saturation_absolute=1e308)]
)
def test_rows_8_to_9_huge_saturation_is_none_at_all(regularisation):
    drive, _ = rendered(CONTINUOUS, make_bank(random_values() * 1e3), regularisation)
    free, _ = rendered(CONTINUOUS, make_bank(random_values() * 1e3))
    assert np.array_equal(drive.drive_v, free.drive_v)


@pytest.mark.parametrize("method", ["sampled", "exact"])
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
def test_row_13_path_outside_the_surface_is_refused_with_its_place(interpolation, method):
    source = Source(Line((20.0, 8.0), (40.0, 8.0)), Noise((50, 400), 1.0), 0.0, 100.0, 4.0)
    with pytest.raises(InputError, match=r"source 0, path point [23], lies at \((28|32), 8\) mm"):
        rendered(source, make_bank(), output=Output(interpolation=interpolation), method=method)


def test_row_13_path_that_leaves_grid_between_two_path_points_is_refused_when_exact():
    bulge = Polyline([(20.0, 8.0), (32.0, 8.0), (20.0, 8.1)])
    source = Source(bulge, Noise((50, 400), 1.0), 0.0, 100.0, bulge.length_mm)
    with pytest.raises(InputError, match=r"source 0, sample \d+ after its start, lies at \(28\.\d+, 8\) mm"):
        rendered(source, make_bank(), method="exact")


@pytest.mark.parametrize("speed_mm_s", [4_800.0, 9_600.0])
def test_row_14_source_faster_than_the_waves_renders_with_a_warning(speed_mm_s):
    """A medium of 4 m/s: every Green's function a short pulse after distance over speed."""
    actuator_mm = np.array([[-40.0, -30.0], [60.0, -20.0], [10.0, 70.0]])
    distance_mm = np.hypot(*(GRID_MM[:, None] - actuator_mm[None]).transpose(2, 0, 1))
    delay = distance_mm / 4000.0 * RATE_HZ
    values = np.exp(-0.5 * ((np.arange(TAPS) - delay[..., None]) / 1.5) ** 2)
    bank = make_bank(values, actuator_mm=actuator_mm)
    source = Source(PATH, Noise((50, 400), 0.02), 0.0, speed_mm_s, 4.0, emission="per_point")
    drive, report = rendered(source, bank)
    assert np.isfinite(drive.drive_v).all()
    assert any("faster than the waves (about 4 m/s" in text for text in report.warnings)
    _, slow = rendered(Source(PATH, Noise((50, 400), 0.02), 0.0, 400.0, 4.0), bank)
    assert not any("faster" in text for text in slow.warnings)


@pytest.mark.parametrize(
    ("path", "speed_mm_s", "step_mm"),
    [
        (Point((4.0, 4.0)), 0.0, 0.0),
        (Point((4.0, 4.0)), 80.0, 4.0),
        (Line((4.0, 4.0), (4.0, 4.0)), 80.0, 4.0),
        (Polyline([(4.0, 4.0)] * 5, closed=True), 0.0, 4.0),
        (Circle((4.0, 4.0), 0.0), 80.0, 0.0),
        (Circle((4.0, 0.0), 4.0, 0.0, 90.0), 80.0, 4.0),
        (Line((4.0, 4.0), (5.0, 4.0)), 0.0, 4.0),
    ],
)
@pytest.mark.parametrize("emission", ["continuous", "per_point"])
@pytest.mark.parametrize("method", ["sampled", "exact"])
def test_rows_15_to_16_source_that_does_not_move_is_the_static_focus(path, speed_mm_s, step_mm, emission, method):
    signal = Noise((50, 400), 0.2, 5)
    drive, _ = rendered(Source(path, signal, 0.03, speed_mm_s, step_mm, emission=emission), make_bank(), method=method)
    expected = static_drive(random_values()[8], signal.samples(RATE_HZ), lead_samples=30)
    assert relative_error(drive.drive_v, expected) < 1e-12
    assert drive.focus_sample.tolist() == [30]
    assert drive.focus_position.tolist() == [8]


def test_rows_15_to_16_empty_signal_is_refused():
    with pytest.raises(InputError, match="no sample to emit"):
        rendered(Source(Point((4.0, 4.0)), Sine(100.0, 1e-9)), make_bank())

    class Nothing:
        def samples(self, sample_rate_hz):
            return np.zeros(0)

    with pytest.raises(InputError, match="the signal of source 0 is empty"):
        rendered(Source(Point((4.0, 4.0)), Nothing()), make_bank())


@pytest.mark.parametrize("method", ["sampled", "exact"])
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
def test_row_17_identical_firs_everywhere_make_one_convolution(interpolation, method):
    one = random_values()[0]
    bank = make_bank(np.broadcast_to(one, (len(GRID_MM), *one.shape)))
    drive, _ = rendered(CONTINUOUS, bank, SATURATED, output=Output(interpolation=interpolation), method=method)
    signal = np.zeros(drive.drive_v.shape[1] - TAPS + 1)
    emitted = CONTINUOUS.signal.samples(RATE_HZ)[: len(signal)]
    signal[: len(emitted)] = emitted
    rms = np.sqrt(np.mean(one**2, axis=1))
    sigma = np.minimum(1.0, 0.9 * np.median(rms) / rms)
    n = 1.0 / np.sum(sigma * np.sum(one**2, axis=1))
    expected = np.array([np.convolve(n * s * signal, g[::-1]) for s, g in zip(sigma, one, strict=True)])
    assert relative_error(drive.drive_v, expected) < 1e-12


def test_row_18_source_longer_than_the_firs_is_convolved_linearly():
    signal = Noise((50, 400), 20.0, 2)
    drive, _ = rendered(Source(Point((4.0, 4.0)), signal), make_bank())
    green, u = random_values()[8], signal.samples(RATE_HZ)
    expected = np.array([np.convolve(u, g[::-1]) for g in green]) / np.sum(green**2)
    assert relative_error(drive.drive_v, expected) < 1e-12


def test_row_19_many_path_points_take_bounded_memory():
    """1e5 points, 10 s; all the points' windows apart would take 1e5 * 50 * 8 * 3 = 120 MB."""
    turns = 1e5 * 0.01 / (2 * np.pi * 8.0)
    source = Source(Circle((12.0, 8.0), 8.0, turns), Noise((50, 400), 0.05), 0.0, 100.0, 0.01, emission="per_point")
    bank = make_bank()
    tracemalloc.start()
    drive, _ = rendered(source, bank)
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


def banded(leak, taps=400):
    spectrum = np.fft.rfft(np.random.default_rng(0).standard_normal((len(GRID_MM), 3, taps)), axis=2)
    frequency = np.fft.rfftfreq(taps, 1 / RATE_HZ)
    spectrum[..., (frequency < 50) | (frequency > 150)] = 0.0
    values = np.fft.irfft(spectrum, taps, axis=2) * np.exp(-np.arange(taps) / 60)
    values += leak * values.std() * np.random.default_rng(1).standard_normal(values.shape)
    return make_bank(values, band_hz=(50.0, 150.0))


@pytest.mark.parametrize("leak", [0.0, 1e-3, 1e-1])
@pytest.mark.parametrize("tolerance_db", [-20.0, -40.0, -60.0])
def test_row_25_leaky_bank_keeps_the_tolerance_with_the_bound_reported(leak, tolerance_db):
    bank = banded(leak)
    exact, _ = rendered(CONTINUOUS, bank)
    drive, report = rendered(CONTINUOUS, bank, tolerance_db=tolerance_db)
    assert relative_error(drive.drive_v, exact.drive_v) <= drive.omitted_bound + 1e-13
    assert report.omitted_bound == drive.omitted_bound <= 10 ** (tolerance_db / 20)


def test_row_26_segments_too_short_for_the_band_render_right_and_are_warned_about():
    bank = banded(0.0)
    fast = Source(PATH, Sine(100.0, 0.05), 0.0, 2000.0, 2.0)
    _, report = rendered(fast, bank, method="sampled")
    assert any("lies outside the bank's band" in text for text in report.warnings)
    assert report.out_of_band[0] > 0.3
    slow = Source(PATH, Sine(100.0, 0.5), 0.0, 40.0, 2.0)
    _, report = rendered(slow, bank, method="sampled")
    assert not any("outside the bank's band" in text for text in report.warnings)


@pytest.mark.parametrize(
    "convert",
    [
        lambda v: v.astype(np.int16),
        lambda v: v.astype(np.float16),
        lambda v: v.astype(">f4"),
        lambda v: v.astype(">i2"),
        np.asfortranarray,
        lambda v: np.repeat(v, 2, axis=2)[..., ::2],
        lambda v: v[:, ::-1][:, ::-1].astype(np.longdouble),
    ],
    ids=["int16", "float16", "big-endian", "big-endian int16", "Fortran", "strided", "longdouble"],
)
def test_rows_27_and_37_bank_of_any_number_type_equals_float64(convert):
    whole = np.round(random_values() * 300)
    plain, _ = rendered(CONTINUOUS, make_bank(whole), SATURATED)
    bank = make_bank(convert(whole))
    drive, _ = rendered(CONTINUOUS, bank, SATURATED)
    assert relative_error(drive.drive_v, plain.drive_v) < 1e-12
    assert relative_error(predict(drive, bank).field, predict(plain, make_bank(whole)).field) < 1e-12


def test_rows_27_and_37_complex_bank_is_refused():
    with pytest.raises(InputError, match=r"complex128, .* real numbers are needed"):
        rendered(CONTINUOUS, make_bank(random_values() + 0j))


def test_row_34_limit_no_factor_can_reach_is_refused():
    with pytest.raises(InputError, match="limit_v"):
        rendered(
            Source(Point((4.0, 4.0)), Impulse(), amplitude=1e150),
            make_bank(),
            output=Output(limit_v=1e-300, interpolation="nearest"),
        )


def test_row_35_emissions_that_overlap_add_up():
    """Points 2 ms apart that each emit 50 ms: the drive is the sum of the points' own drives."""
    source = Source(Line((0.0, 4.0), (24.0, 4.0)), Noise((50, 400), 0.05, 1), 0.0, 2000.0, 4.0, emission="per_point")
    together, _ = rendered(source, make_bank())
    total = np.zeros_like(together.drive_v)
    for m in range(7):
        alone, _ = rendered(Source(Point((4.0 * m, 4.0)), source.signal, m * 0.002), make_bank())
        total[:, : alone.drive_v.shape[1]] += alone.drive_v
    assert relative_error(together.drive_v, total) < 1e-12


def test_row_36_positions_that_repeat_count_once():
    values = random_values()
    twice = GreenArray(np.concatenate([values, 7 * values]), np.concatenate([GRID_MM, GRID_MM]), RATE_HZ)
    for interpolation in ("nearest", "bilinear"):
        drive, _ = rendered(CONTINUOUS, twice, output=Output(interpolation=interpolation))
        once, _ = rendered(CONTINUOUS, make_bank(values), output=Output(interpolation=interpolation))
        assert np.array_equal(drive.drive_v, once.drive_v)


def test_row_36_positions_on_one_line_render_nearest_and_refuse_bilinear():
    on_a_line = GRID_MM[:, :1] * [1.0, 0.0] + np.arange(len(GRID_MM))[:, None] * [0.001, 0.0]
    bank = GreenArray(random_values(), on_a_line, RATE_HZ)
    rendered(Source(Point((4.007, 0.0)), Impulse()), bank)
    with pytest.raises(InputError, match="same y"):
        rendered(CONTINUOUS, bank, output=Output(interpolation="bilinear"))
