"""The report of an experiment: pictures of its answers, and one self-contained HTML file that holds them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.number_text import number
from wavefocus.rendering.report.canvas import COLOURS, FAINT, INK, Canvas, Picture, drawn_in_style, html_page
from wavefocus.trials.analysis.psychometric_fit import MAX_LAPSES, Interval
from wavefocus.trials.analysis.results import Analysis, Psychometric
from wavefocus.trials.analysis.statistics import RIGHT, ReactionTime, Share

if TYPE_CHECKING:
    from matplotlib.axes import Axes

NAMES = {
    "speed_mm_s": "speed (mm/s)", "amplitude": "amplitude", "path": "path", "signal": "signal", "plays": "plays"
}  # fmt: skip
MAX_BARS = 36
MAX_CURVES = 12


@drawn_in_style
def _share_bars(name: str, shares: Sequence[Share], what: str, chance: float | None = None) -> Picture:
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
    for index, name_of_series in enumerate(series):
        found = {share.factors[first]: share for share in shares if _series(share, others) == name_of_series}
        places = np.array([groups.index(level) for level in found]) + (index - (len(series) - 1) / 2) * width
        values = np.array([100.0 * share.share for share in found.values()])
        ends = 100.0 * np.array([share.interval for share in found.values()]).T
        colour = COLOURS[index % len(COLOURS)]
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
def _psychometric_curves(name: str, found: Sequence[Psychometric]) -> Picture:
    """Fitted functions with the observed shares, whose area goes with the number of answers; up to twelve."""
    shown = found[:MAX_CURVES]
    columns = min(len(shown), 4)
    lines = math.ceil(len(shown) / columns)
    canvas = Canvas(name, 60 + columns * 256, 26 + lines * 236)
    for index, function in enumerate(shown):
        line, column = divmod(index, columns)
        axes = canvas.plot(56 + column * 256, 28 + line * 236, 208, 160)
        _curve(axes, function)
        title = filter(None, [function.participant, function.track, *function.factors.values()])
        axes.set_title(", ".join(title), fontsize=9)
        axes.set_ylabel("right (%)" if column == 0 else "")
        axes.set_xlabel(NAMES[function.factor] if index + columns >= len(shown) else "")
    return canvas.picture()


@drawn_in_style
def _reaction_time_plot(name: str, times: Sequence[ReactionTime]) -> Picture:
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


MAX_UNFIT = 20
"""Rows that are left out and named one by one."""


class _PageTable(NamedTuple):
    """A table of the report; its first `words` columns are words, the others numbers."""

    head: Sequence[str]
    rows: Sequence[Sequence[str]]
    words: int


class Section(NamedTuple):
    """A section of the report."""

    title: str
    definition: str
    tables: Sequence[_PageTable] = ()
    pictures: Sequence[Picture] = ()
    caption: str = ""


def build_report(analysis: Analysis, facts: Sequence[tuple[str, str]]) -> tuple[str, tuple[Picture, ...]]:
    """Make the page and its pictures.

    facts: Names and values of the last table.
    """
    parts = (_psychometric, _shares, _sensitivity, _confusion, _times, _onsets)
    sections = [section for part in parts for section in part(analysis)]
    html = html_page(
        "analysis.html.jinja", "wavefocus.trials", analysis=analysis, headlines=list(_headlines(analysis)),
        notes=list(_notes(analysis)), sections=sections, facts=facts,
    )  # fmt: skip
    return html, tuple(picture for section in sections for picture in section.pictures)


def left_out_lines(analysis: Analysis) -> list[str]:
    """Sentences about rows that are left out: their number, and the first of them by line and reason."""
    count = len(analysis.left_out)
    if not count:
        return []
    rows = "1 row of trials.csv does" if count == 1 else f"{count} rows of trials.csv do"
    more = [f"{count - MAX_UNFIT} more stand in analysis.json"] if count > MAX_UNFIT else []
    first = [f"line {row.line}, participant {row.participant}: {row.reason}" for row in analysis.left_out[:MAX_UNFIT]]
    return [f"{rows} not fit the experiment and {'is' if count == 1 else 'are'} left out", *first, *more]


def percent(share: float) -> str:
    """A share as per cent with one digit after the point."""
    return f"{100.0 * share:.1f} %"


def _headlines(analysis: Analysis) -> Iterator[str]:
    of = sum(analysis.trials.values())
    people = f"{len(analysis.trials)} participant{'s' if len(analysis.trials) > 1 else ''}"
    yield f"{of} answers of {people}."
    for share in analysis.shares:
        if not share.participant and not share.factors and share.outcome == RIGHT:
            yield f"{share.count} of {share.of} are right: {percent(share.share)} ({_ends(share)})."


def _notes(analysis: Analysis) -> Iterator[str]:
    yield from left_out_lines(analysis)
    if len(analysis.trials) > 1:
        yield (
            "Intervals of all participants together take each answer as independent of the others. Where participants"
            " differ, they are too narrow: see those of each participant, or fit a mixed model to trials.csv."
        )
    for what, digests in (("banks", analysis.banks), ("trials files", analysis.tables)):
        if len(digests) > 1:
            yield f"The answers belong to {len(digests)} different {what}; they are pooled all the same."
    if any(function.track for function in analysis.psychometric):
        yield "Levels followed the answers: shares and d′ by level come from few trials, and are no random sample."
    if len(analysis.psychometric) > MAX_CURVES:
        yield f"The first {MAX_CURVES} of {len(analysis.psychometric)} psychometric functions are drawn."


def _shares(analysis: Analysis) -> Iterator[Section]:
    pooled: dict[tuple[tuple[str, ...], str], list[Share]] = {}
    for share in analysis.shares:
        if not share.participant and share.factors:
            pooled.setdefault((tuple(share.factors), share.outcome), []).append(share)
    right = any(share.outcome == RIGHT for share in analysis.shares)
    definition = "95 % interval: Wilson's score interval."
    drawn = _drawn(pooled)
    for (factors, outcome), shares in sorted(pooled.items(), key=lambda item: item[0] not in drawn):
        if len(shares) > 3 * MAX_BARS:
            continue
        what = "right answers" if outcome == RIGHT else f"answers “{outcome}”"
        pictures, caption = [], ""
        if (factors, outcome) in drawn:
            chance = 1.0 / len(analysis.answers) if outcome == RIGHT else None
            pictures = [_share_bars(_name(factors, outcome), shares, what, chance)]
            caption = f"Share of {what}, all participants together, with 95 % intervals."
            if chance is not None:
                caption += f" Dashed: chance, 1 of {len(analysis.answers)} answers."
        rows = [[*share.factors.values(), *_counted(share)] for share in shares]
        head = [*(NAMES[factor] for factor in factors), "right" if right else "answers", "of", "share", "95 % interval"]
        title = f"{what[0].upper()}{what[1:]} by {' and '.join(NAMES[factor] for factor in factors)}"
        yield Section(title, definition, [_PageTable(head, rows, len(factors))], pictures, caption)
    own = [share for share in analysis.shares if share.participant and not share.factors]
    rows = [[share.participant, *([] if right else [share.outcome]), *_counted(share)] for share in own]
    counted = ["right"] if right else ["answer", "answers"]
    table = _PageTable(["participant", *counted, "of", "share", "95 % interval"], rows, 1 if right else 2)
    yield Section("Participants", f"{definition} The shares of each by factor are in analysis.json.", [table])


def _drawn(pooled: Mapping[tuple[tuple[str, ...], str], Sequence[Share]]) -> set[tuple[tuple[str, ...], str]]:
    """Tables that are drawn: pairs of factors; single ones where there are no pairs."""
    fit = [key for key, shares in pooled.items() if len(shares) <= MAX_BARS]
    pairs = {key for key in fit if len(key[0]) == 2}
    return pairs or set(fit)


def _sensitivity(analysis: Analysis) -> Iterator[Section]:
    if not analysis.sensitivities:
        return
    first = analysis.sensitivities[0]
    rows = [
        [group.participant or "all", _levels(group.factors) or "all", f"{group.hits} of {group.of_signal}",
         f"{group.false_alarms} of {group.of_noise}", _signed(group.d_prime), _interval(group.interval),
         _signed(group.criterion)]
        for group in analysis.sensitivities if not (group.participant and group.factors)
    ]  # fmt: skip
    head = ["participant", "trials", "hits", "false alarms", "d′", "95 % interval", "criterion c"]
    yield Section(
        "Sensitivity",
        f"Hit: the answer “{first.signal}” where it is right; false alarm: the same answer where “{first.noise}” is. "
        "d′ = z(H) − z(F), c = −(z(H) + z(F)) / 2, log-linear correction (Hautus 1995); interval by the variance of"
        " Gourevitch and Galanter (1967). With all answers right, d′ is a lower bound that grows with the trials.",
        [_PageTable(head, rows, 2)],
    )


def _confusion(analysis: Analysis) -> Iterator[Section]:
    # With two answers, hits and false alarms are the whole confusion matrix.
    if len(analysis.answers) < 3 or not analysis.confusions:
        return
    tables = []
    for matrix in analysis.confusions:
        of = [sum(row) for row in matrix.counts]
        rows = [
            [right, *(f"{count} ({percent(count / total)})" if total else "-" for count in row), str(total)]
            for right, row, total in zip(analysis.answers, matrix.counts, of, strict=True)
        ]
        head = [f"right: {matrix.participant or 'all participants'}", *analysis.answers, "trials"]
        tables.append(_PageTable(head, rows, 1))
    yield Section(
        "Confusion matrix", "Rows: the right answer. Columns: the answer given, with its share of the row.", tables
    )


_UNRESOLVED = (
    " * steeper than the levels can resolve: the answers do not exclude a step between two levels, and the slope is a"
    " lower bound; use levels that are closer together, or more trials."
)


def _psychometric(analysis: Analysis) -> Iterator[Section]:
    if not analysis.psychometric:
        return
    resolved = all(function.fit.slope_resolved for function in analysis.psychometric)
    staircase = any(function.reversals_threshold is not None for function in analysis.psychometric)
    rows = [
        [function.participant, function.track or _levels(function.factors) or "all", number(function.fit.threshold),
         _interval(function.fit.threshold_interval),
         number(function.fit.slope) + ("" if function.fit.slope_resolved else " *"),
         _interval(function.fit.slope_interval),
         percent(function.fit.guess), percent(function.fit.lapse),
         f"{function.fit.deviance:.1f} ({function.fit.deviance_p:.3f})",
         *([number(function.reversals_threshold)] if staircase else [])]
        for function in analysis.psychometric
    ]  # fmt: skip
    head = [
        "participant",
        "trials",
        "threshold",
        "95 % interval",
        "slope per decade",
        "95 % interval",
        "guess",
        "lapse",
    ]
    head += ["deviance (p)", *(["threshold by reversals"] if staircase else [])]
    factor = NAMES[analysis.psychometric[0].factor]
    yield Section(
        f"Psychometric functions of {factor}",
        "p = guess + (1 − guess − lapse) / (1 + exp(−slope (x − threshold))), x = log10 of the level; the threshold is"
        " given as a level. Maximum of the likelihood with Firth's penalty; guess held, lapse fitted between 0 and"
        f" {percent(MAX_LAPSES)}. Intervals: profile likelihood, chi-square limit. p of the deviance: by chi-square;"
        " below 0.05 the function does not describe the answers."
        + ("" if resolved else _UNRESOLVED)
        + (" By reversals: geometric mean of the levels at the last reversals." if staircase else ""),
        [_PageTable(head, rows, 2)],
        [_psychometric_curves("psychometric", analysis.psychometric)],
        "Circles: observed shares, larger with more answers. Line: fitted function. Dashed: threshold; shaded: its"
        " 95 % interval.",
    )


def _times(analysis: Analysis) -> Iterator[Section]:
    rows = [
        [time.participant or "all", _levels(time.factors) or "all", str(time.of), number(time.median_s, "s"),
         _interval(time.interval_s, "s")]
        for time in analysis.reaction_times if not (time.participant and time.factors)
    ]  # fmt: skip
    by_factor = [time for time in analysis.reaction_times if not time.participant and time.factors]
    first = tuple(by_factor[0].factors) if by_factor else ()
    drawn = [time for time in by_factor if tuple(time.factors) == first]
    pictures = [_reaction_time_plot("reaction-times", drawn)] if 1 < len(drawn) <= MAX_BARS else []
    yield Section(
        "Reaction times",
        "From the onset of the last presentation, as the recorder's loopback shows it, to the answer; of right answers"
        " where there are right ones. Interval of the median: by order statistics.",
        [_PageTable(["participant", "trials", "of", "median", "95 % interval"], rows, 2)],
        pictures, "Median reaction time, all participants together, with 95 % intervals.",
    )  # fmt: skip


def _onsets(analysis: Analysis) -> Iterator[Section]:
    found = analysis.onset_errors
    if found is None:
        return
    values = (found.median_ms, found.low_ms, found.high_ms, found.largest_ms)
    row = [str(found.of), *(number(value, "ms") for value in values), str(found.repeated), str(analysis.replays)]
    head = ["of", "median", "2.5 %", "97.5 %", "largest magnitude", "trials repeated", "replays asked for"]
    yield Section(
        "Onsets of the stimuli",
        "Onset by the recorder's loopback minus the onset by the request to play and the player's stated latency."
        " Reaction times begin at the former, so that this error is not in them. Repeated: presented anew since an"
        " instrument was lost or the onset was not found.",
        [_PageTable(head, [row], 0)],
    )


def _levels(factors: Mapping[str, str]) -> str:
    return ", ".join(f"{NAMES[factor].partition(' (')[0]} {level}" for factor, level in factors.items())


def _counted(share: Share) -> list[str]:
    return [str(share.count), str(share.of), percent(share.share), _ends(share)]


def _ends(share: Share) -> str:
    return f"{100.0 * share.interval[0]:.1f} to {percent(share.interval[1])}"


def _interval(ends: Interval, unit: str = "") -> str:
    low, high = ends
    return f"{'open' if low is None else number(low)} to {'open' if high is None else number(high)} {unit}".rstrip()


def _signed(value: float) -> str:
    """Two digits after the point, without a sign of zero."""
    return f"{round(value, 2) + 0.0:.2f}".replace("-", "\N{MINUS SIGN}")


def _name(factors: Sequence[str], outcome: str) -> str:
    """File name of a picture: letters, digits and hyphens."""
    words = "-".join([outcome, *factors]).casefold()
    return "".join(letter if letter.isascii() and letter.isalnum() else "-" for letter in words)
