"""Compare drives, fields, estimates and banks that two versions of the suite make from the same inputs.

OLD/.venv/bin/python tools/compare_versions.py write before/                  # in the old version
.venv/bin/python tools/compare_versions.py write after/ --recordings before/  # in this one, from the same recordings
.venv/bin/python tools/compare_versions.py compare before/ after/             # exit 1: beyond 1e-12, or bytes differ

Only public names, commands and file formats are used, so that both versions run the same file.
"""

from __future__ import annotations

import argparse
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import wavefocus as wf

RATE_HZ, TAPS, ACTUATORS = 10_000.0, 600, 8
LARGEST_DIFFERENCE = 1e-12

RUN = """
rig = "virtual"
grid = { spacing_mm = 30, margin_mm = 20 }
sweep = { start_hz = 40, stop_hz = 400, duration_s = 0.2, amplitude_v = 1.0 }
capture = { averages = 2, decay_s = 0.1, taps = 500, sample_rate_hz = 5000, keep_raw = true, excitation = "EXCITATION" }
virtual = { seed = 3 }
"""

NOISE = 'signal = { kind = "noise", band_hz = [50, 400], duration_s = 0.9, seed = 3 }'
MOVING = f"""
[[source]]
start_s = 0.01
speed_mm_s = 100.0
step_mm = 3.0
amplitude = 2.0
path = {{ kind = "circle", centre_mm = [0, 0], radius_mm = 15.0, turns = 1.3, start_deg = 20 }}
{NOISE}
"""
REPEATING = """
[[source]]
start_s = 0.2
speed_mm_s = 100.0
step_mm = 3.0
amplitude = 1.5
path = { kind = "line", start_mm = [-20, -11], end_mm = [20, 10] }
signal = { kind = "noise", band_hz = [50, 400], duration_s = 0.08, seed = 4 }
emission = "per_point"
"""
STANDING = """
[[source]]
start_s = 0.3
path = { kind = "point", at_mm = [3, 3] }
signal = { kind = "sine", frequency_hz = 70, duration_s = 0.3 }
[[source]]
start_s = 0.1
path = { kind = "point", at_mm = [-7, 5] }
signal = { kind = "impulse" }
"""
SCENES = {
    "moving": MOVING,
    "per point": REPEATING,
    "all": MOVING + REPEATING + STANDING,
    "saturated": MOVING + REPEATING + "[regularisation]\nsaturation = 0.8",
    "limited": MOVING + STANDING + "[output]\nlimit_v = 1e-3",
    "bilinear": MOVING + REPEATING + '[regularisation]\nsaturation_absolute = 0.05\n[output]\ninterpolation="bilinear"',
    "kernel": MOVING + '[output]\ninterpolation = "kernel"',
    "waves": MOVING + '[output]\ninterpolation = "waves"',
    "quiet": STANDING + "[[quiet]]\nat_mm = [20.0, -16.0]\nlevel_db = -20.0",
    "plain sum": MOVING + "[regularisation]\nnormalise = false",
}


def bank_of(scale: float = 1.0) -> wf.GreenArray:
    """Bank of damped waves from actuators on a rim, smooth from position to position."""
    position_mm = np.array([(4.0 * x - 24.0, 4.0 * y - 24.0) for y in range(13) for x in range(13)])
    angle = 2 * np.pi * np.arange(ACTUATORS) / ACTUATORS
    actuator_mm = 60.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    distance_mm = np.hypot(*(position_mm[:, None] - actuator_mm).transpose(2, 0, 1))
    time_s = np.arange(TAPS) / RATE_HZ - 0.008 - distance_mm[..., None] / 8000.0
    values = np.cos(2 * np.pi * 240 * time_s) * np.exp(-((time_s / 0.0025) ** 2)) / np.sqrt(distance_mm)[..., None]
    values += 1e-4 * np.random.default_rng(1).standard_normal(values.shape)
    return wf.GreenArray(
        (scale * values).astype(np.float64), position_mm, RATE_HZ, actuator_mm=actuator_mm, band_hz=(50.0, 450.0)
    )


def write(folder: Path, recordings: Path | None) -> None:
    """Write this version's arrays and banks; estimates are made from the recordings in another folder, if given."""
    folder.mkdir(parents=True)
    _write_arrays(folder)
    for excitation in ("sequential", "staggered"):
        raw = folder / f"{excitation}.raw.h5"
        if recordings is None:
            run_file = folder / f"{excitation}.toml"
            run_file.write_text(RUN.replace("EXCITATION", excitation), encoding="utf-8")
            _wavefocus("capture", run_file, "--bank", folder / f"{excitation}.h5")
        else:
            shutil.copyfile(recordings / raw.name, raw)
        _wavefocus("estimate", raw, "--bank", folder / f"estimate-{excitation}.h5")


def _write_arrays(folder: Path) -> None:
    bank = bank_of()
    drives = {}
    for name, scene in SCENES.items():
        file = folder / f"{name}.toml"
        file.write_text(scene, encoding="utf-8")
        for method in ("sampled", "exact"):
            try:
                drives[f"{name}, {method}"] = wf.render(file, bank, method=method)  # type: ignore[arg-type]
            except wf.InputError as refused:  # a key that the older version does not have
                print(refused)
    for scale in (1e-12, 1e12):
        drives[f"in another unit {scale:g}"] = wf.render(folder / "saturated.toml", bank_of(scale))
    drives["to -60 dB"] = wf.render(folder / "moving.toml", bank, tolerance_db=-60.0)
    arrays = {f"drive {name}": drive.drive_v for name, drive in drives.items()}
    arrays |= {f"scale {name}": np.array([drive.scale]) for name, drive in drives.items()}
    drive = drives["all, exact"]
    arrays["field"] = wf.predict(drive, bank).field
    arrays["field of 3 positions"] = wf.predict(drive, bank, [5, 168, 84]).field
    arrays["field, float32"] = wf.predict(drive, bank, dtype=np.float32).field
    arrays["field at 1250 Hz"] = wf.predict(drive, bank, rate_hz=1250.0).field
    np.savez(folder / "arrays.npz", **arrays)  # type: ignore[arg-type]


def _wavefocus(*words: str | Path) -> None:
    subprocess.run([sys.executable, "-m", "wavefocus", *map(str, words)], check=True, stderr=subprocess.DEVNULL)


def compare(before: Path, after: Path) -> bool:
    """Print how far each array and bank of two folders differs; whether none differs more than it may."""
    same = True
    with np.load(before / "arrays.npz") as old, np.load(after / "arrays.npz") as new:
        for name in old:
            difference = _difference(old[name], new[name])
            # What a tolerance leaves out is the renderer's own choice.
            same &= difference <= (1e-3 if name == "drive to -60 dB" else LARGEST_DIFFERENCE)
            print(f"{name:40s} {difference:.1e}")
    for file in sorted(before.glob("*.h5")):
        if not file.name.endswith(".raw.h5") and (after / file.name).exists():
            difference = _difference(_rows(file), _rows(after / file.name))
            equal = file.read_bytes() == (after / file.name).read_bytes()
            same &= difference <= LARGEST_DIFFERENCE and equal
            print(f"bank {file.name:35s} {difference:.1e} {'equal bytes' if equal else 'bytes differ'}")
    return same


def _rows(file: Path) -> NDArray[np.float64]:
    with wf.open_bank(file) as bank:
        return np.stack([bank.green(position) for position in range(bank.positions)])


def _difference(old: NDArray[np.float64], new: NDArray[np.float64]) -> float:
    """Relative L2 difference; infinite between arrays of two shapes."""
    if old.shape != new.shape:
        return np.inf
    size = max(float(np.abs(old).max()), 1e-300)
    return float(np.linalg.norm((new - old) / size) / np.linalg.norm(old / size))


def main() -> int:
    """Write or compare, as the command line says."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=("write", "compare"))
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--recordings", type=Path)
    given = parser.parse_args()
    if given.action == "write":
        write(given.folders[0], given.recordings)
        return 0
    return int(not compare(*given.folders))


if __name__ == "__main__":
    sys.exit(main())
