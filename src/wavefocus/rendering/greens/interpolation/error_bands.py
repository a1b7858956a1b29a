"""Errors of an interpolation by frequency, and what a method was chosen from."""

from __future__ import annotations

from dataclasses import dataclass

from wavefocus.rendering.arrays import Float64Array


@dataclass(frozen=True, slots=True)
class ErrorBands:
    """Relative errors at some points, by band.

    frequency_hz, float64 (bands,): Centres of bands, ascending.
    median, worst, float64 (bands,): Over the points.
    power, float64 (bands,): Mean power of the bank's rows there, up to a factor.
    kernel, float64 (bands,): Median error of "kernel"; infinite where it may be no better.
    """

    frequency_hz: Float64Array
    median: Float64Array
    worst: Float64Array
    power: Float64Array
    kernel: Float64Array


@dataclass(frozen=True, slots=True)
class InterpolationChoice:
    """What "auto" has chosen from.

    judged_by: ``"check positions"``, ``"left-out positions"``, or ``"nothing"`` where the grid does not resolve the
        waves and the bank has no check positions: then it is "waves" where they can be modelled, else "kernel".
    errors: Expected error of each method in the scene's band, by name; NaN where it cannot be judged.
    unsuited: Why other methods cannot be used, by name.
    """

    judged_by: str
    errors: dict[str, float]
    unsuited: dict[str, str]
