"""A source's course in time: places and amplitudes at samples, linear between them."""

from dataclasses import dataclass

import numpy as np

from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.storage.errors import InputError

FURTHEST_MM = 1e100
"""Places beyond have no differences within the range of numbers."""
LATEST_SAMPLE = 2**53
"""Beyond, float64 does not count samples one by one."""


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Knots of a course; the same samples give the same places to the bit, whichever other knots there are.

    sample, int64 (knots,): When, rising, at most 2**53 from 0.
    at_mm, float64 (knots, 2): Where, in millimetres.
    amplitude, float64 (knots,): Factor on the signal.

    Raises InputError: there is no knot, the arrays differ in length, samples do not rise, or a value is not finite.
    """

    sample: Int64Array
    at_mm: Float64Array
    amplitude: Float64Array

    def __post_init__(self) -> None:
        knots = len(self.sample)
        if not knots or self.at_mm.shape != (knots, 2) or self.amplitude.shape != (knots,):
            raise InputError(
                f"a trajectory has {knots} samples, places of shape {self.at_mm.shape} and {len(self.amplitude)}"
                " amplitudes; the same number of each is needed, at least one"
            )
        if not (np.isfinite(self.amplitude).all() and (np.abs(self.at_mm) <= FURTHEST_MM).all()):
            raise InputError(f"a trajectory has a value that is not finite, or beyond {FURTHEST_MM:g} mm")
        if (self.sample[1:] <= self.sample[:-1]).any() or max(-self.sample[0], self.sample[-1]) > LATEST_SAMPLE:
            raise InputError(f"the samples of a trajectory must rise, and lie within {LATEST_SAMPLE} of 0")

    def at(self, sample: Int64Array) -> tuple[Float64Array, Float64Array]:
        """Place and amplitude at samples; those of the first knot before it, those of the last one after it.

        sample, int64 (n,): When.

        Returns places, float64 (n, 2), in millimetres; amplitudes, float64 (n,).
        """
        # A source that rests does not move by rounding: the slope is 0.
        x_mm, y_mm = (np.interp(sample, self.sample, along) for along in self.at_mm.T)
        return np.stack([x_mm, y_mm]).T, np.interp(sample, self.sample, self.amplitude)
