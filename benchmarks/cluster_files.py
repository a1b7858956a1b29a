"""Files of the cluster's benchmark: a bank of 10,000 positions as any program may write it, a drive, recordings."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from benchmarks.raw_night import record_sample
from storage.drive_file import Drive, write_drive

RATE_HZ = 10_000.0
DECAY_S = 0.02
DIFFERENT = 64
"""Rows that are drawn; the others repeat them."""


def write_bank(path: Path, positions: int, actuators: int, taps: int) -> None:
    """Write `/green`, `/position_mm` and `sample_rate_hz`, and nothing more."""
    random = np.random.default_rng(5)
    decay = np.exp(-np.arange(taps) / (DECAY_S * RATE_HZ)).astype(np.float32)
    rows = random.standard_normal((min(DIFFERENT, positions), actuators, taps), dtype=np.float32) * decay
    side = int(np.ceil(np.sqrt(positions)))
    at = np.arange(positions)
    with h5py.File(path, "w") as file:
        green = file.create_dataset("green", (positions, actuators, taps), np.float32, chunks=(1, actuators, taps))
        for first in range(0, positions, len(rows)):
            count = min(len(rows), positions - first)
            green[first : first + count] = rows[:count]
        file["position_mm"] = 4.0 * np.column_stack([at % side, at // side])
        file.attrs["sample_rate_hz"] = RATE_HZ


def write_noise(path: Path, actuators: int, samples: int) -> None:
    """Write a drive of white noise."""
    none = np.zeros(0, np.int64)
    drive_v = np.random.default_rng(6).standard_normal((actuators, samples))
    write_drive(path, Drive(drive_v, RATE_HZ, 0.0, "sampled", 1.0, 0.0, none, none, none))


def write_recordings(path: Path, positions: int) -> None:
    """Write recordings of the virtual rig, three sweeps of 1 s per actuator and position."""
    record_sample(path, positions, staggered=False)
