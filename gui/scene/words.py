"""A scene in words: what a source is, its figures, and what is the matter."""

from __future__ import annotations

from gui.scene.draft import PolylineDraft, SourceDraft, TextDraft
from gui.scene.live import Drawn
from gui.scene.surface.trace import Trace


def name_of(source: SourceDraft) -> str:
    """A source in a word or two."""
    path = source.path
    if isinstance(path, TextDraft):
        return f"text “{path.string}”"
    if isinstance(path, PolylineDraft):
        return f"{'closed ' if path.closed else ''}polyline of {len(path.points_mm)}"
    return "drawing" if path.kind == "svg" else path.kind


def title_of(source: SourceDraft, trace: Trace | None) -> str:
    """A source in a line."""
    words = [name_of(source), source.signal.kind]
    if trace is not None and trace.length_mm > 0:
        words.insert(1, f"{trace.length_mm:.0f} mm")
    if source.start_s:
        words.append(f"from {source.start_s:g} s")
    return ", ".join(words)


def figures_of(trace: Trace) -> str:
    """A source's figures in a sentence."""
    if trace.problem or not trace.points:
        return ""
    lasts = duration(trace.lasts_s)
    if trace.points == 1 and not trace.length_mm:
        return f"Stands still, emits for {lasts}"
    points = f"{trace.points} point{'s' if trace.points > 1 else ''}, one every {duration(trace.period_s)}"
    return f"{trace.length_mm:.4g} mm, {points}; emits for {lasts}"


def duration(seconds: float) -> str:
    """A time with a unit that suits it."""
    if 0 < seconds < 1e-3:
        return f"{seconds * 1e6:.3g} µs"
    return f"{seconds * 1e3:.4g} ms" if 0 < seconds < 1 else f"{seconds:.4g} s"


def trouble_of(drawn: Drawn) -> str:
    """What is the matter with a scene, in a sentence; empty where nothing is."""
    if not drawn.draft.sources:
        return ""
    if drawn.problem:
        return drawn.problem
    ground, told = drawn.ground, []
    if ground.grid is None or ground.surface is None:
        return ""
    for index, trace in enumerate(drawn.traces):
        off, drawn_points = int(trace.off.sum()), len(trace.points_mm)
        if not off:
            continue
        share = f"{off} of {drawn_points}" if drawn_points == trace.points else f"{off / drawn_points:.0%} of its"
        reach = f"off the grid, over {ground.grid.spacing_mm:.3g} mm from every position"
        where = reach if trace.far else "where nothing is measured"
        told.append(f"source {index}: {share} points (crosses) lie {where}: move the path, or measure there")
    return "; ".join(told[:2]) + (f"; and {len(told) - 2} more" if len(told) > 2 else "")
