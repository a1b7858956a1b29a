"""The picture of a campaign's drift: what became of the sentinel position over time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import TYPE_CHECKING

import numpy as np

from acquisition.quality.sentinel import DriftLimits
from rendering.report.canvas import FAINT, INK, Canvas, Picture, drawn_in_style

if TYPE_CHECKING:
    from matplotlib.axes import Axes

VERDICT_COLOURS = {"steady": "#0b3c5d", "warn": "#e69f00", "stop": "#d55e00"}
WARN, STOP = VERDICT_COLOURS["warn"], VERDICT_COLOURS["stop"]
# Steady figures fill the middle of the picture; limits far beyond them would press them flat.
ROOM = 1.35


@dataclass(frozen=True, slots=True)
class DriftPoint:
    """The sentinel position measured again, against its first measurement.

    Parameters
    ----------
    at : datetime
        When, with a time zone.
    level_db, delay_samples, correlation : float
        As of `acquisition.quality.sentinel.DriftFigures`.
    verdict : str
        ``"steady"``, ``"warn"`` or ``"stop"``.
    suspect : tuple of int
        Positions measured since it was last steady, where the verdict is to stop.
    """

    at: datetime
    level_db: float
    delay_samples: float
    correlation: float
    verdict: str
    suspect: tuple[int, ...] = ()


@drawn_in_style
def drift_over_time(points: Sequence[DriftPoint], limits: DriftLimits) -> Picture:
    """Level, delay and correlation of the sentinel position over the hours, with the limits for warning and stopping.

    Parameters
    ----------
    points : sequence of DriftPoint
        Oldest first, at least one.
    limits : DriftLimits
        Those of the run.
    """
    from matplotlib.patches import Patch

    canvas = Canvas("drift", 1120, 470)
    # Days, as matplotlib counts them; minutes and seconds are fractions.
    days = np.array([point.at.timestamp() / 86_400.0 for point in points])
    rows = (
        ("level (dB)", [point.level_db for point in points], limits.warn_level_db, limits.stop_level_db),
        (
            "delay (samples)",
            [point.delay_samples for point in points],
            limits.warn_delay_samples,
            limits.stop_delay_samples,
        ),
        # As distance from 1, so that all three are zero where nothing has changed.
        (
            "1 - correlation",
            [1.0 - point.correlation for point in points],
            1.0 - limits.warn_correlation,
            1.0 - limits.stop_correlation,
        ),
    )
    colours = [VERDICT_COLOURS.get(point.verdict, FAINT) for point in points]
    room = max(0.02 * (days[-1] - days[0]), 600.0 / 86_400.0)
    for row, (label, values, warn, stop) in enumerate(rows):
        axes = canvas.axes(80, 14 + 130 * row, 1020, 112)
        axes.plot(days, values, "-", color=FAINT, lw=0.8, zorder=2)
        axes.scatter(days, values, c=colours, s=16, zorder=3)
        _draw_limits(axes, np.array(values), warn, stop, both_sides=row < 2)
        axes.set_ylabel(label)
        axes.set_xlim(days[0] - room, days[-1] + room)
        axes.spines[["top", "right"]].set_visible(False)
        _label_clock(axes, points[0].at, with_labels=row == 2)
    keys = [Patch(color=colour, label=word) for word, colour in VERDICT_COLOURS.items()]
    canvas.figure.legend(handles=keys, loc="upper center", bbox_to_anchor=canvas.legend_place(590, 440), ncols=3)
    return canvas.picture()


def _draw_limits(axes: Axes, values: np.ndarray, warn: float, stop: float, *, both_sides: bool) -> None:
    """Show the limits that are near enough to the values, and the span that leaves."""
    finite = np.abs(values[np.isfinite(values)])
    largest = float(finite.max(initial=0.0))
    span = ROOM * max(warn if largest <= warn else stop, largest)
    for limit, colour in ((warn, WARN), (stop, STOP)):
        for side in (1.0, -1.0) if both_sides else (1.0,):
            if limit < span:
                axes.axhline(side * limit, color=colour, lw=0.8, ls="--", zorder=1)
    axes.axhline(0.0, color=FAINT, lw=0.5, zorder=1)
    axes.set_ylim(-span if both_sides else -0.04 * span, span)


def _label_clock(axes: Axes, first: datetime, *, with_labels: bool) -> None:
    from matplotlib.dates import AutoDateLocator, ConciseDateFormatter

    zone = first.astimezone().tzinfo
    locator = AutoDateLocator(tz=zone)  # type: ignore[no-untyped-call]
    axes.xaxis.set_major_locator(locator)
    axes.xaxis.set_major_formatter(ConciseDateFormatter(locator, tz=zone))  # type: ignore[no-untyped-call]
    axes.tick_params(colors=INK, labelbottom=with_labels)
    axes.xaxis.get_offset_text().set_visible(with_labels)
