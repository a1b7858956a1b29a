"""Scenes with trajectories: eq. (9) at the place of every sample, and each module that reads paths."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.unit.plate_banks import NOISE_MM as GRID_MM
from tests.unit.plate_banks import plate_bank
from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.rendering import SceneRenderer, render_with_report
from wavefocus.rendering.greens.interpolation.base import interpolation_method
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source, load_scene
from wavefocus.rendering.scene.paths import Circle, Line, Point
from wavefocus.rendering.scene.sampling import sample_scene, scene_size
from wavefocus.rendering.scene.scene_rows import scene_rows
from wavefocus.rendering.scene.signals import Impulse, Noise, Sine
from wavefocus.rendering.scene.trajectory import Trajectory, TrajectoryPath
from wavefocus.storage.errors import InputError

RATE_HZ = 1000.0
#: Off the samples, resting for a while, and along y = 2 mm, where two rows of positions are equally near.
TIME_S = (0.0104, 0.05, 0.1, 0.1022, 0.2, 0.31)
PLACES_MM = ((-14.0, -10.0), (0.0, 3.3), (6.0, 2.0), (6.0, 2.0), (15.0, 2.0), (3.1, -9.0))
AMPLITUDE = (0.0, 1.0, 2.0, 2.0, -1.0, 0.5)
NOISE = Noise((50.0, 400.0), 0.07, 3)
GREEN = np.random.default_rng(0).standard_normal((len(GRID_MM), 3, 60))


def bank(rows=slice(None)):
    """Some rows of a bank; all are doubtful: to judge what lies between them takes longer than a render."""
    status = np.zeros(len(GRID_MM), np.uint8)
    status[rows] = 4
    return GreenArray(GREEN, GRID_MM, RATE_HZ, status=status)


def scene_of(*sources, interpolation="nearest"):
    return Scene("t", sources, Regularisation(normalise=False), Output(interpolation=interpolation))


MOVING = Source(TrajectoryPath(TIME_S, PLACES_MM, AMPLITUDE), NOISE, 0.02, amplitude=3.0, repeat=True)


@pytest.mark.parametrize("interpolation", ["nearest", "bilinear"])
@pytest.mark.parametrize("repeat", [True, False])
def test_given_a_trajectory_then_its_drive_is_equation_9_summed_directly(interpolation, repeat):
    source = Source(MOVING.path, NOISE, 0.02, amplitude=3.0, repeat=repeat)
    drive, _ = render_with_report(scene_of(source, interpolation=interpolation), bank())
    knots = np.rint((0.02 + np.array(TIME_S)) * RATE_HZ)
    sample = np.arange(int(knots[0]), int(knots[-1]))
    signal, taps = NOISE.samples(RATE_HZ), GREEN.shape[2]
    emitted = np.append(signal, [] if repeat else np.zeros(len(sample)))
    emitted = np.resize(emitted, len(sample)) * 3.0 * np.interp(sample, knots, AMPLITUDE)
    places_mm = np.stack([np.interp(sample, knots, axis_mm) for axis_mm in np.transpose(PLACES_MM)], axis=1)
    nodes = interpolation_method(interpolation).over(bank(), places_mm).nodes(places_mm)
    meant = np.zeros((3, sample[-1] + taps))
    for s, value, rows, weights in zip(sample, emitted, nodes.rows, nodes.weights, strict=True):
        meant[:, s : s + taps] += value * np.tensordot(weights, GREEN[rows], 1)[:, ::-1]
    np.testing.assert_allclose(drive.drive_v, meant, rtol=0, atol=1e-12 * np.abs(meant).max())
    assert drive.focus_sample.tolist() == [70, 120, 220]
    assert GRID_MM[drive.focus_position].tolist() == [[0.0, 4.0], [4.0, 0.0], [16.0, 0.0]]


def test_given_a_trajectory_then_all_that_looks_at_paths_takes_it():
    scene = scene_of(MOVING, Source(Point((0.0, 0.0)), Sine(70.0, 0.1)))
    whole, _ = render_with_report(scene, bank())
    sampled, _ = render_with_report(scene, bank(), method="sampled")
    blocks = list(SceneRenderer(scene, bank()).unlimited_blocks())
    size = scene_size(scene, sample_rate_hz=RATE_HZ, taps=60, actuators=3)
    assert size.samples == pytest.approx(whole.drive_v.shape[1], abs=1)
    assert size.path_points == len(whole.focus_sample)
    for other in (sampled.drive_v, np.concatenate(blocks, axis=1)):
        np.testing.assert_allclose(other, whole.drive_v, rtol=0, atol=1e-12 * np.abs(whole.drive_v).max())
    needed = scene_rows(scene, GRID_MM)
    assert len(needed.path) < len(GRID_MM) / 2
    np.testing.assert_array_equal(render_with_report(scene, bank(needed.all))[0].drive_v, whole.drive_v)


def test_kernel_interpolation_then_a_trajectory_round_a_circle_is_nearly_that_circle():
    circle = Source(Circle((1.3, -0.7), 13.0, 0.4), Noise((80.0, 420.0), 0.1, 3), 0.0, 180.0, 3.0)
    along_mm = np.arange(0.0, circle.path.length_mm, 0.9)
    course = TrajectoryPath(along_mm / 180.0, circle.path.point_at(along_mm))
    drives = [
        render_with_report(scene_of(one, interpolation="kernel"), plate_bank(noise_db=-60.0))[0].drive_v[:, :560]
        for one in (circle, Source(course, circle.signal))
    ]
    np.testing.assert_allclose(drives[1], drives[0], rtol=0, atol=0.02 * np.abs(drives[0]).max())


def test_given_a_line_and_repeat_then_the_signal_begins_anew_until_its_end():
    source = Source(Line((-10.0, 0.0), (10.0, 0.0)), Noise((50.0, 400.0), 0.07, 3), 0.0, 100.0, 4.0, repeat=True)
    (sampled,) = sample_scene(scene_of(source), bank()).sources
    assert sampled.signal.tolist() == np.resize(source.signal.samples(RATE_HZ), 240).tolist()
    held = scene_size(scene_of(source), sample_rate_hz=RATE_HZ, taps=60, actuators=3).signal_samples
    assert held == pytest.approx(240)


def test_rows_close_in_time_or_silent_then_they_are_no_foci_and_silence_is_no_way():
    time_s = np.arange(9) * 0.004
    places_mm = [(4.0 * (row // 4), 0.0) for row in range(9)]
    path = TrajectoryPath(time_s, places_mm, (1, 1, 1, 0, 0, 1, 1, 1, 1))
    assert path.focus_rows.tolist() == [0, 5]
    assert path.length_mm == 4.0
    assert path.point_at([0.0, 3.0]).tolist() == [[4.0, 0.0], [7.0, 0.0]]


def test_given_a_resting_finger_then_it_is_a_point_source():
    resting = Source(TrajectoryPath((0.0, 0.07), ((4.0, 4.0), (4.0, 4.0))), NOISE)
    point = Source(Point((4.0, 4.0)), NOISE)
    there, at_rest = (render_with_report(scene_of(one), bank())[0].drive_v for one in (point, resting))
    np.testing.assert_allclose(at_rest, there, rtol=0, atol=1e-13 * np.abs(there).max())


@pytest.mark.parametrize(
    "make",
    [
        lambda: Source(MOVING.path, NOISE, emission="per_point"),
        lambda: Source(Point((0.0, 0.0)), NOISE, repeat=True),
        lambda: Source(Line((0, 0), (9, 0)), NOISE, 0.0, 80.0, 4.0, emission="per_point", repeat=True),
        lambda: TrajectoryPath((0.0,), ((0.0, 0.0),)),
        lambda: TrajectoryPath((0.0, 1.0), ((0.0, 0.0), (1.0, 0.0), (2.0, 0.0))),
        lambda: TrajectoryPath((0.0, 0.0), ((0.0, 0.0), (1.0, 0.0))),
        lambda: TrajectoryPath((-0.1, 0.0), ((0.0, 0.0), (1.0, 0.0))),
        lambda: TrajectoryPath((0.0, 1.0), ((0.0, 0.0), (1.0, np.nan))),
        lambda: TrajectoryPath((0.0, 1.0), ((0.0, 0.0), (1.0, 0.0)), (1.0, np.inf)),
    ],
)
def test_given_a_trajectory_or_a_repeat_out_of_range_then_it_is_refused(make):
    with pytest.raises(InputError):
        make()


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


@pytest.mark.parametrize("name", HOSTILE)
def test_given_a_hostile_csv_file_then_one_sentence_refuses_it(name, tmp_path):
    (tmp_path / "finger.csv").write_text(HOSTILE[name], encoding="utf-8")
    (tmp_path / "scene.toml").write_text(
        '[[source]]\nrepeat = true\npath = { kind = "trajectory", file = "finger.csv" }\n'
        'amplitude = 9.0\nsignal = { kind = "sine", frequency_hz = 70.0, duration_s = 0.1 }\n',
        encoding="utf-8",
    )
    with pytest.raises(InputError) as refused:
        render_with_report(load_scene(tmp_path / "scene.toml"), bank())
    assert "\n" not in str(refused.value)


def test_given_a_csv_file_then_its_rows_are_the_trajectory(tmp_path):
    (tmp_path / "finger.csv").write_text("# a finger\ntime_s,x_mm,y_mm\n0,0,0\n\n0.5,4,-4\n", encoding="utf-8")
    (tmp_path / "scene.toml").write_text(
        '[[source]]\npath = { kind = "trajectory", file = "finger.csv" }\nsignal = { kind = "impulse" }\n',
        encoding="utf-8",
    )
    assert load_scene(tmp_path / "scene.toml").sources == (
        Source(TrajectoryPath((0.0, 0.5), ((0.0, 0.0), (4.0, -4.0))), Impulse()),
    )


PLACES = st.floats(-1e3, 1e3)
KNOTS = st.lists(st.tuples(st.integers(1, 400), PLACES, PLACES, PLACES), min_size=2, max_size=8)


def through(knots):
    """Knots whose first number is the time since the one before."""
    table = np.array(knots, dtype=np.float64)
    return Trajectory(np.cumsum(table[:, 0]).astype(np.int64), table[:, 1:3], table[:, 3])


@given(KNOTS)
def test_given_knots_then_places_are_linear_between_them_and_exact_at_them(knots):
    trajectory = through(knots)
    first, last = int(trajectory.sample[0]), int(trajectory.sample[-1])
    sample = np.arange(first - 5, last + 6)
    at_mm, amplitude = trajectory.at(sample)
    for found, wanted in ((at_mm[:, 0], trajectory.at_mm[:, 0]), (amplitude, trajectory.amplitude)):
        np.testing.assert_allclose(found, np.interp(sample, trajectory.sample, wanted), rtol=0, atol=1e-9)
        assert (found[trajectory.sample - first + 5] == wanted).all()


@given(KNOTS)
def test_knots_that_are_dropped_or_added_then_places_between_others_are_same_bits(knots):
    whole = through(knots)
    rest = Trajectory(whole.sample[1:], whole.at_mm[1:], whole.amplitude[1:])
    sample = np.arange(int(rest.sample[0]), int(rest.sample[-1]) + 1)
    for some, other in zip(whole.at(sample), rest.at(sample), strict=True):
        assert some.tobytes() == other.tobytes()
