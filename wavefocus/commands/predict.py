"""``wavefocus predict``: the field that a drive makes, from the bank."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from calibration.bank import open_bank
from calibration.drive_file import read_drive
from calibration.field_file import FieldWriter
from rendering.field import chosen_positions, field_samples, field_unit, predict_rows
from wavefocus.console import progress, say
from wavefocus.positions import parse_positions


def predict(drive_file: Path, bank: Path, out: Path, positions: str, *, as_json: bool) -> None:
    """Predict the field at the positions asked for and write it row by row.

    Computed in float64 and rounded once, to the float32 of the file.
    """
    drive = read_drive(drive_file)
    with open_bank(bank) as view:
        wanted = parse_positions(positions, view.positions) if positions else None
        index = chosen_positions(drive, view, wanted)
        samples, unit, peak = field_samples(drive, view), field_unit(view), 0.0
        with (
            FieldWriter(
                out,
                index,
                samples,
                sample_rate_hz=drive.sample_rate_hz,
                start_s=drive.start_s,
                response_unit=unit,
            ) as writer,
            progress("predict", len(index)) as report,
        ):
            for rows in predict_rows(drive, view, wanted, dtype=np.float64, on_progress=report):
                writer.write(rows.first, rows.field)
                peak = max(peak, float(np.abs(rows.field).max(initial=0.0)))
        if left_out := view.positions - len(index) if wanted is None else 0:
            say(f"{left_out} positions are not measured and are left out")
    say(f"{out}: {len(index)} positions, {samples} samples, largest response {peak:.4g} {unit}")
    if as_json:
        print(json.dumps({"field": str(out), "positions": len(index), "samples": samples, "peak": peak}))
