"""The drift history beside a bank: one JSON line for each time that the sentinel position was measured again."""

from __future__ import annotations

import json
from collections.abc import Mapping
from datetime import datetime
from pathlib import Path
from types import TracebackType

from acquisition.engine.events import Drift, Event
from acquisition.schedule.row_ranges import row_ranges
from rendering.report.figures import DriftPoint
from storage.sidecar_files import Log
from wavefocus.campaign.event_log import EventLines


def drift_path(bank: Path) -> Path:
    """Where the drift of a bank is kept: ``plate.h5`` -> ``plate.drift.jsonl``."""
    return bank.with_suffix(".drift.jsonl")


class DriftHistory:
    """Appends to the drift history of a bank; a subscriber.

    It is not in the bank, for it holds clock times, and a resumed bank is to be that of an undisturbed campaign.
    """

    def __init__(self, bank: Path) -> None:
        self._file = Log(drift_path(bank))
        self._lines = EventLines(self._file.write, str(drift_path(bank)))

    def __call__(self, event: Event) -> None:
        """Keep what is drift."""
        if isinstance(event, Drift):
            self._lines(event)

    def __enter__(self) -> DriftHistory:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._file.close()


def read_drift(bank: Path) -> list[DriftPoint]:
    """The drift history of a bank, oldest first; empty where there is none. Torn lines are passed over."""
    path = drift_path(bank)
    if not path.is_file():
        return []
    points = []
    for line in path.read_bytes().splitlines():
        try:
            points.append(_point(json.loads(line)))
        except (ValueError, TypeError, KeyError):
            continue
    return points


def suspect_rows(points: list[DriftPoint]) -> str:
    """Positions that the latest measurement of the sentinel speaks against, as ``--positions`` takes them."""
    return row_ranges(points[-1].suspect) if points else ""


def _point(record: Mapping[str, object]) -> DriftPoint:
    at = datetime.fromisoformat(str(record["at"]))
    at.utctimetuple()
    suspect = record["suspect"]
    return DriftPoint(
        at,
        level_db=float(str(record["level_db"])),
        delay_samples=float(str(record["delay_samples"])),
        correlation=float(str(record["correlation"])),
        verdict=str(record["verdict"]),
        suspect=tuple(int(row) for row in suspect) if isinstance(suspect, list) else (),
    )
