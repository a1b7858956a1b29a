"""How long responses ring, and how many numbers describe one."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration import Float64Array
from wavefocus.storage.errors import InputError


def degrees_of_freedom(band_hz: tuple[float, float], length_s: float) -> float:
    """How many numbers a causal response of some length has to say in a band.

    band_hz: Lowest and highest frequency in Hz.
    length_s: Length in seconds.
    """
    held = (band_hz[1] - band_hz[0]) * length_s
    return 2 * held + 2 * math.log(max(2 * math.pi * held, 1.0))


# What the taps cut off may add this much to the error of an estimate: as much as its noise at -60 dB.
TAIL_DB = -60.0
# The energy is looked at in so many blocks.
BLOCKS = 50
# A decay is fitted after the response has fallen by this, over at least as many blocks.
FALLEN_DB = -6.0
MIN_BLOCKS = 5
# The response must fall by so much before noise or the last tap hides it.
MIN_FALL_DB = 15.0


@dataclass(frozen=True, slots=True)
class Decay:
    """How the energy of a position's responses falls.

    rate_db_s: Fall of the energy in dB per second, late in the response, > 0.
    tail_db_at_0: Where that line would begin: energy left at time 0 over all energy.
    sample_rate_hz: Rate in Hz.
    """

    rate_db_s: float
    tail_db_at_0: float
    sample_rate_hz: float

    @property
    def response_s(self) -> float:
        """Seconds after which less than `TAIL_DB` of the energy is left."""
        return max((self.tail_db_at_0 - TAIL_DB) / self.rate_db_s, 1 / self.sample_rate_hz)

    @property
    def needed_taps(self) -> int:
        """Taps that leave less than `TAIL_DB` of the energy out."""
        return math.ceil(self.response_s * self.sample_rate_hz - 1e-9)

    def require(self, taps: int) -> None:
        """Refuse taps that are too few for the measured responses: InputError names the number needed."""
        if taps < self.needed_taps:
            raise InputError(
                f"taps is {taps}; the measured responses need at least {self.needed_taps} (they fall by "
                f"{self.rate_db_s:.0f} dB a second and are {TAIL_DB:g} dB down after {self.response_s:.3g} s)"
            )


def measure_decay(green: NDArray[np.floating], sample_rate_hz: float) -> Decay:
    """Measure the decay of responses that were estimated with as many taps as the recording allows.

    green, (..., taps): FIRs of some actuators at one or more positions; longer than the responses, if possible.
    sample_rate_hz: Rate in Hz, > 0.

    Returns Decay: of all of them together, which is that of those that ring longest. Raises InputError: too few taps,
    zeros, values that are not finite, or a response that noise or the last tap hides before it has fallen far enough
    for a fit.
    """
    taps = green.shape[-1]
    if taps < 2 * BLOCKS:
        raise InputError(f"the responses have {taps} taps; at least {2 * BLOCKS} are needed to measure their decay")
    energy = np.square(green.astype(np.float64)).reshape(-1, taps).sum(axis=0)
    if not np.isfinite(energy).all() or not energy.any():
        raise InputError("the responses are zeros or not finite; measured ones are needed to measure their decay")
    block = taps // BLOCKS
    blocks = energy[: block * BLOCKS].reshape(BLOCKS, block).sum(axis=1)
    start = _first_fallen(blocks)
    place = (np.arange(start, BLOCKS) + 0.5) * block / sample_rate_hz
    late = np.log(np.maximum(blocks[start:], 1e-300))
    rate, level, floor = _fitted(place, late)
    # Energy per block that the exponential still has, summed from time 0 and from the last block on.
    fall_db = 10 / math.log(10) * (level - rate * place[0] - max(floor, level - rate * place[-1]))
    if fall_db < MIN_FALL_DB:
        raise InputError(
            f"the responses fall by {max(fall_db, 0):.0f} dB before noise or their last tap hides them; "
            f"{MIN_FALL_DB:g} dB are needed to measure their decay: record a longer silence or more sweeps"
        )
    block_s = block / sample_rate_hz
    whole = max(float(blocks.sum()) - BLOCKS * math.exp(floor), 1e-300)
    tail = math.exp(level) / (rate * block_s)
    return Decay(
        rate_db_s=10 / math.log(10) * rate,
        tail_db_at_0=10 * math.log10(tail / whole),
        sample_rate_hz=sample_rate_hz,
    )


def _first_fallen(blocks: Float64Array) -> int:
    """First block after which the energy stays below its highest by `FALLEN_DB`, leaving enough for a fit."""
    above = np.flatnonzero(blocks > 10 ** (FALLEN_DB / 10) * blocks.max())
    return min(int(above[-1]) + 1, BLOCKS - 2 * MIN_BLOCKS)


def _fitted(place: Float64Array, late: Float64Array) -> tuple[float, float, float]:
    """Rate, logarithm at time 0, and logarithm of the floor of an exponential decay into noise."""
    import scipy.optimize  # slow to load; only the trial before a staggered campaign fits a decay

    span = place[-1] - place[0]
    slope = (late[0] - late.min()) / span

    def misfit(parameters: Float64Array) -> Float64Array:
        rate, level, floor = parameters
        return np.asarray(np.logaddexp(level - rate * place, floor) - late)

    best = None
    # The noise may take over early, late or never.
    for share in (1.0, 2.0, 4.0):
        first = np.array([share * slope, late[0] + share * slope * place[0], late.min()])
        bounds = ([1e-3 / span, -np.inf, late.min() - 23], [1e4 / span, np.inf, np.inf])
        found = scipy.optimize.least_squares(misfit, np.clip(first, *bounds), bounds=bounds, loss="soft_l1")
        if best is None or found.cost < best.cost:
            best = found
    assert best is not None
    rate, level, floor = (float(parameter) for parameter in best.x)
    return rate, level, floor
