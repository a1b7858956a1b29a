"""Drives and fields of two versions of the renderer on the same synthetic banks: save with one, compare with the other.

python -m tools.compare_houses save reference.npz      # in the old version
python -m tools.compare_houses compare reference.npz   # in the new one: relative L2 differences
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.drive.streamed import StreamedDrive
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Circle, Line, Point
from wavefocus.rendering.scene.signals import Impulse, Noise, Sine

RATE_HZ, TAPS, ACTUATORS = 10_000.0, 600, 8


def bank_of(scale: float = 1.0) -> GreenArray:
    """Bank of damped waves from actuators on a rim, smooth from position to position."""
    position_mm = np.array([(4.0 * x - 24.0, 4.0 * y - 24.0) for y in range(13) for x in range(13)])
    angle = 2 * np.pi * np.arange(ACTUATORS) / ACTUATORS
    actuator_mm = 60.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    distance_mm = np.hypot(*(position_mm[:, None] - actuator_mm).transpose(2, 0, 1))
    time_s = np.arange(TAPS) / RATE_HZ - 0.008 - distance_mm[..., None] / 8000.0
    values = np.cos(2 * np.pi * 240 * time_s) * np.exp(-((time_s / 0.0025) ** 2)) / np.sqrt(distance_mm)[..., None]
    values += 1e-4 * np.random.default_rng(1).standard_normal(values.shape)
    return GreenArray(
        (scale * values).astype(np.float64), position_mm, RATE_HZ, actuator_mm=actuator_mm, band_hz=(50.0, 450.0)
    )


MOVING = Source(Circle((0, 0), 15.0, 1.3, 20.0), Noise((50, 400), 0.9, 3), 0.01, 100.0, 3.0, 2.0)
REPEATING = Source(Line((-20, -11), (20, 10)), Noise((50, 400), 0.08, 4), 0.2, 100.0, 3.0, 1.5, "per_point")
STANDING = Source(Point((3, 3)), Sine(70, 0.3), 0.3)
CLICK = Source(Point((-7, 5)), Impulse(), 0.1)
SCENES = {
    "moving": Scene("s", (MOVING,)),
    "per point": Scene("s", (REPEATING,)),
    "all": Scene("s", (MOVING, REPEATING, STANDING, CLICK)),
    "saturated": Scene("s", (MOVING, REPEATING), Regularisation(saturation=0.8)),
    "limited": Scene("s", (MOVING, STANDING), output=Output(limit_v=1e-3)),
    "bilinear": Scene(
        "s", (MOVING, REPEATING), Regularisation(saturation_absolute=0.05), Output(interpolation="bilinear")
    ),
    "kernel": Scene("s", (MOVING,), output=Output(interpolation="kernel")),
    "plain sum": Scene("s", (MOVING,), Regularisation(normalise=False)),
}


def results() -> dict[str, NDArray[np.float64]]:
    """Every drive and field by name."""
    found: dict[str, NDArray[np.float64]] = {}
    bank = bank_of()
    for name, scene in SCENES.items():
        for method in ("sampled", "exact"):
            drive, _ = render_with_report(scene, bank, method=method)  # type: ignore[arg-type]
            found[f"drive {name}, {method}"] = drive.drive_v
            found[f"scale {name}, {method}"] = np.array([drive.scale])
    for scale in (1e-200, 1e200):
        found[f"drive in another unit {scale:g}"] = render_with_report(SCENES["saturated"], bank_of(scale))[0].drive_v
    streamed = StreamedDrive(SCENES["limited"], bank)
    streamed.prepare()
    found["drive streamed"] = np.concatenate(list(streamed.blocks()), axis=1)
    loose, _ = render_with_report(SCENES["moving"], bank, tolerance_db=-60.0)
    found["drive to -60 dB"] = loose.drive_v
    drive, _ = render_with_report(SCENES["all"], bank)
    found["field"] = predict(drive, bank).field
    found["field of 3 positions"] = predict(drive, bank, [5, 168, 84]).field
    found["field, float32"] = predict(drive, bank, dtype=np.float32).field
    found["field at 1250 Hz"] = predict(drive, bank, rate_hz=1250.0).field
    return found


def main() -> None:
    """Save or compare, as the first argument says."""
    what, file = sys.argv[1], Path(sys.argv[2])
    found = results()
    if what == "save":
        np.savez(file, **{name.replace("/", " "): value for name, value in found.items()})
        return
    with np.load(file) as known:
        for name, value in found.items():
            before = known[name]
            size = max(float(np.abs(before).max()), 1e-300)
            if before.shape != value.shape:
                print(f"{name:40s} {before.shape} before, {value.shape} now")
                continue
            difference = np.linalg.norm((value - before) / size) / np.linalg.norm(before / size)
            print(f"{name:40s} {difference:.2e}")


if __name__ == "__main__":
    main()
