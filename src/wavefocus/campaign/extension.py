"""A bank with more positions: the rows of other banks of the same rig and plate are taken over, not measured again."""

import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np

from wavefocus.acquisition.attempt import scale_differences
from wavefocus.acquisition.limits import compare_sentinel
from wavefocus.calibration import Float32Array, Float64Array
from wavefocus.calibration.estimator.noise_error import bank_noise_error_db, noise_share
from wavefocus.campaign.blueprint import (
    Blueprint,
    bank_configuration,
    blueprint_from_bank,
    blueprint_of,
    listed_differences,
)
from wavefocus.campaign.session_files import with_chosen_schedule
from wavefocus.campaign.sidecar_files import raw_path
from wavefocus.configuration import Configuration, load_run, plan_differences
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
Taken = dict[int, tuple[int, int]]
"""Row of the new bank to bank and row that it is taken from."""
_TAKEN = (int(Status.VALID), int(Status.DISABLED), int(Status.VALID | Status.DISABLED))


def extend(banks: Sequence[Path], out: Path, run_file: Path | None = None) -> Blueprint:
    """Make a bank of the valid and the disabled rows of others, and of positions that are still to be measured.

    The new bank has the positions of `run_file` in their order, then those taken over that are not among them. What a
    resume must not change has to be alike but for the positions. Positions that several banks hold have to agree as a
    repeated sentinel has to; of several banks each must share one with those before it, or nothing would show that
    they are of one plate. That the plate is still the same is shown by the first session: it measures the sentinel,
    which is a row that was taken over, before it adds anything.

    banks: Banks that this program measured; their rows are read and verified.
    out: The bank to write; with kept recordings also the raw file beside it.
    run_file: The run with the new positions; by default none are added.

    Returns the new bank's campaign. Raises InputError: the plans or the rows do not fit together, a checksum does not
    hold, or an output is there; nothing is left behind.
    """
    with ExitStack() as stack:
        views = [stack.enter_context(open_bank(bank)) for bank in banks]
        for view in views:
            view.require_sound()
        wanted = blueprint_from_bank(banks[0]).configuration
        if run_file is not None:
            wanted = with_chosen_schedule(load_run(run_file), wanted)
        for bank in banks:
            _require_same_kind(bank, blueprint_from_bank(bank).configuration, wanted, str(run_file or banks[0]))
        delays = {view.inter_channel_delay_s for view in views}
        if len(delays) > 1:
            raise InputError(f"{banks[-1]}: its recorder sampled the response later or earlier than that of {banks[0]}")
        grid_mm = wanted.position_mm if run_file is not None else np.zeros((0, 2))
        taken, position_mm, checks = _taken(views, grid_mm)
        blueprint = blueprint_of(replace(wanted, position_mm=position_mm))
        if out not in banks and _is_of(out, open_bank, blueprint):
            raise InputError(f"{out} was made by this command before; go on with: wavefocus resume {out}")
        require_outputs((out,), banks, force=False)
        if blueprint.configuration.run.capture.keep_raw:
            recordings = raw_path(out)
            # Recordings of this plan without their bank: the command was ended between the two, which are each whole.
            if not _is_of(recordings, open_raw, blueprint):
                require_outputs((recordings,), [raw_path(view.path) for view in views], force=False)
                _extend_raw(views, taken, blueprint, recordings)
        _write(out, views, taken, blueprint, checks)
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


def _write(out: Path, views: Sequence[Bank], taken: Taken, blueprint: Blueprint, checks: Sequence[int]) -> None:
    header = blueprint.bank_header()
    header = replace(
        header,
        check_rows=tuple(sorted({*header.check_rows, *checks})),
        inter_channel_delay_s=views[0].inter_channel_delay_s,
        origins=_origins(views, taken),
    )
    notes = sorted({note for view in views for note in view.notes}, key=lambda note: note.at)
    write_bank(out, header, _rows(views, taken), notes)


def _require_same_kind(bank: Path, own: Configuration, wanted: Configuration, source: str) -> None:
    differences = [one for one in plan_differences(own, wanted) if one.key not in _POSITIONS_ALONE]
    if differences:
        raise InputError(
            f"{source}: its rows would be of another kind than those of {bank}, which has "
            f"{listed_differences(differences)}; only positions may be others"
        )


def _key(position_mm: Float64Array) -> tuple[int, int]:
    return round(float(position_mm[0]) / STEP_MM), round(float(position_mm[1]) / STEP_MM)


def _taken(views: Sequence[Bank], grid_mm: Float64Array) -> tuple[Taken, Float64Array, list[int]]:
    """Which rows are taken from where, all positions (P, 2), and those of them that are check positions of all banks.

    A check position that is on the new grid is none any longer.
    """
    places = [*grid_mm]
    row_at = {_key(place): row for row, place in enumerate(places)}
    taken: Taken = {}
    checks, on_grid = set[int](), set(range(len(places)))
    for index, view in enumerate(views):
        status, shared = view.status, 0
        for own in np.flatnonzero(np.isin(status, _TAKEN)).tolist():
            key = _key(view.position_mm[own])
            if key not in row_at:
                row_at[key] = len(places)
                places.append(view.position_mm[own])
            row = row_at[key]
            (checks if view.check[own] else on_grid).add(row)
            if row not in taken:
                taken[row] = index, own
            elif status[own] == Status.VALID == views[taken[row][0]].status[taken[row][1]]:
                _require_alike(views[taken[row][0]], taken[row][1], view, own)
                shared += 1
        if index and not shared:
            raise InputError(
                f"{view.path}: shares no valid position with {views[0].path}, so that nothing shows that they are of "
                "one plate; measure its positions with wavefocus extend --run instead"
            )
    position_mm = np.array(places, np.float64).reshape(-1, 2)
    return dict(sorted(taken.items())), position_mm, sorted(checks - on_grid)


def _noise_share(bank: Bank, row: int) -> Float64Array:
    error_db = bank_noise_error_db(bank, row)
    return np.zeros(bank.actuators) if error_db is None else np.nan_to_num(noise_share(error_db))


def _require_alike(first: Bank, row: int, second: Bank, other: int) -> None:
    figures = compare_sentinel(
        np.asarray(first.green(row), np.float32), np.asarray(second.green(other), np.float32),
        first.quality["snr_db"][row], (_noise_share(first, row), _noise_share(second, other)),
        band_hz=first.band_hz, sample_rate_hz=first.sample_rate_hz,
    )  # fmt: skip
    if figures.speaks_against(bank_configuration(first).run.drift):
        raise InputError(
            f"{second.path}: position {other} is not what position {row} of {first.path} is, at the same place: "
            f"{figures}; they are not of one plate or one set-up"
        )


def _origins(views: Sequence[Bank], taken: Taken) -> str:
    """JSON text of all origins; rows that an earlier extension took over keep the bank that measured them."""
    rows: dict[tuple[str, str, str], list[int]] = {}
    for index, view in enumerate(views):
        measured = (view.path.name, view.plan_sha256 or "", view.software or "")
        of_row = {
            row: (origin.bank, origin.plan_sha256, origin.software)
            for origin in origins_of(view)
            for row in parse_positions(origin.rows.replace(" ", ""), view.positions)
        }
        for row, (source, own) in taken.items():
            if source == index:
                rows.setdefault(of_row.get(own, measured), []).append(row)
    return json.dumps([asdict(Origin(*key, row_ranges(found))) for key, found in rows.items()])


def _rows(views: Sequence[Bank], taken: Taken) -> Iterator[tuple[int, Float32Array, PointRecord]]:
    for row, (index, own) in taken.items():
        view = views[index]
        yield row, np.asarray(view.green(own), np.float32), _record(view, own)


def _record(view: Bank, row: int) -> PointRecord:
    """A row's status and quality; what its neighbours said of it is asked again among the new ones."""
    quality = {name: view.quality[name][row] for name in QUALITY_NAMES if name != "attempts"}
    suspect = not isinstance(view.rows, ForeignRows) and bool(view.rows.figures.suspect[row])
    return PointRecord(int(view.status[row]), int(view.quality["attempts"][row]), **quality, suspect=suspect)


def _extend_raw(views: Sequence[Bank], taken: Taken, blueprint: Blueprint, path: Path) -> None:
    """Take over the recordings too, for a run that keeps them."""
    plan, header = blueprint.plan, blueprint.bank_header()
    for view in views:
        if not raw_path(view.path).exists():
            raise InputError(
                f"{raw_path(view.path)} is missing, and the run has capture.keep_raw = true: put it back, or set "
                "keep_raw = false"
            )
    with replacement(path) as temporary, ExitStack() as stack:
        raws = [stack.enter_context(open_raw(raw_path(view.path))) for view in views]
        for raw in raws[1:]:
            for name, first, other in scale_differences(raws[0].header, raw.header):
                raise InputError(
                    f"{raws[0].path} was recorded with {name} {first}, {raw.path} with {other}, and one file holds one "
                    "value: to take over the rows alone, set keep_raw = false in a run file, and name it by --run"
                )
        create_raw(
            temporary,
            replace(
                raws[0].header, position_mm=plan.position_mm, plan_sha256=plan.sha256, rig_json=header.rig_json,
                run_json=header.run_json, software=header.software,
            ),
        )  # fmt: skip
        with RawWriter.open(temporary, plan_sha256=plan.sha256) as writer:
            for row, (index, own) in taken.items():
                if (kept := raws[index].read(own)) is not None:
                    writer.commit(row, kept.reference_v, kept.response_v, float(raws[index].leak_db[own]))
