"""Drives against a direct evaluation of docs/reference/files.md, one emitted sample after another."""

from dataclasses import replace

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.plate_banks import noise_bank
from wavefocus.config.scene import Output, Regularisation
from wavefocus.drives import render
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.report.render_report import RenderWarning
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle, Line, Point
from wavefocus.rendering.scene.signals import Impulse, Noise, Sine, SoundFile
from wavefocus.storage.errors import InputError

NEAREST = Output(interpolation="nearest")

RATE_HZ = 1000.0
COLUMNS, ROWS, PITCH_MM = 9, 7, 4.0


def green_at(bank, point, kind):
    """g at a point and the row that regularises it."""
    nearest = int(np.argmin(((bank.position_mm - point) ** 2).sum(axis=1)))
    if kind == "nearest":
        return bank.values[nearest].astype(float), nearest
    x, y = (point[0] + 16.0) / PITCH_MM, (point[1] + 12.0) / PITCH_MM
    column, row = min(int(x), COLUMNS - 2), min(int(y), ROWS - 2)
    a, b = x - column, y - row
    corner = bank.values[row * COLUMNS + column :]
    return (
        (1 - a) * (1 - b) * corner[0]
        + a * (1 - b) * corner[1]
        + (1 - a) * b * corner[COLUMNS]
        + a * b * corner[COLUMNS + 1]
    ), nearest


def emitted(source, method, rate_hz=RATE_HZ):
    """Yield (sample, value, point) for everything the source emits, and its last sample plus one."""
    u = source.amplitude * source.signal.samples(rate_hz)
    length, d, v = source.path.length_mm, source.step_mm, source.speed_mm_s
    if length == 0 or v == 0:
        n0 = round(source.start_s * rate_hz)
        point = source.path.point_at([0.0])[0]
        return [(n0 + s, u[s], point) for s in range(len(u))], n0 + len(u)
    points = int(np.floor(length / d + 1e-9)) + 1
    n = [round((source.start_s + m * d / v) * rate_hz) for m in range(points + 1)]
    if source.emission == "per_point":
        events = [(n[m] + s, u[s], source.path.point_at([m * d])[0]) for m in range(points) for s in range(len(u))]
        return events, n[points - 1] + len(u)
    events, m = [], 0
    for s in range(min(len(u), n[points] - n[0])):
        while n[m + 1] <= n[0] + s:
            m += 1
        along = min(v * s / rate_hz, length) if method == "exact" else m * d
        events.append((n[0] + s, u[s], source.path.point_at([along])[0]))
    return events, n[points]


def direct(scene, bank, method, threshold=np.inf):
    """Evaluate eqs. (9) and (16) by plain summation in float64."""
    parts = [emitted(source, method) for source in scene.sources]
    drive = np.zeros((bank.actuators, max(end for _, end in parts) + bank.taps - 1))
    for events, _ in parts:
        for sample, value, point in events:
            green, nearest = green_at(bank, point, scene.output.interpolation)
            own = bank.values[nearest].astype(float)
            rms = np.sqrt(np.mean(own**2, axis=1))
            sigma = np.array([1.0 if r < threshold else threshold / r for r in rms])
            n = 1.0 / np.sum(sigma * np.sum(own**2, axis=1)) if scene.regularisation.normalise else 1.0
            drive[:, sample : sample + bank.taps] += n * value * (sigma[:, None] * green)[:, ::-1]
    return drive


def relative_error(found, expected):
    assert found.shape == expected.shape
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


MOVING = Source(Circle((0, 0), 10.0, 1.3, 20.0), Noise((50, 400), 0.7, 3), 0.01, 100.0, 3.0, 2.0)
REPEATING = Source(Line((-15, -11), (15, 10)), Noise((50, 400), 0.05, 4), 0.2, 100.0, 3.0, 1.5, "per_point")
STANDING = Source(Point((3, 3)), Sine(70, 0.3), 0.3)


@pytest.mark.parametrize("method", ["sampled", "exact"])
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
@pytest.mark.parametrize("threshold", [None, 0.9])
@pytest.mark.parametrize("sources", [(MOVING,), (REPEATING,), (STANDING,), (MOVING, REPEATING, STANDING)])
def test_a_scene_renders_to_the_direct_evaluation_of_the_equations(sources, threshold, interpolation, method):
    bank = noise_bank()
    scene = Scene(
        "s", sources, Regularisation(saturation_absolute=threshold or 0.0), Output(interpolation=interpolation)
    )
    drive, _ = render_with_report(scene, bank, method=method)
    expected = direct(scene, bank, method, threshold or np.inf)
    assert relative_error(drive.drive_v, expected) < 1e-12
    assert drive.omitted_bound == 0.0


@given(
    seed=st.integers(0, 2**31),
    taps=st.integers(1, 90),
    start_s=st.floats(0, 0.5),
    speed_mm_s=st.floats(5, 5000),
    step_mm=st.floats(0.3, 9),
    emission=st.sampled_from(["continuous", "per_point"]),
    method=st.sampled_from(["sampled", "exact"]),
)
def test_any_scene_renders_to_the_direct_evaluation(seed, taps, start_s, speed_mm_s, step_mm, emission, method):
    bank = noise_bank(taps, 2, seed)
    end = tuple(np.random.default_rng(seed).uniform(-12, 12, 2))
    source = Source(Line((-13, 5), end), Noise((0, 500), 0.03, seed), start_s, speed_mm_s, step_mm, 0.7, emission)
    scene = Scene("s", (source,), output=NEAREST)
    if emission == "continuous" and round((start_s + step_mm / speed_mm_s) * RATE_HZ) == round(start_s * RATE_HZ):
        return  # it may emit nothing at all, which is refused
    drive, _ = render_with_report(scene, bank, method=method)
    assert relative_error(drive.drive_v, direct(scene, bank, method)) < 1e-12


@given(position=st.integers(0, ROWS * COLUMNS - 1), amplitude=st.floats(0.01, 100), start_s=st.floats(0, 0.2))
def test_an_impulse_of_amplitude_a_gives_the_response_a_at_its_focus(position, amplitude, start_s):
    bank = noise_bank()
    at_mm = tuple(bank.position_mm[position])
    scene = Scene(
        "s",
        (Source(Point(at_mm), Impulse(), start_s, amplitude=amplitude),),
        Regularisation(saturation=0.8),
        output=NEAREST,
    )
    drive, _ = render_with_report(scene, bank)
    field = predict(drive, bank, [position])
    at = int(drive.focus_sample[0]) + bank.taps - 1
    assert field.field[0, at] == pytest.approx(amplitude, rel=1e-9)
    assert drive.focus_position.tolist() == [position]


def test_a_continuous_emission_lasts_until_the_next_focus_would_come():
    drive, _ = render_with_report(
        Scene("s", (Source(Line((-8, 0), (8, 0)), Sine(50, 0.01), 0.0, 80.0, 4.0),), output=NEAREST), noise_bank()
    )
    assert drive.drive_v.shape[1] == 250 + 60 - 1
    assert drive.focus_sample.tolist() == [0, 50, 100, 150, 200]


def test_the_method_is_sampled_only_where_every_source_emits_per_point():
    bank = noise_bank()

    def method_of(*sources, **options):
        return render_with_report(Scene("s", sources, output=NEAREST), bank, **options)[0].method

    assert method_of(REPEATING) == "sampled"
    assert method_of(MOVING) == "exact"
    assert method_of(MOVING, REPEATING) == "exact"
    assert method_of(MOVING, method="sampled") == "sampled"


def test_a_drive_that_does_not_fit_into_float64_is_refused():
    source = Source(Point((0, 0)), Impulse(), amplitude=1e300)
    with pytest.raises(InputError, match="does not fit into float64"):
        render(Scene("s", (source,), output=NEAREST), noise_bank(scale=1e-90))


def banded_bank(seed, taps, leak):
    """Green's functions within 50 to 150 Hz, and white noise `leak` times as strong everywhere."""
    bank = noise_bank(taps, 2, seed)
    spectrum = np.fft.rfft(bank.values, axis=2)
    frequency = np.fft.rfftfreq(taps, 1 / RATE_HZ)
    spectrum[..., (frequency < 50) | (frequency > 150)] = 0
    values = np.fft.irfft(spectrum, taps, axis=2) * np.exp(-np.arange(taps) / (taps / 6))
    values += leak * values.std() * np.random.default_rng(seed + 1).standard_normal(values.shape)
    return replace(bank, values=values, band_hz=(50.0, 150.0))


@given(
    seed=st.integers(0, 2**31),
    leak=st.sampled_from([0.0, 1e-6, 1e-4, 1e-2]),
    tolerance_db=st.floats(-120, -3),
    speed_mm_s=st.sampled_from([0.0, 20.0, 300.0]),
    emission=st.sampled_from(["continuous", "per_point"]),
    threshold=st.sampled_from([None, 0.5]),
    interpolation=st.sampled_from(["nearest", "bilinear"]),
)
def test_the_bound_is_never_smaller_than_the_error_of_what_was_left_out(
    seed, leak, tolerance_db, speed_mm_s, emission, threshold, interpolation
):
    bank = banded_bank(seed, 300, leak)
    end = tuple(np.random.default_rng(seed).uniform(-12, 12, 2))
    path = Line((-13, 5), end) if speed_mm_s else Point(end)
    source = Source(path, Noise((40, 200), 0.4, seed), 0.0, speed_mm_s, 2.0, 1.0, emission)
    scene = Scene(
        "s", (source, STANDING), Regularisation(saturation=threshold or 0.0), Output(interpolation=interpolation)
    )
    exact, _ = render_with_report(scene, bank)
    drive, _ = render_with_report(scene, bank, tolerance_db=tolerance_db)
    assert relative_error(drive.drive_v, exact.drive_v) <= drive.omitted_bound + 1e-13
    assert drive.omitted_bound <= 10 ** (tolerance_db / 20)


def test_within_a_tolerance_single_precision_is_used_and_stated():
    bank = banded_bank(3, 400, 0.0)
    exact, _ = render_with_report(Scene("s", (MOVING,), output=NEAREST), bank)
    drive, report = render_with_report(Scene("s", (MOVING,), output=NEAREST), bank, tolerance_db=-20)
    assert report.single
    assert 0 < drive.omitted_bound <= 0.1
    assert 0 < relative_error(drive.drive_v, exact.drive_v) <= drive.omitted_bound


@given(
    seed=st.integers(0, 2**31),
    weak=st.sampled_from([0.0, 1e-9, 1e-5, 1e-2]),
    decay=st.sampled_from([4, 12, 60]),
    quiet=st.sampled_from([0.0, 1e-7, 1e-4]),
    tolerance_db=st.floats(-75, -10),
    threshold=st.sampled_from([None, 0.5]),
)
def test_the_bound_holds_with_weak_actuators_short_responses_and_quiet_stretches(
    tmp_path_factory, seed, weak, decay, quiet, tolerance_db, threshold
):
    bank = banded_bank(seed, 300, 0.0)
    values = bank.values * np.exp(-np.arange(300) / decay)
    values[:, 1] *= weak
    bank = replace(bank, values=values)
    signal = np.random.default_rng(seed).standard_normal(900)
    signal[300:700] *= quiet
    file = tmp_path_factory.mktemp("signal") / "quiet.wav"
    soundfile.write(file, signal / np.abs(signal).max(), int(RATE_HZ), subtype="DOUBLE")
    source = Source(Line((-13, 5), (14, -9)), SoundFile(file), 0.0, 32.0, 0.5)
    scene = Scene("s", (source,), Regularisation(saturation=threshold or 0.0), output=NEAREST)
    exact, _ = render_with_report(scene, bank)
    drive, _ = render_with_report(scene, bank, tolerance_db=tolerance_db)
    assert relative_error(drive.drive_v, exact.drive_v) <= drive.omitted_bound + 1e-13
    assert drive.omitted_bound <= 10 ** (tolerance_db / 20)


@pytest.mark.parametrize(
    ("source", "message"),
    [
        (Source(Line((-8, 0), (8, 0)), Impulse(), 0, 0.0, 4.0), "speed_mm_s of source 0 is 0"),
        (Source(Line((-8, 0), (8, 0)), Impulse(), 0, 80.0, 0.0), "step_mm of source 0 is 0"),
        (Source(Line((-8, 0), (8, 0)), Impulse(), 0, 80.0, 1e-9), "path points; at most"),
        (Source(Line((-8, 0), (8, 0)), Impulse(), 0, 1e9, 4.0), "emits nothing"),
        (Source(Point((0, 0)), Impulse(), 1e9), "samples are allowed"),
    ],
)
def test_a_source_that_cannot_be_sampled_is_refused(source, message):
    with pytest.raises(InputError, match=message):
        render(Scene("s", (source,), output=NEAREST), noise_bank())


def test_a_doubtful_row_on_the_path_is_used_with_a_warning():
    status = np.ones(ROWS * COLUMNS, np.uint8)
    status[31] = 4
    bank = noise_bank(status=status)
    _, report = render_with_report(Scene("s", (Source(Point((0, 0)), Impulse()),), output=NEAREST), bank)
    assert report.rows == (31,)
    assert any("position 31" in text for text in report.warnings)
    with pytest.warns(RenderWarning, match="position 31"):
        render(Scene("s", (Source(Point((0, 0)), Impulse()),), output=NEAREST), bank)
