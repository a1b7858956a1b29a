"""``wavefocus predict``: the field that a drive makes, from the bank."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.console import Report, progress, say
from wavefocus.input_files import name_unverified, parse_positions
from wavefocus.rendering.device import cuda_device
from wavefocus.rendering.field.prediction import Prediction, chosen_positions, field_unit, share_above
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.drive_file import read_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import field_in_rows
from wavefocus.storage.output_files import require_outputs
from wavefocus.storage.units import quantity

if TYPE_CHECKING:
    from wavefocus.rendering.field.quiet_levels import QuietLevel


def predict(
    drive_file: Path,
    bank: Path,
    out: Path,
    positions: str,
    *,
    rate_hz: float | None = None,
    cluster: str = "",
    device: str = "cpu",
    force: bool = False,
    as_json: bool,
) -> None:
    """Predict the field at the positions asked for and write it row by row, here or on a cluster.

    Computed in float64 and rounded once, to the float32 of the file; in complex64 at a lower rate.
    """
    if device != "cpu" and (cluster or rate_hz is not None):
        raise InputError(f"--device {device} goes neither with --cluster nor with --rate")
    dtype = np.float64 if rate_hz is None else np.float32
    require_outputs((out,), (drive_file, bank), force=force)
    drive = read_drive(drive_file)
    name_unverified(drive_file, verified=drive.verified)
    with open_bank(bank) as view:
        wanted = parse_positions(positions, view.positions) if positions else None
        view.require_sound(wanted)
        index = chosen_positions(drive, view, wanted)
        gpu = None if device == "cpu" else cuda_device()
        prediction = Prediction(drive, view, index, dtype=dtype, rate_hz=rate_hz, device=gpu)
        unit, peak = field_unit(view), 0.0
        quiet: tuple[QuietLevel, ...] = ()
        to_file = field_in_rows(
            out, index, prediction.samples, sample_rate_hz=prediction.sample_rate_hz, start_s=prediction.start_s,
            response_unit=unit, low_pass=prediction.low_pass, force=force,
        )  # fmt: skip
        with to_file as writer, progress("predict", len(index)) as report:
            for field in _parts(prediction, drive_file, bank, rate_hz, cluster, report):
                writer.write(field)
                peak = max(peak, float(np.abs(field).max(initial=0.0)))
        lost = share_above(drive, view, index, prediction.passed_hz) if prediction.low_pass else 0.0
        if drive.quiet:
            from wavefocus.rendering.field.quiet_levels import quiet_levels  # 0.1 s, with the tables of scenes

            quiet = quiet_levels(drive, view)
        if left_out := 0 if positions else view.positions - len(index):
            say(f"{left_out} positions are not measured and are left out")
    largest = quantity(f"{peak:.4g}", unit)
    say(f"{out}: {len(index)} positions, {prediction.samples} samples, largest response {largest}")
    for level in quiet:
        say(f"quiet: {level}")
    if rate_hz is not None and prediction.passed_hz < drive.sample_rate_hz / 2:
        say(
            f"at {prediction.sample_rate_hz:g} Hz, low-passed above {prediction.passed_hz:g} Hz;"
            f" {lost:.2g} of the response's energy is above that"
        )
    if as_json:
        figures: dict[str, Any] = {
            "field": str(out),
            "positions": len(index),
            "samples": prediction.samples,
            "peak": peak,
        }
        figures |= {"sample_rate_hz": prediction.sample_rate_hz, "passed_hz": prediction.passed_hz, "lost_share": lost}
        print(json.dumps(figures | ({"quiet": [level.plain for level in quiet]} if quiet else {})))


def _parts(
    prediction: Prediction, drive_file: Path, bank: Path, rate_hz: float | None, cluster: str, report: Report
) -> Iterator[NDArray[Any]]:
    """The values of each part of the field, in their order."""
    if not cluster:
        yield from (values for _, values in prediction.rows(report))
        return
    parts, index = prediction.parts(), prediction.position_index
    positions = [index[part.start : part.stop].tolist() for part in parts]
    from wavefocus.cluster import cluster_client, field_on_cluster

    with cluster_client(cluster) as client:
        fields = field_on_cluster(client, drive_file, bank, rate_hz, positions)
        for part, field in zip(parts, fields, strict=True):
            yield field
            report(part.stop, len(index))
