"""Drives against a direct evaluation of docs/reference/files.md: in memory, in blocks, written, on other devices."""

import importlib.util
import itertools
import tracemalloc
from dataclasses import replace
from types import SimpleNamespace

import array_api_strict
import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.plate_banks import NOISE_MM, noise_bank
from wavefocus import Circle, Impulse, InputError, Line, Noise, Point, Scene, Sine, Source, read_drive, render
from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.device import Device, cuda_device, host_device
from wavefocus.rendering.drive.coil_limits import levels_of
from wavefocus.rendering.drive.rendering import SceneRenderer, render_with_report
from wavefocus.rendering.drive.wav import stream_wav, wav_format
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.report.render_report import RenderWarning

RATE_HZ, COLUMNS, PITCH_MM = 1000.0, 9, 4.0
MOVING = Source(Circle((0, 0), 10.0, 1.3, 20.0), Noise((50, 400), 0.7, 3), 0.01, 100.0, 3.0, 2.0)
REPEATING = Source(Line((-15, -11), (15, 10)), Noise((50, 400), 0.05, 4), 0.2, 100.0, 3.0, 1.5, "per_point")
STANDING = Source(Point((3, 3)), Sine(70, 0.3), 0.3)
LATE = Source(Point((-3, 5)), Impulse(), 3.0)
SATURATED = Regularisation(saturation_absolute=0.9)


def scene_of(*sources, regularisation=None, **output):
    return Scene("s", sources, regularisation or Regularisation(), Output(**{"interpolation": "nearest", **output}))


def drive_of(*sources, bank=None, method=None, **options):
    return render_with_report(scene_of(*sources, **options), bank or noise_bank(), method=method)[0]


def green_at(bank, point, kind):
    """g at a point and the row that regularises it."""
    nearest = int(np.argmin(((bank.position_mm - point) ** 2).sum(axis=1)))
    if kind == "nearest":
        return bank.values[nearest].astype(float), nearest
    x, y = (point[0] + 16.0) / PITCH_MM, (point[1] + 12.0) / PITCH_MM
    column, row = min(int(x), COLUMNS - 2), min(int(y), len(NOISE_MM) // COLUMNS - 2)
    a, b, first = x - column, y - row, row * COLUMNS + column
    corners = bank.values[[first, first + 1, first + COLUMNS, first + COLUMNS + 1]]
    return np.tensordot([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], corners, 1), nearest


def emitted(source, method, rate_hz=RATE_HZ):
    """(sample, value, point) of everything that the source emits, and its last sample plus one."""
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


def direct(scene, bank, method):
    """Evaluate eqs. (9) and (16) by plain summation in float64."""
    parts = [emitted(source, method) for source in scene.sources]
    drive = np.zeros((bank.actuators, max(end for _, end in parts) + bank.taps - 1))
    for sample, value, point in itertools.chain(*(events for events, _ in parts)):
        green, nearest = green_at(bank, point, scene.output.interpolation)
        own = bank.values[nearest].astype(float)
        rms, threshold = np.sqrt(np.mean(own**2, axis=1)), scene.regularisation.saturation_absolute or np.inf
        sigma = np.minimum(1.0, threshold / rms)
        n = 1.0 / np.sum(sigma * np.sum(own**2, axis=1))
        drive[:, sample : sample + bank.taps] += n * value * (sigma[:, None] * green)[:, ::-1]
    return drive


def relative_error(found, expected):
    assert found.shape == expected.shape
    return np.linalg.norm(found - expected) / np.linalg.norm(expected)


@pytest.mark.parametrize("method", ["exact", "sampled"])
@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
def test_a_scene_in_memory_and_in_blocks_is_the_direct_evaluation(interpolation, method):
    """Sources that begin and end at other times and of other lengths share blocks and transforms."""
    held = SATURATED if (interpolation == "nearest") == (method == "exact") else Regularisation()
    scene = scene_of(MOVING, REPEATING, STANDING, LATE, regularisation=held, interpolation=interpolation)
    drive, _ = render_with_report(scene, noise_bank(), method=method)
    assert relative_error(drive.drive_v, direct(scene, noise_bank(), method)) < 1e-12
    assert drive.omitted_bound == 0.0
    blocks = list(SceneRenderer(scene, noise_bank(), method=method).unlimited_blocks())
    np.testing.assert_array_equal(np.concatenate(blocks, axis=1), drive.drive_v)


@settings(max_examples=10)
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
    bank, end = noise_bank(taps, 2, seed), tuple(np.random.default_rng(seed).uniform(-12, 12, 2))
    source = Source(Line((-13, 5), end), Noise((0, 500), 0.03, seed), start_s, speed_mm_s, step_mm, 0.7, emission)
    if emission == "continuous" and round((start_s + step_mm / speed_mm_s) * RATE_HZ) == round(start_s * RATE_HZ):
        return  # it may emit nothing at all, which is refused
    found = drive_of(source, bank=bank, method=method).drive_v
    assert relative_error(found, direct(scene_of(source), bank, method)) < 1e-12


def test_an_impulse_of_amplitude_a_gives_the_response_a_at_its_focus():
    for position, amplitude, start_s in ((0, 0.01, 0.0), (31, 1.0, 0.1), (62, 100.0, 0.1234)):
        source = Source(Point(tuple(NOISE_MM[position])), Impulse(), start_s, amplitude=amplitude)
        drive = drive_of(source, regularisation=Regularisation(saturation=0.8))
        field = predict(drive, noise_bank(), [position]).field[0]
        assert field[int(drive.focus_sample[0]) + noise_bank().taps - 1] == pytest.approx(amplitude, rel=1e-9)
        assert drive.focus_position.tolist() == [position]


def test_continuous_emission_lasts_to_the_next_focus_and_is_exact():
    drive = drive_of(Source(Line((-8, 0), (8, 0)), Sine(50, 0.01), 0.0, 80.0, 4.0))
    assert (drive.drive_v.shape[1], drive.focus_sample.tolist()) == (250 + 60 - 1, [0, 50, 100, 150, 200])
    assert drive_of(REPEATING).method == drive_of(MOVING, method="sampled").method == "sampled"
    assert drive_of(MOVING).method == drive_of(MOVING, REPEATING).method == "exact"


def given_signal(values):
    """A signal given by its samples."""
    return SimpleNamespace(samples=lambda sample_rate_hz: values)


def banded_bank(seed, leak, *, decay=50.0, weak=1.0):
    """Rows within 50 to 150 Hz that decay, one actuator `weak`, and white noise `leak` times as strong everywhere."""
    bank = noise_bank(300, 2, seed)
    spectrum, frequency = np.fft.rfft(bank.values, axis=2), np.fft.rfftfreq(300, 1 / RATE_HZ)
    spectrum[..., (frequency < 50) | (frequency > 150)] = 0
    values = np.fft.irfft(spectrum, 300, axis=2) * np.exp(-np.arange(300) / decay) * np.array([[1.0], [weak]])
    values += leak * values.std() * np.random.default_rng(seed + 1).standard_normal(values.shape)
    return replace(bank, values=values, band_hz=(50.0, 150.0))


@settings(max_examples=15)
@given(
    seed=st.integers(0, 2**31),
    leak=st.sampled_from([0.0, 1e-6, 1e-4, 1e-2]),
    weak=st.sampled_from([1.0, 0.0, 1e-9, 1e-5, 1e-2]),
    decay=st.sampled_from([4.0, 12.0, 60.0]),
    silence=st.sampled_from([0.0, 1e-7, 1e-4, 1.0]),
    tolerance_db=st.floats(-120, -3),
    speed_mm_s=st.sampled_from([0.0, 20.0, 300.0]),
    emission=st.sampled_from(["continuous", "per_point"]),
    saturation=st.sampled_from([0.0, 0.5]),
    interpolation=st.sampled_from(["nearest", "bilinear"]),
)
def test_the_bound_is_never_smaller_than_the_error_of_what_was_left_out(
    seed, leak, weak, decay, silence, tolerance_db, speed_mm_s, emission, saturation, interpolation
):
    bank, end = banded_bank(seed, leak, decay=decay, weak=weak), tuple(np.random.default_rng(seed).uniform(-12, 12, 2))
    signal = Noise((40, 200), 0.4, seed).samples(RATE_HZ)
    signal[130:300] *= silence
    path = Line((-13, 5), end) if speed_mm_s else Point(end)
    sources = Source(path, given_signal(signal), 0.0, speed_mm_s, 2.0, 1.0, emission), STANDING
    scene = scene_of(*sources, regularisation=Regularisation(saturation=saturation), interpolation=interpolation)
    exact, _ = render_with_report(scene, bank)
    drive, _ = render_with_report(scene, bank, tolerance_db=tolerance_db)
    assert relative_error(drive.drive_v, exact.drive_v) <= drive.omitted_bound + 1e-13
    assert drive.omitted_bound <= 10 ** (tolerance_db / 20)


def test_a_source_that_cannot_be_rendered_is_refused():
    line, bank = Line((-8, 0), (8, 0)), noise_bank(scale=1e-6)
    for source, message in (
        (Source(line, Impulse(), 0, 0.0, 4.0), "speed_mm_s of source 0 is 0"),
        (Source(line, Impulse(), 0, 80.0, 0.0), "step_mm of source 0 is 0"),
        (Source(line, Impulse(), 0, 80.0, 1e-9), "path points; at most"),
        (Source(line, Impulse(), 0, 1e9, 4.0), "emits nothing"),
        (Source(Point((0, 0)), Impulse(), 1e9), "samples are allowed"),
        (Source(Point((0, 0)), Impulse(), amplitude=1e308), "does not fit into float64"),
        (Source(Point((0, 0)), given_signal(np.zeros(0))), "the signal of source 0 is empty"),
        (Source(Point((4, 4)), Sine(100.0, 1e-9)), "signal of source 0: .* no sample to emit"),
    ):
        with pytest.raises(InputError, match=message):
            render(scene_of(source), bank)


def test_a_doubtful_row_on_the_path_warns_and_a_failed_one_ends_the_blocks_there():
    doubtful = noise_bank(status=np.where(np.arange(63) == 31, 4, 1).astype(np.uint8))
    with pytest.warns(RenderWarning, match="position 31"):
        render(scene_of(Source(Point((0, 0)), Impulse())), doubtful)
    status = np.full(len(NOISE_MM), 4, np.uint8)
    status[np.argmin(((NOISE_MM - (15, 10)) ** 2).sum(axis=1))] = 8
    source = Source(Line((-15, -11), (15, 10)), Noise((50, 400), 60.0, 4), 0.0, 0.6, 0.3)
    blocks = SceneRenderer(scene_of(source), noise_bank(status=status), method="sampled").unlimited_blocks()
    assert len(list(itertools.islice(blocks, 3))) == 3
    with pytest.raises(InputError, match="marked as failed"):
        list(blocks)


def test_memory_does_not_grow_with_the_drives():
    """A scene 16 times as long takes 16 times as much for its signal (8 bytes a sample), and no more for its drives."""
    most = {}
    for turns in (2.0, 32.0):
        source = Source(Circle((0, 0), 10.0, turns), Sine(70, 1.0), 0.0, 40.0, 3.0)
        streamed = SceneRenderer(scene_of(source, limit_v=1e-3, limit_rms_v=1e-3), noise_bank())
        tracemalloc.start()
        for _ in streamed.unlimited_blocks():
            pass
        most[turns] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        assert streamed.shape[1] > 1500 * turns
    assert most[32.0] - most[2.0] < 3 * 8 * 30 * 1570 / 4


@pytest.mark.parametrize("rate_hz", [1000, 44_100])
def test_a_streamed_wav_is_the_whole_one_and_beyond_full_scale_it_is_refused(tmp_path, rate_hz):
    renderer = SceneRenderer(scene_of(MOVING, REPEATING), noise_bank())
    whole, wav = drive_of(MOVING, REPEATING).drive_v, tmp_path / "a.wav"

    def written(blocks, full_scale_v, **options):
        form = {"interface_rate_hz": rate_hz, "full_scale_v": full_scale_v, **options}
        stream_wav(wav, blocks, renderer.shape, RATE_HZ, **form)
        return soundfile.read(wav)

    with pytest.raises(InputError, match="beyond the interface's full scale"):
        written(renderer.unlimited_blocks(), 1e-9)
    assert not list(tmp_path.iterdir())
    expected, _ = written([whole], 1.5 * np.abs(whole).max())
    found, written_hz = written(renderer.unlimited_blocks(), 1.5 * np.abs(whole).max(), chunk_samples=128)
    assert written_hz == rate_hz
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-7)
    assert [wav_format(size) for size in (2**32 - 1, 2**32)] == ["WAV", "RF64"]


ALL, HUGE = (MOVING, REPEATING, STANDING), Source(Point((3, 3)), Noise((50, 400), 0.7, 3), amplitude=1e42)


@pytest.mark.parametrize(
    ("sources", "limits", "tolerance_db"),
    [
        (ALL, {"limit_v": 1e-3}, None),
        (ALL, {"limit_v": 1e-3, "limit_rms_v": 2e-4}, -40.0),
        (ALL, {}, -40.0),
        ([Source(Point((3, 3)), Impulse())], {"limit_rms_v": 1e-3}, None),
        ([HUGE], {}, -40.0),
    ],
    ids=["peak", "power", "tolerance", "one sample", "beyond single precision"],
)
def test_a_written_drive_is_the_one_in_memory_scaled_by_the_same_limits(sources, limits, tolerance_db, tmp_path):
    scene = scene_of(*sources, regularisation=Regularisation(saturation=0.5), **limits)
    whole, report = render_with_report(scene, noise_bank(), tolerance_db=tolerance_db)
    streamed = SceneRenderer(scene, noise_bank(), tolerance_db=tolerance_db)
    told = streamed.write(tmp_path / "d.h5")
    written = read_drive(tmp_path / "d.h5")
    assert written.verified
    assert np.isfinite(written.drive_v).all()
    assert (told.omitted_bound > 0) == (sources is ALL and tolerance_db is not None)
    assert (written.scale, written.omitted_bound) == (told.scale, told.omitted_bound)
    for name in ("focus_sample", "focus_position", "focus_source", "focus_mm", "start_s", "method"):
        np.testing.assert_array_equal(getattr(written, name), getattr(whole, name))
    np.testing.assert_allclose(written.drive_v, whole.drive_v, rtol=0, atol=1e-12 * np.abs(whole.drive_v).max())
    assert (told.limiting.decided_by, told.limiting.actuator) == (report.limiting.decided_by, report.limiting.actuator)
    assert told.scale == pytest.approx(report.scale, rel=1e-11)
    assert told.warnings == report.warnings
    np.testing.assert_allclose(told.relative_rms_drive, report.relative_rms_drive, rtol=1e-9)
    assert np.abs(written.drive_v).max() <= limits.get("limit_v", np.inf)
    assert levels_of(written.drive_v, RATE_HZ).rms_v.max() <= limits.get("limit_rms_v", np.inf)
    assert streamed.peak_v == pytest.approx(np.abs(written.drive_v).max(), rel=1e-12)


STRICT = Device(array_api_strict, np.from_dlpack, 2**16)


@settings(max_examples=5)
@given(
    sources=st.lists(st.sampled_from([MOVING, REPEATING, STANDING]), min_size=1, max_size=3),
    saturation=st.sampled_from([0.0, 0.7]),
    normalise=st.booleans(),
    interpolation=st.sampled_from(["nearest", "bilinear"]),
    scale=st.sampled_from([1.0, 1e-12, 1e12]),
    taps=st.integers(1, 90),
)
def test_given_any_bank_and_scene_then_the_array_api_standard_alone_gives_the_drives(
    sources, saturation, normalise, interpolation, scale, taps
):
    bank = noise_bank(taps, scale=scale, band_hz=(50.0, 400.0))
    held = Regularisation(saturation=saturation, normalise=normalise)
    scene = scene_of(*sources, regularisation=held, interpolation=interpolation)
    expected, report = render_with_report(scene, bank)
    for device in (STRICT, host_device()):
        found, told = render_with_report(scene, bank, device=device)
        assert np.abs(found.drive_v - expected.drive_v).max() <= 1e-12 * np.abs(expected.drive_v).max()
        assert (found.omitted_bound, told.omitted_bound, told.warnings) == (0.0, 0.0, report.warnings)
        assert told.out_of_band == pytest.approx(report.out_of_band, abs=1e-3)


def test_a_tolerance_on_another_device_is_refused():
    with pytest.raises(InputError, match="does not go with --tolerance-db"):
        render_with_report(scene_of(MOVING), noise_bank(), tolerance_db=-60.0, device=host_device())


@pytest.mark.may_skip("a GPU is not everywhere")
@pytest.mark.skipif(importlib.util.find_spec("cupy") is None, reason="needs CuPy and a GPU")
def test_given_a_gpu_then_it_gives_the_drives_and_fields_of_the_cpu():
    bank, held = noise_bank(500, band_hz=(50.0, 400.0)), Regularisation(saturation=0.7)
    scene = scene_of(MOVING, REPEATING, STANDING, regularisation=held, interpolation="bilinear")
    here, there = (render_with_report(scene, bank, device=one)[0] for one in (host_device(), cuda_device()))
    assert np.abs(there.drive_v - here.drive_v).max() <= 1e-12 * np.abs(here.drive_v).max()
    expected, found = (predict(here, bank, device=one).field for one in (host_device(), cuda_device()))
    assert np.abs(found - expected).max() <= 1e-12 * np.abs(expected).max()


@pytest.mark.may_skip("it is about machines without CuPy")
@pytest.mark.skipif(importlib.util.find_spec("cupy") is not None, reason="CuPy is installed")
def test_given_no_cupy_then_a_sentence_says_what_to_install():
    with pytest.raises(InputError, match="pip install cupy"):
        cuda_device()
