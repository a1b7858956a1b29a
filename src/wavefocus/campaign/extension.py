"""A bank with more positions: the rows of another bank of the same rig and plate are taken over, not measured again."""

import json
from collections.abc import Callable, Iterator
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from wavefocus.calibration import Float32Array, Float64Array
from wavefocus.campaign.blueprint import Blueprint, blueprint_from_bank, blueprint_of, listed_differences
from wavefocus.campaign.session_files import with_chosen_schedule
from wavefocus.campaign.sidecar_files import raw_path
from wavefocus.configuration import load_run, plan_differences
from wavefocus.input_files import parse_positions
from wavefocus.storage.bank.foreign import ForeignRows
from wavefocus.storage.bank.ledger import QUALITY_NAMES, PointRecord, Status, row_ranges
from wavefocus.storage.bank.reading import Bank, Origin, open_bank, origins_of
from wavefocus.storage.bank.writer import write_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replacement, require_outputs
from wavefocus.storage.raw.header import create_raw
from wavefocus.storage.raw.writer import RawFile, RawWriter, open_raw

STEP_MM = 1e-6
"""Positions are the same where they agree to this: they are written as whole numbers of it."""
_POSITIONS_ALONE = ("position_mm", "grid.check_positions")
"""Keys of a plan that are about positions; how many check positions are the default differs between versions."""
Taken = dict[int, int]
"""Row of the new bank to the row that it is taken from."""
_TAKEN = (int(Status.VALID), int(Status.DISABLED), int(Status.VALID | Status.DISABLED))


def extend(bank: Path, out: Path, run_file: Path) -> Blueprint:
    """Make a bank of the valid and the disabled rows of another, and of positions that are still to be measured.

    The new bank has the positions of `run_file` in their order, then those taken over that are not among them. What a
    resume must not change has to be alike but for the positions. That the plate is still the same is shown by the first
    session: it measures the sentinel, which is a row that was taken over, before it adds anything.

    bank: A bank that this program measured; its rows are read and verified.
    out: The bank to write; with kept recordings also the raw file beside it.
    run_file: The run with the new positions.

    Returns the new bank's campaign. Raises InputError: the plans do not fit together, a checksum does not hold, or an
    output is there; nothing is left behind.
    """
    with open_bank(bank) as view:
        view.require_sound()
        own = blueprint_from_bank(bank).configuration
        wanted = with_chosen_schedule(load_run(run_file), own)
        differences = [one for one in plan_differences(own, wanted) if one.key not in _POSITIONS_ALONE]
        if differences:
            raise InputError(
                f"{run_file}: its rows would be of another kind than those of {bank}, which has "
                f"{listed_differences(differences)}; only positions may be others"
            )
        taken, position_mm, checks = _taken(view, wanted.position_mm)
        blueprint = blueprint_of(replace(wanted, position_mm=position_mm))
        if out != bank and _is_of(out, open_bank, blueprint):
            raise InputError(f"{out} was made by this command before; go on with: wavefocus resume {out}")
        require_outputs((out,), [bank], force=False)
        if blueprint.configuration.run.capture.keep_raw:
            recordings = raw_path(out)
            # Recordings of this plan without their bank: the command was ended between the two, which are each whole.
            if not _is_of(recordings, open_raw, blueprint):
                require_outputs((recordings,), [raw_path(bank)], force=False)
                _extend_raw(raw_path(bank), taken, blueprint, recordings)
        header = blueprint.bank_header()
        header = replace(
            header,
            check_rows=tuple(sorted({*header.check_rows, *checks})),
            inter_channel_delay_s=view.inter_channel_delay_s,
            origins=_origins(view, taken),
        )
        write_bank(out, header, _rows(view, taken), view.notes)
    return blueprint


def _is_of(path: Path, opened: Callable[[Path], Bank | RawFile], blueprint: Blueprint) -> bool:
    """Whether a file is there and belongs to a plan."""
    if not path.is_file():
        return False
    try:
        with opened(path) as file:
            held = file.header.plan_sha256 if isinstance(file, RawFile) else file.plan_sha256
    except InputError:
        return False
    return held == blueprint.plan.sha256


def _key(position_mm: Float64Array) -> tuple[int, int]:
    return round(float(position_mm[0]) / STEP_MM), round(float(position_mm[1]) / STEP_MM)


def _taken(view: Bank, grid_mm: Float64Array) -> tuple[Taken, Float64Array, list[int]]:
    """Which rows are taken from where, all positions (P, 2), and those of them that stay check positions.

    A check position that is on the new grid is none any longer.
    """
    places = [*grid_mm]
    row_at = {_key(place): row for row, place in enumerate(places)}
    taken: Taken = {}
    checks = []
    for own in np.flatnonzero(np.isin(view.status, _TAKEN)).tolist():
        row = row_at.setdefault(_key(view.position_mm[own]), len(places))
        if row == len(places):
            places.append(view.position_mm[own])
            if view.check[own]:
                checks.append(row)
        taken.setdefault(row, own)
    return dict(sorted(taken.items())), np.array(places), checks


def _origins(view: Bank, taken: Taken) -> str:
    """JSON text of all origins; rows that an earlier extension took over keep the bank that measured them."""
    measured = (view.path.name, view.plan_sha256 or "", view.software or "")
    of_row = {
        row: (origin.bank, origin.plan_sha256, origin.software)
        for origin in origins_of(view)
        for row in parse_positions(origin.rows.replace(" ", ""), view.positions)
    }
    rows: dict[tuple[str, str, str], list[int]] = {}
    for row, own in taken.items():
        rows.setdefault(of_row.get(own, measured), []).append(row)
    return json.dumps([asdict(Origin(*key, row_ranges(found))) for key, found in rows.items()])


def _rows(view: Bank, taken: Taken) -> Iterator[tuple[int, Float32Array, PointRecord]]:
    for row, own in taken.items():
        yield row, np.asarray(view.green(own), np.float32), _record(view, own)


def _record(view: Bank, row: int) -> PointRecord:
    """A row's status and quality; what its neighbours said of it is asked again among the new ones."""
    quality = {name: view.quality[name][row] for name in QUALITY_NAMES if name != "attempts"}
    suspect = not isinstance(view.rows, ForeignRows) and bool(view.rows.figures.suspect[row])
    return PointRecord(int(view.status[row]), int(view.quality["attempts"][row]), **quality, suspect=suspect)


def _extend_raw(old: Path, taken: Taken, blueprint: Blueprint, path: Path) -> None:
    """Take over the recordings too, for a run that keeps them."""
    plan, header = blueprint.plan, blueprint.bank_header()
    if not old.exists():
        raise InputError(
            f"{old} is missing, and the run has capture.keep_raw = true: put it back, or set keep_raw = false"
        )
    with replacement(path) as temporary, open_raw(old) as raw:
        create_raw(
            temporary,
            replace(
                raw.header, position_mm=plan.position_mm, plan_sha256=plan.sha256, rig_json=header.rig_json,
                run_json=header.run_json, software=header.software,
            ),
        )  # fmt: skip
        with RawWriter.open(temporary, plan_sha256=plan.sha256) as writer:
            for row, own in taken.items():
                if (kept := raw.read(own)) is not None:
                    writer.commit(row, kept.reference_v, kept.response_v, float(raw.leak_db[own]))
