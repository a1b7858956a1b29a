"""The psychometric function, of which adaptive tracks, the analysis and simulated participants take one definition."""

import numpy as np
from numpy.typing import ArrayLike, NDArray


def share_right(
    level: ArrayLike, threshold: ArrayLike, slope: ArrayLike, guess: ArrayLike, lapse: ArrayLike
) -> NDArray[np.float64]:
    """Share of right answers: a logistic function, p = guess + (1 - guess - lapse) / (1 + exp(-slope (x - threshold))).

    level: x, the common logarithm of the stimulus's level.
    threshold: The x at which p lies midway between guess and 1 - lapse.
    slope: Per unit of x, so per decade of the level; negative where higher levels are harder.
    guess, lapse: Share of right answers without a stimulus, and of slips with any.

    All broadcast. Source: Wichmann and Hill, Percept. Psychophys. 63 (2001), 1293, equation 1.
    """
    x, midway, steepness, low, slips = (
        np.asarray(value, np.float64) for value in (level, threshold, slope, guess, lapse)
    )
    # The hyperbolic tangent does not overflow.
    shares: NDArray[np.float64] = low + (1.0 - low - slips) * 0.5 * (1.0 + np.tanh(0.5 * steepness * (x - midway)))
    return shares
