"""Scenes: the values that a source may hold, its signals and trajectories, and the positions that a scene needs."""

from dataclasses import replace

import numpy as np
import pytest
import soundfile
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.unit.plate_banks import NOISE_MM, SQUARE_MM, noise_bank, plate_bank
from wavefocus import Circle, InputError, Line, Point, Polyline, Scene, Source, load_scene
from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.rendering import SceneRenderer, render_with_report
from wavefocus.rendering.greens.interpolation.base import interpolation_method
from wavefocus.rendering.greens.interpolation.position_grid import PositionGrid
from wavefocus.rendering.scene.sampling import sample_scene, scene_size
from wavefocus.rendering.scene.scene_rows import scene_rows
from wavefocus.rendering.scene.signals import Impulse, Noise, Sine, SoundFile
from wavefocus.rendering.scene.trajectory import Trajectory, TrajectoryPath

NAN, INF = float("nan"), float("inf")
RATE_HZ = 1000.0
#: Off the samples, resting for a while, and along y = 2 mm, where two rows of positions are equally near.
TIME_S = (0.0104, 0.05, 0.1, 0.1022, 0.1998, 0.2, 0.31)  # two rows within one sample
PLACES_MM = ((-14.0, -10.0), (0.0, 3.3), (6.0, 2.0), (6.0, 2.0), (6.0, 2.0), (15.0, 2.0), (3.1, -9.0))
AMPLITUDE = (0.0, 1.0, 2.0, 2.0, 0.0, -1.0, 0.5)
NOISE = Noise((50.0, 400.0), 0.07, 3)
FINGER = Source(TrajectoryPath(TIME_S, PLACES_MM, AMPLITUDE), NOISE, 0.02, amplitude=3.0, repeat=True)


def scene_of(*sources, interpolation="nearest"):
    return Scene("t", sources, Regularisation(normalise=False), Output(interpolation=interpolation))


def bank_of(rows):
    """Some rows of the bank; the others were not measured."""
    return noise_bank(status=np.isin(np.arange(len(NOISE_MM)), rows).astype(np.uint8) * 4)


def drive_v(scene, bank=None, **options):
    return render_with_report(scene, bank or noise_bank(), **options)[0].drive_v


LINE = Source(Line((0, 0), (10, 0)), Impulse(), speed_mm_s=80.0, step_mm=4.0)
WRONG_FIGURES = (
    ("start_s", -0.1), ("start_s", NAN), ("amplitude", INF), ("emission", "once"), ("speed_mm_s", -1.0),
    ("speed_mm_s", NAN), ("step_mm", -4.0), ("step_mm", INF),
)  # fmt: skip
TWO = ((0.0, 0.0), (1.0, 0.0))
OUT_OF_RANGE = {
    "no source": lambda: Scene("empty", ()),
    "emission is 'per_point'": lambda: Source(FINGER.path, NOISE, emission="per_point"),
    "repeat is true; .* a path that": lambda: Source(Point((0.0, 0.0)), NOISE, repeat=True),
    "repeat is true; it needs emission": lambda: replace(LINE, emission="per_point", repeat=True),
    "at least two": lambda: TrajectoryPath((0.0,), ((0.0, 0.0),)),
    "2 instants, places of shape .3": lambda: TrajectoryPath((0.0, 1.0), (*TWO, (2.0, 0.0))),
    "row 1 .* later than in the row before": lambda: TrajectoryPath((0.0, 0.0), TWO),
    "row 0 .* -0.1 s": lambda: TrajectoryPath((-0.1, 0.0), TWO),
    "nan. mm": lambda: TrajectoryPath((0.0, 1.0), ((0.0, 0.0), (1.0, NAN))),
    "amplitude inf": lambda: TrajectoryPath((0.0, 1.0), TWO, (1.0, INF)),
}


def test_a_scene_source_or_trajectory_out_of_range_is_refused_by_name():
    Source(Point((1.0, 2.0)), Impulse(), speed_mm_s=-5.0, step_mm=NAN)  # a point needs neither speed nor step
    for name, value in WRONG_FIGURES:
        with pytest.raises(InputError, match=f"{name} is {value!r}"):
            replace(LINE, **{name: value})
    for message, make in OUT_OF_RANGE.items():
        with pytest.raises(InputError, match=message):
            make()


# --- positions that a scene needs


places = st.tuples(st.floats(-15.0, 15.0), st.floats(-11.0, 11.0))
paths = st.one_of(
    st.builds(Point, places),
    st.builds(Line, places, places),
    st.builds(Circle, st.just((0.0, 0.0)), st.floats(1.0, 11.0), st.floats(0.1, 2.0), st.floats(0.0, 360.0)),
    st.builds(Polyline, st.lists(places, min_size=2, max_size=4)),
)


def moving(path):
    return Source(path, Sine(100.0, 0.2), speed_mm_s=150.0, step_mm=3.3)


@settings(max_examples=8)
@given(path=paths, kind=st.sampled_from(["nearest", "bilinear"]), method=st.sampled_from(["sampled", "exact"]))
def test_a_bank_of_the_path_s_rows_alone_renders_as_the_whole_bank_does(path, kind, method):
    scene = scene_of(moving(path), interpolation=kind)
    partial = bank_of(scene_rows(scene, NOISE_MM).path)
    np.testing.assert_array_equal(drive_v(scene, partial, method=method), drive_v(scene, method=method))


GRID_MM = np.array([(x, y) for y in np.arange(-24.0, 25.0, 4.0) for x in np.arange(-40.0, 41.0, 4.0)])


def test_the_kernel_needs_neighbours_too_and_checks_all_near_the_path():
    path = Line((-10.0, 1.0), (12.0, 3.0))
    nearest, kernel = (
        scene_rows(scene_of(moving(path), interpolation=kind), GRID_MM) for kind in ("nearest", "kernel")
    )
    assert set(nearest.path) < set(kernel.path)
    along_mm = path.point_at(np.linspace(0, path.length_mm, 99))
    distance = np.min(np.hypot(*(GRID_MM[:, None] - along_mm).transpose(2, 0, 1)), 1)
    assert set(np.flatnonzero(distance < 10.0)) <= set(kernel.path)
    rows = scene_rows(scene_of(moving(Point((1.0, 1.0))), moving(Point((31.0, -20.0)))), GRID_MM)
    distance = np.min([np.hypot(*(GRID_MM - at).T) for at in ((1.0, 1.0), (31.0, -20.0))], axis=0)
    assert set(np.flatnonzero(distance < 15.0)) <= set(rows.checks)
    assert distance[rows.checks].max() <= 19.0 + 1e-6
    np.testing.assert_array_equal(rows.all, np.union1d(rows.path, rows.checks))
    assert len(rows.path) == 2
    assert len(rows.all) < len(GRID_MM) / 2
    assert list(scene_rows(scene_of(moving(Point((0.0, 0.0)))), np.zeros((1, 2))).path) == [0]
    long_mm, amid = GRID_MM * (1.0, 5.0), moving(Point((2.0, 10.0)))
    assert len(scene_rows(scene_of(amid, interpolation="bilinear"), long_mm).path) == 4
    with pytest.raises(InputError, match="at most one grid spacing, 4 mm"):
        scene_rows(scene_of(amid), long_mm)


# --- trajectories


@pytest.mark.parametrize(("interpolation", "repeat"), [("nearest", True), ("bilinear", False)])
def test_given_a_trajectory_then_its_drive_is_equation_9_summed_directly(interpolation, repeat):
    bank = noise_bank()
    drive, _ = render_with_report(scene_of(replace(FINGER, repeat=repeat), interpolation=interpolation), bank)
    knots = np.rint((0.02 + np.array(TIME_S)) * RATE_HZ)
    sample = np.arange(int(knots[0]), int(knots[-1]))
    emitted = np.append(NOISE.samples(RATE_HZ), [] if repeat else np.zeros(len(sample)))
    emitted = np.resize(emitted, len(sample)) * 3.0 * np.interp(sample, knots, AMPLITUDE)
    places_mm = np.stack([np.interp(sample, knots, axis_mm) for axis_mm in np.transpose(PLACES_MM)], axis=1)
    nodes = interpolation_method(interpolation).over(bank, places_mm).nodes(places_mm)
    meant = np.zeros((3, sample[-1] + bank.taps))
    for s, value, rows, weights in zip(sample, emitted, nodes.rows, nodes.weights, strict=True):
        meant[:, s : s + bank.taps] += value * np.tensordot(weights, bank.values[rows], 1)[:, ::-1]
    np.testing.assert_allclose(drive.drive_v, meant, rtol=0, atol=1e-12 * np.abs(meant).max())
    assert drive.focus_sample.tolist() == [70, 120, 220]
    assert NOISE_MM[drive.focus_position].tolist() == [[0.0, 4.0], [4.0, 0.0], [16.0, 0.0]]


def test_given_a_trajectory_then_all_that_looks_at_paths_takes_it():
    scene = scene_of(FINGER, Source(Point((0.0, 0.0)), Sine(70.0, 0.1)))
    whole, _ = render_with_report(scene, noise_bank())
    blocks = list(SceneRenderer(scene, noise_bank()).unlimited_blocks())
    size = scene_size(scene, sample_rate_hz=RATE_HZ, taps=60, actuators=3)
    assert size.samples == pytest.approx(whole.drive_v.shape[1], abs=1)
    assert size.path_points == len(whole.focus_sample)
    for other in (drive_v(scene, method="sampled"), np.concatenate(blocks, axis=1)):
        np.testing.assert_allclose(other, whole.drive_v, rtol=0, atol=1e-12 * np.abs(whole.drive_v).max())
    needed = scene_rows(scene, NOISE_MM)
    assert len(needed.path) < len(NOISE_MM) / 2
    np.testing.assert_array_equal(drive_v(scene, bank_of(needed.all)), whole.drive_v)
    line = Source(Line((-10.0, 0.0), (10.0, 0.0)), NOISE, 0.0, 100.0, 4.0, repeat=True)
    (sampled,) = sample_scene(scene_of(line), noise_bank()).sources
    assert sampled.signal.tolist() == np.resize(NOISE.samples(RATE_HZ), 240).tolist()
    stated = scene_size(scene_of(line), sample_rate_hz=RATE_HZ, taps=60, actuators=3)
    assert (stated.signal_samples, stated.path_points) == (240, len(sampled.focus_sample))
    assert stated.samples == drive_v(scene_of(line), method="sampled").shape[1]


def test_kernel_interpolation_then_a_trajectory_round_a_circle_is_nearly_that_circle():
    circle = Source(Circle((1.3, -0.7), 13.0, 0.4), Noise((80.0, 420.0), 0.1, 3), 0.0, 180.0, 3.0)
    along_mm = np.arange(0.0, circle.path.length_mm, 0.9)
    course = Source(TrajectoryPath(along_mm / 180.0, circle.path.point_at(along_mm)), circle.signal)
    bank = plate_bank(noise_db=-60.0)
    drives = [drive_v(scene_of(one, interpolation="kernel"), bank)[:, :560] for one in (circle, course)]
    np.testing.assert_allclose(drives[1], drives[0], rtol=0, atol=0.02 * np.abs(drives[0]).max())


def test_rows_close_in_time_or_silent_are_no_foci_and_a_resting_finger_is_a_point():
    places_mm = [(4.0 * (row // 4), 0.0) for row in range(9)]
    path = TrajectoryPath(np.arange(9) * 0.004, places_mm, (1, 1, 1, 0, 0, 1, 1, 1, 1))
    assert path.focus_rows.tolist() == [0, 5]
    assert path.length_mm == 4.0
    assert path.point_at([0.0, 3.0]).tolist() == [[4.0, 0.0], [7.0, 0.0]]
    resting = Source(TrajectoryPath((0.0, 0.07), ((4.0, 4.0), (4.0, 4.0))), NOISE)
    there, at_rest = (drive_v(scene_of(one)) for one in (Source(Point((4.0, 4.0)), NOISE), resting))
    np.testing.assert_allclose(at_rest, there, rtol=0, atol=1e-13 * np.abs(there).max())
    (a, b), sounds = ((4.0, 4.0), (0.0, -8.0)), (1, 0, 0, 0, 1, 0)
    for lifted_s in (0.04, 0.0204):  # it may leave the grid within the sample in which it is lifted
        time_s = 0.0, 0.02, lifted_s, 0.06, 0.08, 0.1
        jumps = [TrajectoryPath(time_s, (a, a, silent, b, b, b), sounds) for silent in (a, (500.0, 0.0))]
        np.testing.assert_array_equal(*(drive_v(scene_of(Source(jump, NOISE, repeat=True))) for jump in jumps))


@pytest.mark.parametrize("stroke", [False, True])
def test_kernel_interpolation_then_rests_between_jumps_sound_at_their_own_places(stroke):
    (a, b), taps = (
        ((-14.0, -10.0), (2.0, -4.3)),
        [(9.0, 7.0)] * 3 + [(1.0, 13.0), (1.0 + 0.9 * stroke, 13.0), (1.0, 13.0)],
    )
    places_mm, sounds = [a, b, b, b, *taps, b, a] if stroke else taps, [0, 1, 0] * 2
    path = TrajectoryPath(0.1 * np.arange(len(places_mm)), places_mm, [0, 1, 1, 0, *sounds, 0, 1] if stroke else sounds)
    scene, bank = scene_of(Source(path, Noise((80.0, 420.0), 1.0, 3)), interpolation="kernel"), plate_bank()
    sampled, course = sample_scene(scene, bank), path.trajectory(0.0, bank.sample_rate_hz)
    nodes = sampled.sources[0].emission.events(0, course.sample[-1]).nodes
    at_mm, heard = course.at(np.arange(course.sample[-1]))
    found_mm = np.einsum("ij,ijk->ik", nodes.weights, sampled.interpolation.rows_of(bank).position_mm[nodes.rows])
    np.testing.assert_allclose(found_mm[heard != 0], at_mm[heard != 0], atol=1e-5)
    assert np.isin(PositionGrid(NOISE_MM).nearest(np.array(taps))[0], scene_rows(scene, NOISE_MM).path).all()


@pytest.mark.parametrize(
    ("x_mm", "where"), [(500.0, r"the path of source 0 lies at \(500, -15\)"), (2.3, r"source 0, 0\.448\d* s after")]
)
def test_a_stroke_off_the_grid_or_across_a_hole_is_refused_where_it_is(x_mm, where):
    ends_mm = [(x_mm, -15.0)] * 2 + [(x_mm, 20.0 if x_mm < 10 else -15.0)]
    path = TrajectoryPath(0.1 * np.arange(6), [(-9.0, 1.0)] * 3 + ends_mm, [0, 1, 0] * 2)
    bank = plate_bank(SQUARE_MM[~np.isin(SQUARE_MM, (0.0, 4.0)).all(axis=1)])
    with pytest.raises(InputError, match=f"^{where}"):
        sample_scene(scene_of(Source(path, NOISE), interpolation="kernel"), bank).sources[0].emission.events(0, 1000)


HEADER = "time_s,x_mm,y_mm,amplitude\n"
HOSTILE = {
    "empty": "", "header alone": HEADER, "one row": HEADER + "0,0,0,1\n", "other columns": "t,x,y\n0,0,0\n1,1,1\n",
    "text": HEADER + "0,0,0,1\n1,zero,0,1\n", "nan": HEADER + "0,0,0,1\n1,nan,0,1\n",
    "short": HEADER + "0,0,0,1\n1,0\n", "backwards": HEADER + "1,0,0,1\n0,0,0,1\n",
    "twice": HEADER + "0,0,0,1\n0,4,0,1\n", "far": HEADER + "0,0,0,1\n1,1e200,0,1\n",
    "off the grid": HEADER + "0,0,0,1\n1,500,0,1\n", "for ever": HEADER + "0,0,0,1\n1e300,0,0,1\n",
    "between samples": HEADER + "0,0,0,1\n1e-9,4,0,1\n", "loud": HEADER + "0,0,0,1e308\n1,0,0,1e308\n",
    "quotes": HEADER + '"0","0","0","1"\n', "bytes": HEADER + "\x00\x00\n",
}  # fmt: skip


def scene_file(folder, csv, keys):
    (folder / "finger.csv").write_text(csv, encoding="utf-8")
    path = 'path = { kind = "trajectory", file = "finger.csv" }'
    (folder / "scene.toml").write_text(f"[[source]]\n{path}\n{keys}\n", encoding="utf-8")
    return folder / "scene.toml"


def test_csv_rows_are_the_trajectory_and_a_hostile_file_is_one_sentence(tmp_path):
    csv = "# a finger\ntime_s,x_mm,y_mm\n0,0,0\n\n0.5,4,-4\n"
    scene = load_scene(scene_file(tmp_path, csv, 'signal = { kind = "impulse" }'))
    assert scene.sources == (Source(TrajectoryPath((0.0, 0.5), ((0.0, 0.0), (4.0, -4.0))), Impulse()),)
    keys = 'repeat = true\namplitude = 9.0\nsignal = { kind = "sine", frequency_hz = 70.0, duration_s = 0.1 }'
    for name, text in HOSTILE.items():
        with pytest.raises(InputError) as refused:
            drive_v(load_scene(scene_file(tmp_path, text, keys)))
        assert "\n" not in str(refused.value), name


PLACES = st.floats(-1e3, 1e3)
KNOTS = st.lists(st.tuples(st.integers(1, 400), PLACES, PLACES, PLACES), min_size=2, max_size=8)


@given(KNOTS)
def test_places_are_linear_between_knots_and_the_same_bits_where_others_are_dropped(knots):
    table = np.array(knots, dtype=np.float64)
    whole = Trajectory(np.cumsum(table[:, 0]).astype(np.int64), table[:, 1:3], table[:, 3])
    first, last = int(whole.sample[0]), int(whole.sample[-1])
    sample = np.arange(first - 5, last + 6)
    at_mm, amplitude = whole.at(sample)
    for found, wanted in ((at_mm[:, 0], whole.at_mm[:, 0]), (amplitude, whole.amplitude)):
        np.testing.assert_allclose(found, np.interp(sample, whole.sample, wanted), rtol=0, atol=1e-9)
        assert (found[whole.sample - first + 5] == wanted).all()
    rest = Trajectory(whole.sample[1:], whole.at_mm[1:], whole.amplitude[1:])
    sample = np.arange(int(rest.sample[0]), last + 1)
    for some, other in zip(whole.at(sample), rest.at(sample), strict=True):
        assert some.tobytes() == other.tobytes()


# --- signals


@given(seed=st.integers(0, 2**63), low=st.floats(0, 2000), width=st.floats(100, 3000), duration_s=st.floats(0.02, 0.3))
def test_noise_has_peak_one_and_nothing_outside_its_band(seed, low, width, duration_s):
    found = Noise((low, low + width), duration_s, seed).samples(10_000.0)
    assert np.abs(found).max() == 1.0
    np.testing.assert_array_equal(found, Noise((low, low + width), duration_s, seed).samples(10_000.0))
    power, frequency = np.abs(np.fft.rfft(found)) ** 2, np.fft.rfftfreq(len(found), 1e-4)
    outside = (frequency < low - 1e-9) | (frequency > low + width + 1e-9)
    assert power[outside].sum() < 1e-24 * power.sum()


@pytest.mark.parametrize("rate_hz", [44_100, 10_000])
def test_a_sound_file_gives_its_first_channel_at_peak_one_and_its_tone_unchanged(tmp_path, rate_hz):
    time = np.arange(rate_hz) / rate_hz
    frames = np.stack([0.25 * np.sin(2 * np.pi * 230 * time), np.ones(rate_hz)], axis=1)
    soundfile.write(tmp_path / "a.wav", frames, rate_hz, subtype="DOUBLE")
    found = SoundFile(tmp_path / "a.wav").samples(10_000.0)
    assert len(found) == pytest.approx(10_000, abs=1)
    assert np.abs(found).max() == pytest.approx(1.0, abs=1e-12)
    if rate_hz == 10_000:
        np.testing.assert_allclose(found, frames[:, 0] / np.abs(frames[:, 0]).max(), atol=1e-12)
    expected, middle = np.sin(2 * np.pi * 230 * np.arange(len(found)) / 10_000), slice(1000, 9000)
    scale = found[middle] @ expected[middle] / (expected[middle] @ expected[middle])
    np.testing.assert_allclose(found[middle] / scale, expected[middle], atol=1e-4)
    if rate_hz == 44_100:  # a tone above the bank's Nyquist frequency does not fold back
        wave = np.sin(2 * np.pi * 7000 * time) + 1e-3 * np.sin(2 * np.pi * 200 * time)
        soundfile.write(tmp_path / "a.wav", wave / 2, rate_hz, subtype="DOUBLE")
        found = SoundFile(tmp_path / "a.wav").samples(10_000.0)[middle]
        power = np.abs(np.fft.rfft(found * np.hanning(len(found)))) ** 2
        assert power.argmax() == pytest.approx(200 * len(found) / 10_000, abs=1)


def test_a_signal_that_cannot_be_emitted_is_refused(tmp_path):
    (tmp_path / "broken.wav").write_bytes(b"no sound")
    soundfile.write(tmp_path / "silent.wav", np.zeros(100), 8000)
    soundfile.write(tmp_path / "empty.wav", np.zeros(0), 8000)
    soundfile.write(tmp_path / "whole.wav", np.ones(100), 8000)
    (tmp_path / "cut.wav").write_bytes((tmp_path / "whole.wav").read_bytes()[:100])
    names = ("missing", "broken", "silent", "empty", r"cut.wav is truncated: it holds 100 of 244 bytes")
    files = ((SoundFile(tmp_path / f"{name.split('.')[0]}.wav"), name) for name in names)
    for signal, message in (
        (Sine(0.0, 1.0), "frequency_hz is 0.0"), (Sine(5000.0, 1.0), "below 5000"),
        (Sine(100.0, 0.0), "duration_s is 0.0"), (Sine(100.0, NAN), "duration_s is nan"),
        (Sine(100.0, 1e-5), "no sample to emit"), (Sine(100.0, 1e-4), "empty or silent"),
        (Sine(100.0, 1e9), "more than"), (Noise((400, 50), 1.0), "band_hz"), (Noise((50, 6000), 1.0), "band_hz"),
        (Noise((50, 60), 0.01), "empty or silent"), (Noise((50, 60), 1.0, -1), "seed is -1"), *files,
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            signal.samples(10_000.0)
