"""Sources sampled in time: path points, focus instants, emission (docs/reference/scene-file.md); a scene's size."""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.greens.interpolation.base import (
    Interpolation,
    Nodes,
    OffGridError,
    scene_interpolation,
    show_mm,
)
from wavefocus.rendering.greens.interpolation.path_nodes import STENCIL, PathInterpolation
from wavefocus.rendering.greens.source import GreenSource
from wavefocus.rendering.scene.emission import ContinuousEmission, Emission, PointEmission
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.signals import MAX_SAMPLES, signal_size
from wavefocus.rendering.scene.trajectory import TrajectoryPath
from wavefocus.storage.errors import InputError

MAX_DRIVE_BYTES = 8 * 2**30
MAX_PATH_POINTS = 10**6
MAX_SIGNAL_SAMPLES = 5 * 10**7
"""Limits of a scene: 8 GiB of drives, some hundred MB of memory for points and signals."""


@dataclass(frozen=True, slots=True)
class SceneSize:
    """Size of the drives of a scene and of what makes them; infinite beyond the range of numbers.

    seconds, samples: Length of the drives, lead-in included.
    drive_bytes: Of the drives in float64, all actuators.
    path_points: Of all sources.
    signal_samples: Of all sources; of a sound file as many as it declares, where these are more than at the bank's
        rate.
    """

    seconds: float
    samples: float
    drive_bytes: float
    path_points: float
    signal_samples: float

    def __str__(self) -> str:
        return (
            f"{self.seconds:.4g} s of drives ({self.samples:.4g} samples, {_size_words(self.drive_bytes)}),"
            f" {self.path_points:.4g} path points, signals of {self.signal_samples:.4g} samples"
        )


def scene_size(scene: Scene, *, sample_rate_hz: float, taps: int, actuators: int) -> SceneSize:
    """Find how large the drives of a scene become, without making any of them.

    Raises InputError: a sound file cannot be read.
    """
    points, signals, last = 0.0, 0.0, 0.0
    for source in scene.sources:
        count, travel_s = _points_and_travel(source)
        samples, held = signal_size(source.signal, sample_rate_hz)
        held = (
            max(held, travel_s * sample_rate_hz) if source.repeat or isinstance(source.path, TrajectoryPath) else held
        )
        emitted = samples if source.emission == "per_point" or not travel_s else 0.0
        last = max(last, (source.start_s + travel_s) * sample_rate_hz + emitted)
        points, signals = points + count, signals + held
    samples = last + taps - 1
    return SceneSize(samples / sample_rate_hz, samples, 8.0 * actuators * samples, points, signals)


def check_scene_size(scene: Scene, *, sample_rate_hz: float, taps: int, actuators: int) -> SceneSize:
    """Find the size of a scene. Raises InputError: it is beyond a limit."""
    size = scene_size(scene, sample_rate_hz=sample_rate_hz, taps=taps, actuators=actuators)
    limits = (
        (size.samples, MAX_SAMPLES, f"{MAX_SAMPLES} samples"),
        (size.drive_bytes, MAX_DRIVE_BYTES, f"{_size_words(MAX_DRIVE_BYTES)} of drives"),
        (size.path_points, MAX_PATH_POINTS, f"{MAX_PATH_POINTS} path points"),
        (size.signal_samples, MAX_SIGNAL_SAMPLES, f"{MAX_SIGNAL_SAMPLES} samples of signals"),
    )
    for value, limit, words in limits:
        if value > limit:
            raise InputError(f"the scene makes {size}; at most {words} are allowed: split it")
    return size


def _size_words(count: float) -> str:
    """A number of bytes for people."""
    for unit, size in (("GiB", 2**30), ("MiB", 2**20)):
        if count >= size:
            return f"{count / size:.4g} {unit}"
    return f"{count / 1024:.4g} KiB"


def _points_and_travel(source: Source) -> tuple[float, float]:
    """M and the seconds until n_M, as of `wavefocus.rendering.scene.sampling`; it refuses a source that cannot move."""
    if isinstance(source.path, TrajectoryPath):
        return float(len(source.path.focus_rows)), source.travel_s
    length_mm = source.path.length_mm
    if not (length_mm > 0 and source.step_mm > 0):
        return 1.0, 0.0
    ratio = length_mm / source.step_mm + 1e-9
    points = math.floor(ratio) + 1.0 if math.isfinite(ratio) else math.inf
    if not source.speed_mm_s > 0:
        return points, 0.0
    return points, points * source.step_mm / source.speed_mm_s


Method = Literal["sampled", "exact"]

SAMPLES_AT_ONCE = 2**16


@dataclass(frozen=True, slots=True)
class SampledSource:
    """A source ready to be accumulated.

    points_mm, float64 (points, 2): The path points, at arc lengths m * d; of a trajectory its foci.
    focus_sample, int64 (points,): n_m, counted from scene time zero.
    focus_position, int64 (points,): Bank row nearest to each path point.
    signal, float64 (samples,): The whole signal, amplitude included.
    nodes: Bank rows that make one point.
    """

    index: int
    emission: Emission
    points_mm: Float64Array
    focus_sample: Int64Array
    focus_position: Int64Array
    signal: Float64Array
    nodes: int


def sample_source(
    source: Source, index: int, interpolation: Interpolation, *, sample_rate_hz: float, taps: int, method: Method
) -> SampledSource:
    """Sample one source as docs/reference/scene-file.md says.

    M = floor(length / d + 1e-9) + 1 points at arc length m d are emitted at
    n_m = round((start_s + m d / v) rate), each from absolute time and half to even, so that no error adds up.
    A path of no length is a static focus: it emits its whole signal at `start_s`. A trajectory is at its place of every
    sample, whatever the method.

    Raises InputError: the source does not move although its path does, emits nothing, or leaves the grid.
    """
    try:
        signal = source.amplitude * source.signal.samples(sample_rate_hz)
    except InputError as error:
        raise InputError(f"the signal of source {index}: {error}") from error
    if not len(signal):
        raise InputError(f"the signal of source {index} is empty; it must have at least one sample")
    if isinstance(source.path, TrajectoryPath):
        return _sample_trajectory(source, source.path, index, interpolation, signal, sample_rate_hz)
    points = point_count(source, index)
    moving = points > 1 or (source.path.length_mm > 0 and source.speed_mm_s > 0)
    number = np.arange(points + 1)
    arc_length: Float64Array = number[:-1] * np.float64(source.step_mm) if points > 1 else np.zeros(1)
    instants_s = source.start_s + number * source.step_mm / source.speed_mm_s if moving else np.full(2, source.start_s)
    focus = np.rint(instants_s * sample_rate_hz).astype(np.int64)
    exact = method == "exact" and moving and source.emission == "continuous"
    with _off_grid(lambda _: f"the path of source {index}"):
        follow = interpolation.follow(source.path, None if exact else arc_length)
    points_mm = source.path.point_at(arc_length)
    with _off_grid(lambda point: f"source {index}, path point {point},"):
        nodes = follow(arc_length)

    def of_points(start: int, stop: int) -> Nodes:
        return Nodes(nodes.rows[start:stop], nodes.weights[start:stop], nodes.nearest[start:stop])

    def of_samples(start: int, stop: int) -> Nodes:
        along = np.minimum(source.speed_mm_s * np.arange(start, stop) / sample_rate_hz, source.path.length_mm)
        with _off_grid(lambda point: f"source {index}, sample {start + point} after its start,"):
            found = follow(along)
        return found

    emission: Emission
    if source.emission == "per_point" and moving:
        emission = PointEmission(signal, focus[:-1], of_points, max(2048, taps))
    else:
        last = int(focus[-1]) if moving else int(focus[0]) + len(signal)
        if last <= focus[0]:
            raise InputError(
                f"source {index} moves on within one sample of its start and emits nothing; lower speed_mm_s"
                f" ({source.speed_mm_s:g}) or lengthen the path"
            )
        if source.repeat:
            signal = np.resize(signal, last - int(focus[0]))
        emission = (
            ContinuousEmission(signal, int(focus[0]), last, of_samples)
            if exact
            else ContinuousEmission(signal, int(focus[0]), last, of_points, focus[:-1])
        )
    return SampledSource(index, emission, points_mm, focus[:-1], nodes.nearest, signal, nodes.rows.shape[1])


def _sample_trajectory(
    source: Source,
    path: TrajectoryPath,
    index: int,
    interpolation: Interpolation,
    signal: Float64Array,
    sample_rate_hz: float,
) -> SampledSource:
    course, on_strokes = (
        path.trajectory(source.start_s, sample_rate_hz, of_strokes=of_strokes) for of_strokes in (False, True)
    )
    first, stop = int(course.sample[0]), int(course.sample[-1])
    if first == stop:
        raise InputError(f"the trajectory of source {index} ends within one sample of its start and emits nothing")
    signal = np.resize(signal, stop - first) if source.repeat else signal[: stop - first].copy()
    for begin in range(0, len(signal), SAMPLES_AT_ONCE):
        part = signal[begin : begin + SAMPLES_AT_ONCE]
        with np.errstate(over="ignore", invalid="ignore"):  # drives that are not finite are refused
            part *= course.at(first + np.arange(begin, begin + len(part)))[1]
    with _off_grid(lambda _: f"the path of source {index}"):
        follow = None
        if isinstance(interpolation, PathInterpolation):
            follow = _follow_strokes(path, interpolation, source.start_s, sample_rate_hz)

    def nodes_at(sample: Int64Array) -> Nodes:
        if follow is not None:
            return follow(sample)
        # Ties between positions fall as while it sounded only at the same places to the bit. On the way of a jump there
        # need be no grid.
        return interpolation.nodes(on_strokes.at(path.on_stroke(sample, source.start_s, sample_rate_hz)[1])[0])

    def of_samples(start: int, stop: int) -> Nodes:
        sample = first + np.arange(start, stop)
        at_s = sample / sample_rate_hz - source.start_s
        with _off_grid(lambda point: f"source {index}, {at_s[point]:.6g} s after its start,"):
            found = nodes_at(sample)
        return found

    focus_s, points_mm = path.foci(source.start_s)
    focus = np.rint(focus_s * sample_rate_hz).astype(np.int64)
    with _off_grid(lambda point: f"row {path.focus_rows[point]} of the trajectory of source {index}"):
        nodes = nodes_at(focus)
    emission = ContinuousEmission(signal, first, stop, of_samples)
    return SampledSource(index, emission, points_mm, focus, nodes.nearest, signal, nodes.rows.shape[1])


def _follow_strokes(
    path: TrajectoryPath, interpolation: PathInterpolation, start_s: float, sample_rate_hz: float
) -> Callable[[Int64Array], Nodes]:
    """Nodes at samples, along each stroke by itself: at a joint, arc length does not tell one from the next."""
    strokes = path.strokes()
    follows = {one: interpolation.follow(stroke) for one, (_, _, stroke) in enumerate(strokes) if stroke.length_mm > 0}
    rests = interpolation.nodes(np.array([stroke.strokes_mm[0][0] for _, _, stroke in strokes]))
    begin_mm = path.arc_length_mm(np.asarray(path.time_s)[[first for first, _, _ in strokes]])

    def nodes_at(sample: Int64Array) -> Nodes:
        number = path.on_stroke(sample, start_s, sample_rate_hz)[0]
        own_mm = path.arc_length_mm(sample / sample_rate_hz - start_s) - begin_mm[number]
        rows, weights = np.repeat(rests.rows[number], STENCIL, axis=1), np.tile(np.eye(1, STENCIL), (len(sample), 1))
        nearest = rests.nearest[number]
        for one in sorted(follows.keys() & set(number.tolist())):
            chosen = np.flatnonzero(number == one)
            try:
                found = follows[one](np.clip(own_mm[chosen], 0.0, strokes[one][2].length_mm))
            except OffGridError as error:
                raise OffGridError(int(chosen[error.point]), str(error)) from error
            rows[chosen], weights[chosen], nearest[chosen] = found.rows, found.weights, found.nearest
        return Nodes(rows, weights, nearest)

    return nodes_at


def point_count(source: Source, index: int) -> int:
    """M, the number of path points of a source, 1 where it stands still; of a trajectory the number of its foci.

    Raises InputError: the source does not move although its path does, or it has too many path points.
    """
    points, _ = _points_and_travel(source)
    if isinstance(source.path, TrajectoryPath) or source.path.length_mm == 0:
        return int(points)
    if source.step_mm <= 0:
        raise InputError(f"step_mm of source {index} is {source.step_mm:g}; on a path it must be above 0")
    if points > MAX_PATH_POINTS:
        raise InputError(
            f"step_mm of source {index} is {source.step_mm:g}, which makes {points:.3g} path points; at most"
            f" {MAX_PATH_POINTS} are allowed"
        )
    if points > 1 and source.speed_mm_s <= 0:
        raise InputError(f"speed_mm_s of source {index} is {source.speed_mm_s:g}; on a path it must be above 0")
    return int(points)


@contextmanager
def _off_grid(name: Callable[[int], str]) -> Iterator[None]:
    """Refuse what lies off the grid; `name` is called with the number of the first such place, for the InputError."""
    try:
        yield
    except OffGridError as error:
        raise InputError(f"{name(error.point)} {error}") from error


@dataclass(frozen=True, slots=True)
class SampledScene:
    """The sources of a scene over a bank: `samples` of drives from `start_s` on, which is the lead-in before 0."""

    interpolation: Interpolation
    sources: list[SampledSource]
    method: Method
    samples: int
    start_s: float

    @property
    def foci(self) -> tuple[Int64Array, Int64Array, Int64Array]:
        """Sample, bank row and source of each focus, source by source."""
        return (
            np.concatenate([source.focus_sample for source in self.sources]),
            np.concatenate([source.focus_position for source in self.sources]),
            np.concatenate(
                [np.full(len(source.focus_sample), source.index, dtype=np.int64) for source in self.sources]
            ),
        )

    @property
    def focus_mm(self) -> Float64Array:
        """Path points that were asked for, (K, 2), also where the drive is that of the nearest position."""
        return np.concatenate([source.points_mm for source in self.sources])

    def naming(self, row: int, at_mm: Float64Array) -> str:
        """Say which path point needs a row at `at_mm`: the first that is snapped to it, else the closest."""
        _, position, of_source = self.foci
        snapped, apart_mm = np.flatnonzero(position == row), np.hypot(*(self.focus_mm - at_mm).T)
        focus = int(snapped[0]) if len(snapped) else int(np.argmin(apart_mm))
        source, point = int(of_source[focus]), focus - int(np.searchsorted(of_source, of_source[focus]))
        near = "" if len(snapped) else "the path near "
        return f"{near}path point {point} of source {source} at {show_mm(self.focus_mm[focus])} mm"


def sample_scene(scene: Scene, bank: GreenSource, method: Method | None = None) -> SampledScene:
    """Sample the sources of a scene, once its size is found to be within the limits.

    method: "sampled", eq. (16), or "exact", eq. (9); by default sampled where all emission is per point, for which the
        two are the same, else exact.

    Raises InputError: the scene is larger than allowed, or does not fit the bank, or there is no such method.
    """
    if method not in (None, "sampled", "exact"):
        raise InputError(f"method is {method!r}; allowed are 'sampled' and 'exact'")
    if method is None:
        method = "sampled" if all(source.emission == "per_point" for source in scene.sources) else "exact"
    rate_hz, taps = float(bank.sample_rate_hz), bank.taps
    for index, source in enumerate(scene.sources):
        point_count(source, index)
    check_scene_size(scene, sample_rate_hz=rate_hz, taps=taps, actuators=bank.actuators)
    interpolation = scene_interpolation(scene, bank)
    sources = [
        sample_source(source, index, interpolation, sample_rate_hz=rate_hz, taps=taps, method=method)
        for index, source in enumerate(scene.sources)
    ]
    samples = max(source.emission.stop_sample for source in sources) + taps - 1
    return SampledScene(interpolation, sources, method, samples, -(taps - 1) / rate_hz)
