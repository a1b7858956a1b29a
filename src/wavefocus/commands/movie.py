"""``wavefocus movie``: a predicted or scanned field as a GIF, and at its focus instants as a picture."""

import json
from math import inf
from pathlib import Path

import numpy as np

from wavefocus.campaign.blueprint import bank_configuration
from wavefocus.console import progress, say
from wavefocus.input_files import name_unverified
from wavefocus.options import MovieOptions
from wavefocus.rendering.report.movie import FramePlan, plan_frames, snapshots, surface_of, write_movie
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.drive_file import read_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import FieldRowReader
from wavefocus.storage.output_files import require_outputs, write_whole
from wavefocus.storage.units import quantity

OUTLINE_POINTS = 400


def movie(
    field_file: Path,
    bank: Path,
    out: Path | None,
    snapshot_file: Path | None,
    drive_file: Path | None,
    options: MovieOptions,
    *,
    force: bool = False,
    as_json: bool,
) -> None:
    """Draw a field file.

    Raises InputError: the files cannot be read or do not belong together, or there is nothing to show.
    """
    if out is None and snapshot_file is None:
        raise InputError("nothing to draw: give --out FILE.gif, --snapshots FILE.png, or both")
    if snapshot_file is not None and drive_file is None:
        raise InputError("--snapshots needs the focus instants: add --drive DRIVE.h5")
    require_outputs((out, snapshot_file), (field_file, bank, drive_file), force=force)
    drive = None if drive_file is None else read_drive(drive_file)
    answer: dict[str, object] = {"field": str(field_file)}
    with open_bank(bank) as view, FieldRowReader(field_file) as field:
        name_unverified(field_file, verified=field.verified)
        if drive_file is not None and drive is not None:
            name_unverified(drive_file, verified=drive.verified)
        index, foci = field.position_index, np.zeros(0, np.int64) if drive is None else drive.focus_position
        if index.min() < 0 or index.max() >= view.positions:
            raise InputError(f"{field_file} has position {index.max()}, {bank} has {view.positions}: of another bank?")
        if len(foci) and (foci.min() < 0 or foci.max() >= view.positions):
            raise InputError(f"{drive_file} has foci at positions that {bank} does not have: of another bank?")
        known = view.rig_json is not None and view.run_json is not None
        outline_mm = bank_configuration(view).rig.surface.outline.line(OUTLINE_POINTS) if known else None
        surface = surface_of(view, drive, outline_mm)
        if out is not None:
            plan = plan_frames(field, drive, from_s=options.from_s, to_s=options.to_s, slow=options.slow)
            _warn_of_strobing(plan, view, field)
            with progress("movie", len(plan.sample)) as report:
                limit = write_movie(out, field, surface, drive, plan, on_progress=report)
            say(
                f"{out}: {len(plan.sample)} frames, {plan.step_s * 1e3:.3g} ms apart, {plan.slowed:.3g} times slower"
                f" than life, colours to {quantity(f'{limit:.3g}', field.response_unit)}"
            )
            answer |= {"movie": str(out), "frames": len(plan.sample), "slowed": plan.slowed, "limit": limit}
        if snapshot_file is not None and drive is not None:
            write_whole(snapshot_file, snapshots(field, surface, drive).png)
            say(f"{snapshot_file}: the field at focus instants")
            answer["snapshots"] = str(snapshot_file)
    if as_json:
        print(json.dumps(answer))


def _warn_of_strobing(plan: FramePlan, bank: Bank, field: FieldRowReader) -> None:
    highest_hz = inf if bank.band_hz is None else bank.band_hz[1]
    if field.low_pass is not None and field.low_pass.passed_hz < highest_hz:
        highest_hz = field.low_pass.passed_hz
        say(f"{field.path} was predicted at {field.sample_rate_hz:g} Hz: it shows waves up to {highest_hz:g} Hz alone")
    # Fewer frames in a period of the band's upper end, and the movie strobes.
    enough_s = 1.0 / (2.5 * highest_hz)
    if highest_hz < inf and plan.step_s > enough_s:
        say(
            f"frames are {plan.step_s * 1e3:.3g} ms apart, too far to see waves of {highest_hz:g} Hz travel:"
            f" choose --from-s and --to-s, or --slow {1 / (enough_s * plan.frame_rate_hz):.0f}"
        )
