"""Pictures of an experiment's answers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.report.canvas import COLOURS, FAINT, INK, Canvas, Picture, drawn_in_style
from wavefocus.trials.analysis.results import Psychometric
from wavefocus.trials.analysis.shares import Share
from wavefocus.trials.analysis.times import ReactionTime

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAMES = {
    "speed_mm_s": "speed (mm/s)", "amplitude": "amplitude", "path": "path", "signal": "signal", "plays": "plays"
}  # fmt: skip
MAX_BARS = 36
MAX_CURVES = 12
_COLUMNS = 4


@drawn_in_style
def share_bars(name: str, shares: Sequence[Share], what: str, chance: float | None = None) -> Picture:
    """Shares by one or two factors with their intervals, as the paper's figure 5B.

    chance: Share of right answers of a participant who guesses; None where no answer is right.
    """
    first, *others = shares[0].factors
    groups = list(dict.fromkeys(share.factors[first] for share in shares))
    series = list(dict.fromkeys(_series(share, others) for share in shares))
    width_px = max(360.0, 130 + 34 * len(groups) * (len(series) + 0.6))
    canvas = Canvas(name, width_px, 300)
    axes = canvas.plot(58, 38, width_px - 74, 206, xlabel=NAMES[first], ylabel=f"{what} (%)", ylim=(0, 105))
    width = 0.8 / len(series)
    for number, name_of_series in enumerate(series):
        found = {share.factors[first]: share for share in shares if _series(share, others) == name_of_series}
        places = np.array([groups.index(level) for level in found]) + (number - (len(series) - 1) / 2) * width
        values = np.array([100.0 * share.share for share in found.values()])
        ends = 100.0 * np.array([share.interval for share in found.values()]).T
        colour = COLOURS[number % len(COLOURS)]
        axes.bar(places, values, 0.92 * width, color=colour, alpha=0.75, label=name_of_series, zorder=2)
        axes.errorbar(
            places, values, yerr=abs(ends - values), fmt="none", ecolor=INK, elinewidth=1.1, capsize=3, zorder=3
        )
    if chance is not None:
        axes.axhline(100.0 * chance, color=INK, lw=1.0, ls="--", zorder=2.5, gid="chance")
    axes.set_xticks(range(len(groups)), groups)
    axes.grid(axis="y", color=FAINT, alpha=0.25, lw=0.6, zorder=0)
    if others:
        axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=len(series), title=None)
    return canvas.picture()


@drawn_in_style
def psychometric_curves(name: str, found: Sequence[Psychometric]) -> Picture:
    """Fitted functions with the observed shares, whose area goes with the number of answers; up to twelve."""
    shown = found[:MAX_CURVES]
    columns = min(len(shown), _COLUMNS)
    lines = math.ceil(len(shown) / columns)
    canvas = Canvas(name, 60 + columns * 256, 26 + lines * 236)
    for number, function in enumerate(shown):
        line, column = divmod(number, columns)
        axes = canvas.plot(56 + column * 256, 28 + line * 236, 208, 160)
        _curve(axes, function)
        axes.set_title(
            ", ".join([function.participant, *filter(None, [function.track]), *function.factors.values()]), fontsize=9
        )
        axes.set_ylabel("right (%)" if column == 0 else "")
        axes.set_xlabel(NAMES[function.factor] if number + columns >= len(shown) else "")
    return canvas.picture()


@drawn_in_style
def reaction_time_plot(name: str, times: Sequence[ReactionTime]) -> Picture:
    """Median reaction times by the levels of one factor, with their intervals."""
    (factor,) = times[0].factors
    width_px = max(360.0, 110 + 64 * len(times))
    canvas = Canvas(name, width_px, 280)
    axes = canvas.plot(58, 20, width_px - 74, 204, xlabel=NAMES[factor], ylabel="median reaction time (s)")
    medians = np.array([time.median_s for time in times])
    # An end that is open is not drawn.
    ends = np.array([[np.nan if end is None else end for end in time.interval_s] for time in times]).T
    axes.errorbar(
        range(len(times)), medians, yerr=abs(ends - medians), fmt="o", color=COLOURS[0], ecolor=INK, capsize=3
    )
    axes.set_xticks(range(len(times)), [time.factors[factor] for time in times])
    axes.set_xlim(-0.6, len(times) - 0.4)
    axes.set_ylim(0.0, max(1.1 * float(np.nanmax([*ends[1], *medians])), 1e-3))
    axes.grid(axis="y", color=FAINT, alpha=0.25, lw=0.6)
    return canvas.picture()


def _series(share: Share, others: Sequence[str]) -> str:
    return ", ".join(share.factors[factor] for factor in others)


def _curve(axes: Axes, function: Psychometric) -> None:
    fit = function.fit
    levels, of = np.array(fit.levels), np.array(fit.of)
    low, high = levels.min(), levels.max()
    line = np.geomspace(low / 1.3, high * 1.3, 200)
    axes.semilogx(line, 100.0 * fit.share(line), color=COLOURS[0], lw=1.6)
    axes.scatter(
        levels, 100.0 * np.array(fit.right) / of, s=8.0 + 90.0 * of / of.max(), color=COLOURS[1], alpha=0.65, lw=0
    )
    axes.axvline(fit.threshold, color=INK, lw=1.0, ls="--")
    ends = [
        edge if end is None else end for end, edge in zip(fit.threshold_interval, (low / 1.3, high * 1.3), strict=True)
    ]
    axes.axvspan(*ends, color=INK, alpha=0.1, lw=0)
    axes.set_xlim(low / 1.3, high * 1.3)
    axes.set_ylim(-4, 104)
    axes.minorticks_off()
    ticks = levels[evenly_spread(len(levels), 4)]
    axes.set_xticks(ticks, [f"{tick:.2g}" for tick in ticks])
