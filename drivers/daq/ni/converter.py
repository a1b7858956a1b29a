"""The step of a converter: volts that come out as whole counts, and where its range ends."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Calibrated steps differ from the nominal by up to 5 % (USB-621x user manual, table 4-1); far more is no step.
STEP_TOLERANCE = 0.15
# The codes' ends lie so near the range's ends, or their coefficients mean something else.
END_TOLERANCE = 0.2


@dataclass(frozen=True, slots=True)
class CountScale:
    """Counts of one input.

    step_v: Volts per count, > 0.
    lowest, highest: Counts at the ends of the range: a sample there is over range.
    """

    step_v: float
    lowest: int
    highest: int

    def quantise(self, volts: NDArray[np.float64], out: NDArray[np.float32]) -> bool:
        """Write volts as whole counts; returns whether an end of the range was reached.

        volts, float64 (samples,): As the driver scales them; overwritten.
        out, float32 (samples,): The same as whole counts within the range.
        """
        counts = np.divide(volts, self.step_v, out=volts)
        np.rint(counts, out=counts)
        over_range = bool(counts.max() >= self.highest or counts.min() <= self.lowest)
        if over_range:
            np.clip(counts, self.lowest, self.highest, out=counts)
        np.multiply(counts, self.step_v, out=out, casting="same_kind")
        return over_range


def count_scale(range_v: float, bits: int, coefficients: Sequence[float] | None) -> CountScale:
    """The scale of an input from its properties in NI-DAQmx.

    The volts that NI-DAQmx delivers are codes put through a polynomial, the device's calibration. With its linear
    coefficient as the step they come out as whole counts again, up to a constant fraction of a step; the nominal
    step, by some per cent another one, would make noise of it.

    range_v: Range in volts, to either side of 0.
    coefficients: Calibration: volts = c0 + c1 code + c2 code^2 + ...; without it the step is the nominal one.
    """
    codes = 2 ** (bits - 1)
    nominal_v = range_v / codes
    if coefficients is None or len(coefficients) < 2 or not coefficients[1] > 0:
        return CountScale(nominal_v, -codes, codes - 1)
    # Codes of fewer bits may sit at the upper end of a wider word.
    shift = max(0, round(math.log2(nominal_v / coefficients[1])))
    step_v = coefficients[1] * 2**shift
    if abs(step_v / nominal_v - 1) > STEP_TOLERANCE:
        return CountScale(nominal_v, -codes, codes - 1)
    ends = [np.polynomial.polynomial.polyval(code * 2**shift, coefficients) for code in (-codes, codes - 1)]
    inside = math.floor(range_v / step_v + 1e-6)
    lowest, highest = -inside, inside
    if all(abs(abs(end) / range_v - 1) < END_TOLERANCE for end in ends):
        lowest, highest = max(lowest, round(ends[0] / step_v)), min(highest, round(ends[1] / step_v))
    return CountScale(step_v, lowest, highest)
