"""Size of a scene, found before anything of that size is made."""

import math
from dataclasses import dataclass

from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.signals import MAX_SAMPLES, signal_size
from wavefocus.rendering.scene.trajectory_path import TrajectoryPath
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
            f"{self.seconds:.4g} s of drives ({self.samples:.4g} samples, {size_words(self.drive_bytes)}),"
            f" {self.path_points:.4g} path points, signals of {self.signal_samples:.4g} samples"
        )


def scene_size(scene: Scene, *, sample_rate_hz: float, taps: int, actuators: int) -> SceneSize:
    """Find how large the drives of a scene become, without making any of them.

    Raises InputError: a sound file cannot be read.
    """
    points, signals, last = 0.0, 0.0, 0.0
    for source in scene.sources:
        count, travel_s = points_and_travel(source)
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
        (size.drive_bytes, MAX_DRIVE_BYTES, f"{size_words(MAX_DRIVE_BYTES)} of drives"),
        (size.path_points, MAX_PATH_POINTS, f"{MAX_PATH_POINTS} path points"),
        (size.signal_samples, MAX_SIGNAL_SAMPLES, f"{MAX_SIGNAL_SAMPLES} samples of signals"),
    )
    for value, limit, words in limits:
        if value > limit:
            raise InputError(f"the scene makes {size}; at most {words} are allowed: split it")
    return size


def size_words(count: float) -> str:
    """A number of bytes for people."""
    for unit, size in (("GiB", 2**30), ("MiB", 2**20)):
        if count >= size:
            return f"{count / size:.4g} {unit}"
    return f"{count / 1024:.4g} KiB"


def points_and_travel(source: Source) -> tuple[float, float]:
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
