"""``wavefocus estimate``: Green's functions from kept recordings."""

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.wording import hours
from wavefocus.console import progress, say
from wavefocus.estimation import estimate_into
from wavefocus.storage.bank.ledger import status_counts
from wavefocus.storage.raw.header import RawHeader
from wavefocus.storage.raw.writer import open_raw

# So many faults are listed one by one.
MAX_LINES = 10


def estimate(raw: Path, bank: Path, *, cluster: str = "", as_json: bool) -> None:
    """Estimate all positions of a raw file that the bank does not hold yet; a new bank is made where none is."""
    with open_raw(raw) as recordings:
        header = recordings.header
        done = estimate_into(recordings, bank, None, cluster=cluster, report=say, watch=progress)
    for line in done.faults[:MAX_LINES]:
        say(line)
    if len(done.faults) > MAX_LINES:
        say(f"and {len(done.faults) - MAX_LINES} positions more that are not valid")
    _print_result(bank, raw, header, done.status, done.positions, done.took_s, as_json=as_json)


def _print_result(
    bank: Path, raw: Path, header: RawHeader, status: NDArray[np.uint8], estimated: int, took_s: float, *, as_json: bool
) -> None:
    counts = status_counts(status)
    signals = estimated * header.actuators
    facts = {
        "bank": str(bank),
        "raw": str(raw),
        "positions": header.positions,
        "estimated": estimated,
        "counts": counts,
        "seconds": round(took_s, 3),
        "green_functions_per_s": round(signals / took_s, 1) if estimated and took_s > 0 else None,
    }
    if as_json:
        print(json.dumps(facts))
    words = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    speed = f"; {signals} Green's functions in {hours(took_s)}, {signals / took_s:.0f} a second" if signals else ""
    say(f"{bank}: {header.positions} positions ({words}){speed}")
