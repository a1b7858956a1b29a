"""The cheapest setting of each stage that keeps to an error, among those measured on this machine."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import groupby
from math import log10
from typing import Any

from benchmarks.diagrams import COSTS


def chosen_lines(measured: Mapping[str, Mapping[str, Any]], error_db: float) -> list[str]:
    """TOML lines to paste: for each work with settings to choose from, those of the cheapest point within the error.

    Parameters
    ----------
    measured : mapping
        Contents of the benchmarks' JSON files, by name.
    error_db : float
        Largest relative error in dB, below 0.
    """
    limit = 10 ** (error_db / 20)
    lines = []
    for found in measured.values():
        for work, group in groupby(found["points"], lambda point: point["work"]):
            points = [one for one in group if one["paste"] and one.get("error") is not None]
            if not points:
                continue
            cost = next(name for name in COSTS if all(one.get(name) is not None for one in points))
            unit = "h" if cost == "hours" else "s"
            within = [one for one in points if one["error"] <= limit]
            if within:
                best = min(within, key=lambda one: one[cost])
                lines += [f"# {work}: {_measured(best, cost, unit)}", best["paste"], ""]
            else:
                best = min(points, key=lambda one: one["error"])
                lines += [f"# {work}: no setting measured reaches {error_db:g} dB; {_measured(best, cost, unit)} by"]
                lines += [*(f"# {line}" for line in best["paste"].splitlines()), ""]
    return lines


def _measured(point: Mapping[str, Any], cost: str, unit: str) -> str:
    return f"{point['method']}, {20 * log10(max(point['error'], 1e-17)):.1f} dB in {point[cost]:.3g} {unit}"
