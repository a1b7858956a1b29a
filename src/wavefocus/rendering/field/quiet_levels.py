"""Levels that a drive reaches at its quiet places, by the bank: energy of the response over that at the loudest focus.

A place or a source that moves is followed: what counts is the response where it is at each instant.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.field.foci import FocusInstant, emission_windows, windows_at_foci
from wavefocus.rendering.field.prediction import Prediction
from wavefocus.rendering.greens.interpolation.base import OffGridError
from wavefocus.rendering.greens.source import GreenSource
from wavefocus.rendering.scene.quiet_places import PlaceRows
from wavefocus.storage.drive_file import Drive, QuietTrack
from wavefocus.storage.errors import InputError

DISC_POINTS = 16
"""Points that judge a disc: others than those at which it is kept quiet."""
PLACE_REACH_MM, FOCUS_REACH_MM = 0.5, 4.0
"""What moves is followed by its places at some instants: so far from them it still is there."""
SILENT_DB = -300.0


@dataclass(frozen=True, slots=True)
class QuietLevel:
    """A quiet place of a drive.

    reached_db: Level of the drive's response; of a place of a source, whose own response is there, too, the level of
        the others as it was rendered.
    worst_db: At the loudest point of a disc; None of a point, and where it was not computed.
    """

    track: QuietTrack
    reached_db: float
    worst_db: float | None = None

    def __str__(self) -> str:
        track = self.track
        where = "moving" if len(track.sample) > 1 else "at ({:.4g}, {:.4g}) mm".format(*track.at_mm[0])
        disc = f", disc of {track.radius_mm:g} mm" if track.radius_mm else ""
        if self.worst_db is not None:
            disc += f" (loudest point {self.worst_db:.1f} dB)"
        return f"{track.name} {where}: {self.reached_db:.1f} dB of {track.level_db:g} dB asked{disc}"

    @property
    def plain(self) -> dict[str, Any]:
        """As JSON holds it."""
        track = self.track
        return {
            "name": track.name,
            "at_mm": track.at_mm[0].tolist() if len(track.sample) == 1 else None,
            "radius_mm": track.radius_mm,
            "level_db": track.level_db,
            "reached_db": round(self.reached_db, 3),
            "worst_db": None if self.worst_db is None else round(self.worst_db, 3),
        }


def rendered_levels(tracks: tuple[QuietTrack, ...]) -> tuple[QuietLevel, ...]:
    """The levels that the renderer found while it made the filters, for drives that are not in memory."""
    return tuple(QuietLevel(track, track.rendered_db) for track in tracks)


def _spread_mm(radius_mm: float) -> Float64Array:
    """Points that share a disc about (0, 0) evenly, on a spiral, float64 (n, 2); one for radius 0."""
    if radius_mm == 0:
        return np.zeros((1, 2))
    number = np.arange(DISC_POINTS)
    radius, angle = radius_mm * np.sqrt((number + 0.5) / DISC_POINTS), np.pi * (3.0 - np.sqrt(5.0)) * number
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def quiet_levels(drive: Drive, bank: GreenSource) -> tuple[QuietLevel, ...]:
    """Find the levels at the quiet places of a drive, by the bank; none where it has none.

    Raises InputError: drive and bank do not fit, or a place is not on the bank's grid.
    """
    measured = [track for track in drive.quiet if track.source < 0]
    if not measured:
        return rendered_levels(drive.quiet)
    windows, of_foci = windows_at_foci(drive, bank)
    response = Prediction(drive, of_foci, np.unique([window.row for window in windows]), dtype=np.float64).field()
    own_mm = drive.focus_mm if drive.focus_mm is not None else np.asarray(bank.position_mm)[drive.focus_position]
    at_mm = np.asarray(own_mm, dtype=np.float64)[[window.focus for window in windows]]
    reference = max(_focus_energies(drive, windows, response.field, response.position_index, at_mm), default=0.0)
    methods = {track.interpolation: PlaceRows(bank, name=track.interpolation) for track in measured}
    found: list[QuietLevel] = []
    for track in drive.quiet:
        if track.source >= 0:
            found += rendered_levels((track,))
            continue
        place_rows, around_mm = methods[track.interpolation], _spread_mm(track.radius_mm)
        try:
            rows = place_rows.at((track.at_mm[:, None] + around_mm).reshape(-1, 2))
        except OffGridError as off:
            raise InputError(f"{track.name} {off}") from off
        index, inverse = np.unique(rows, return_inverse=True)
        there = Prediction(drive, place_rows.rows, index, dtype=np.float64).field().field
        where = list(inverse.reshape(-1, len(around_mm)))
        energy = np.sum(_followed(drive, there, where, track.sample, track.at_mm, PLACE_REACH_MM), axis=0)
        worst_db = _level_db_of(energy.max(), reference) if track.radius_mm else None
        found.append(QuietLevel(track, _level_db_of(energy.mean(), reference), worst_db))
    return tuple(found)


def field_levels(
    drive: Drive, field: NDArray[Any], position_index: Int64Array, position_mm: Float64Array, spacing_mm: float
) -> list[tuple[QuietTrack, float | None, int]]:
    """Levels at a drive's quiet places in a field that was scanned or predicted at positions of the bank.

    field, (positions, samples): From the drive's first sample on.
    position_mm, float64 (positions, 2): Places of its positions; of a disc those within it count, of a point the
        nearest one within a grid spacing.

    Returns each quiet place with its level, None where no focus or no position of it is in the field, and the number of
    positions. Those of sources are left out: their own response is there.
    """
    windows = emission_windows(drive)
    focus_mm = np.zeros((int(max(position_index.max(), drive.focus_position.max(initial=0))) + 1, 2))
    focus_mm[position_index] = position_mm
    at_mm = focus_mm[[window.row for window in windows]]
    reference = max(_focus_energies(drive, windows, field, position_index, at_mm), default=0.0)
    found: list[tuple[QuietTrack, float | None, int]] = []
    for track in drive.quiet:
        if track.source >= 0:
            continue
        where, apart_mm = positions_at(track, position_mm)
        level_db = None
        if (apart_mm <= spacing_mm).all() and reference > 0:
            energy = _followed(drive, field, where, track.sample, track.at_mm, PLACE_REACH_MM)
            level_db = _level_db_of(float(sum(values.mean() for values in energy)), reference)
        found.append((track, level_db, len(np.unique(np.concatenate(where)))))
    return found


def positions_at(track: QuietTrack, position_mm: Float64Array) -> tuple[list[Int64Array], Float64Array]:
    """Positions (n, 2) in the disc of a place at each instant, or the nearest, and the distance of the nearest."""
    apart_mm = np.hypot(*(position_mm - track.at_mm[:, None]).transpose(2, 0, 1))
    within, nearest = apart_mm <= track.radius_mm, apart_mm.argmin(axis=1)
    where = [np.flatnonzero(inside) if inside.any() else at[None] for inside, at in zip(within, nearest, strict=True)]
    return where, apart_mm.min(axis=1)


def _focus_energies(
    drive: Drive, windows: Sequence[FocusInstant], field: NDArray[Any], position_index: Int64Array, at_mm: Float64Array
) -> list[float]:
    """Energy of the response at the foci of each source whose foci are all in a field.

    position_index: Rows of the field. at_mm, float64 (windows, 2): Places of the foci.
    """
    place = {row: at for at, row in enumerate(position_index.tolist())}
    found = []
    for source in sorted({window.source for window in windows}):
        own = [index for index, window in enumerate(windows) if window.source == source]
        if all(windows[index].row in place for index in own):
            where = [np.array([place[windows[index].row]]) for index in own]
            begins = np.array([windows[index].start_sample for index in own])
            energy = _followed(drive, field, where, begins, at_mm[own], FOCUS_REACH_MM)
            found.append(float(sum(values.sum() for values in energy)))
    return found


def _followed(
    drive: Drive,
    field: NDArray[Any],
    where: Sequence[Int64Array],
    sample: Int64Array,
    at_mm: Float64Array,
    reach_mm: float,
) -> list[Float64Array]:
    """Energies of a response that is followed from instant to instant: at rows of a field, (rows,) for each instant.

    The only instant counts whole; of several, each from half-way to the one before to half-way to the next, by the part
    of that time in which what moves, at `at_mm` (instants, 2), is within so many millimetres.
    """
    if len(where) == 1:
        return [np.square(field[where[0]], dtype=np.float64).sum(axis=1)]
    first = round(drive.start_s * drive.sample_rate_hz)
    stop = max(first + drive.drive_v.shape[1], int(sample[-1]) + 1)
    edges = np.concatenate([sample[:1], (sample[1:] + sample[:-1]) / 2, [stop]]) - first
    speed = np.hypot(*np.diff(at_mm, axis=0).T) / np.maximum(np.diff(sample), 1)
    speeds = np.concatenate([speed[:1], speed, speed[-1:]])
    energies = []
    for index, rows in enumerate(where):
        now = float(sample[index] - first)
        before, after = now - edges[index], edges[index + 1] - now
        moved_mm = float(before * speeds[index] + after * speeds[index + 1])
        part = min(1.0, 2.0 * reach_mm / max(moved_mm, 1e-9))
        begin = max(round(now - part * before), 0)
        end = max(round(now + part * after), begin + 1)
        energies.append(np.square(field[rows, begin:end], dtype=np.float64).sum(axis=1) / part)
    return energies


def _level_db_of(energy: float, reference: float) -> float:
    """A level in dB, at least `SILENT_DB`."""
    return float(10.0 * np.log10(max(energy / max(reference, 1e-300), 10.0 ** (SILENT_DB / 10))))
