"""Levels that a drive reaches at its quiet places, by the bank: energy of the response over that at the loudest focus.

A place or a source that moves is followed: what counts is the response where it is at each instant.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.field.focus_figures import emission_windows
from wavefocus.rendering.field.prediction import Prediction
from wavefocus.rendering.greens.interpolation.base import OffGridError
from wavefocus.rendering.greens.source import GreenSource
from wavefocus.rendering.scene.quiet_places import PlaceRows
from wavefocus.storage.drive_file import Drive, QuietTrack
from wavefocus.storage.errors import InputError

DISC_POINTS = 16
"""Points that judge a disc: others than those at which it is kept quiet."""
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


def levels_json(
    levels: tuple[QuietLevel, ...], plain_db: Float64Array, multiplier: Float64Array
) -> list[dict[str, Any]]:
    """Levels as JSON holds them, with those of plain time reversal and the multipliers of the equations."""
    return [
        {**level.plain, "plain_db": round(before_db, 3), "multiplier": m}
        for level, before_db, m in zip(levels, plain_db.tolist(), multiplier.tolist(), strict=True)
    ]


def rendered_levels(tracks: tuple[QuietTrack, ...]) -> tuple[QuietLevel, ...]:
    """The levels that the renderer found while it made the filters, for drives that are not in memory."""
    return tuple(QuietLevel(track, track.rendered_db) for track in tracks)


def spread_mm(radius_mm: float, count: int = DISC_POINTS) -> Float64Array:
    """Points that share a disc about (0, 0) evenly, on a spiral, float64 (n, 2); one for radius 0."""
    if radius_mm == 0:
        return np.zeros((1, 2))
    number = np.arange(count)
    radius, angle = radius_mm * np.sqrt((number + 0.5) / count), np.pi * (3.0 - np.sqrt(5.0)) * number
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)


def quiet_levels(drive: Drive, bank: GreenSource) -> tuple[QuietLevel, ...]:
    """Find the levels at the quiet places of a drive, none where it has none.

    Raises InputError: drive and bank do not fit, or a place is not on the bank's grid.
    """
    if not drive.quiet:
        return ()
    measured = [track for track in drive.quiet if track.source < 0]
    reference = _loudest(drive, bank) if measured else 0.0
    place_rows = PlaceRows(bank)
    found: list[QuietLevel] = []
    for track in drive.quiet:
        if track.source >= 0:
            found += rendered_levels((track,))
            continue
        around_mm = spread_mm(track.radius_mm)
        try:
            rows = place_rows.at((track.at_mm[:, None] + around_mm).reshape(-1, 2))
        except OffGridError as off:
            raise InputError(f"{track.name} {off}") from off
        energy = _energy(drive, place_rows.rows, rows.reshape(-1, len(around_mm)), track.sample)
        levels = energy / max(reference, 1e-300)
        worst_db = _db(levels.max()) if track.radius_mm else None
        found.append(QuietLevel(track, _db(levels.mean()), worst_db))
    return tuple(found)


def _loudest(drive: Drive, bank: GreenSource) -> float:
    """Energy of the response at the loudest focus."""
    windows = emission_windows(drive)
    found = [0.0]
    for source in sorted({one.source for one in windows}):
        own = [one for one in windows if one.source == source]
        rows = np.array([[one.row] for one in own], dtype=np.int64)
        found.append(float(_energy(drive, bank, rows, np.array([one.start_sample for one in own])).sum()))
    return max(found)


def _energy(drive: Drive, bank: GreenSource, rows: Int64Array, sample: Int64Array) -> Float64Array:
    """Energy of the response at rows (instants, points) that take over from one another at samples, (points,).

    The response of one instant counts whole; of several, each from its sample to the next.
    """
    unique, inverse = np.unique(rows, return_inverse=True)
    inverse = inverse.reshape(rows.shape)
    prediction = Prediction(drive, bank, unique, dtype=np.float64)
    response = np.concatenate([one.field for one in prediction.rows()])
    if len(rows) == 1:
        return np.asarray(np.square(response[inverse[0]]).sum(axis=1))
    first = round(drive.start_s * drive.sample_rate_hz)
    stop = first + drive.drive_v.shape[1]
    middles = (sample[1:] + sample[:-1]) // 2
    edges = np.concatenate([sample[:1], middles, [max(stop, int(sample[-1]) + 1)]]) - first
    energy = np.zeros(rows.shape[1])
    for own, begin, end in zip(inverse, edges[:-1].tolist(), edges[1:].tolist(), strict=True):
        energy += np.square(response[own, max(begin, 0) : max(end, 0)]).sum(axis=1)
    return energy


def _db(level: float) -> float:
    return float(10.0 * np.log10(max(level, 10.0 ** (SILENT_DB / 10))))
