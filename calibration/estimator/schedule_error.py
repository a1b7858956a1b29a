"""What error a schedule will leave, and how long responses ring, before a campaign."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.errors import InputError

Float64Array = NDArray[np.float64]

# A cubic term changes the gain of what sounds together with power P by three times its coefficient times P, and puts
# the rest of its energy between all that sounds, six times its coefficient squared times P cubed (a sum of many
# sweeps is like a Gaussian signal). Of one actuator alone, swept through whatever resonances, it is this share of
# the term's energy that lands in the response (measured: 24 modes, and the virtual plate).
CUBIC_OF_ONE = 1.3


@dataclass(frozen=True, slots=True)
class Method:
    """How a position is measured, as far as its error goes.

    sounding_s: How long the sweep of each actuator sounds in all records of a position together, > 0.
    together: How many actuators sound at once, >= 1.
    window_s: Time on which what is unlike any response spreads: the period, or a sweep with its silence, > 0.

    Raises InputError: a value outside the range above.
    """

    sounding_s: float
    together: int
    window_s: float

    def __post_init__(self) -> None:
        for name in ("sounding_s", "together", "window_s"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value:g}; allowed is a finite number above 0")


@dataclass(frozen=True, slots=True)
class Noise:
    """What is wrong with the response, seen at one actuator that sounds alone, over its rms while it sounds.

    additive_db: White noise (0 to half the sample rate) that is always there; -inf for none.
    proportional_db: White noise that grows with all that sounds, over that; -inf for none.
    cubic_db: Rms of a cubic term of the response; -inf for none.
    sixth_moment: Mean sixth power of that response over the cube of its mean square, which says how peaked it is: 2.5
        for a sweep that is equally loud everywhere, 3 on a plate that rings as little as the paper's, 15 where it is a
        row of resonances.
    """

    additive_db: float = -math.inf
    proportional_db: float = -math.inf
    cubic_db: float = -math.inf
    sixth_moment: float = 3.0


@dataclass(frozen=True, slots=True)
class ExpectedError:
    """Expected relative L2 error in band of a typical Green's function, and what it comes from, all in dB."""

    total_db: float
    additive_db: float
    proportional_db: float
    cubic_db: float


def expected_error(
    method: Method,
    noise: Noise,
    *,
    band_hz: tuple[float, float],
    sample_rate_hz: float,
    taps: int,
    loudness: float | None = None,
    effective: float | None = None,
) -> ExpectedError:
    """Predict the error of a schedule; within 1.5 dB of what is measured on the virtual rig.

    A causal FIR of T seconds has about 2 W T + 2 ln(2 pi W T) degrees of freedom in a band of W Hz. White
    noise leaves so many times its own energy per sample; the response has the energy of all samples in
    which its sweep sounded. Noise that grows with the response grows with all actuators that sound together. A
    cubic term grows with the square of that power, and no repetition averages it.

    method: How a position is measured.
    noise: What is wrong with the response.
    band_hz: Band of the sweep in Hz.
    sample_rate_hz: Rate in Hz.
    taps: Length L of the FIRs.
    loudness: Energy of the responses of all actuators that sound together over that of this one, >= 1; by default that
        of actuators that are alike.
    effective: How many actuators make up what sounds together: the square of the sum of their responses' energies
        over the sum of the squares; by default all of them.

    Returns ExpectedError. Raises InputError: a band or a length that cannot be.
    """
    low, high = band_hz
    if not 0 <= low < high <= sample_rate_hz / 2:
        raise InputError(f"band_hz is {low:g} to {high:g}; allowed is 0 <= low < high <= {sample_rate_hz / 2:g}")
    if taps < 1:
        raise InputError(f"taps is {taps}; allowed is 1 or more")
    length_s = taps / sample_rate_hz
    share = degrees_of_freedom(band_hz, length_s) / (method.sounding_s * sample_rate_hz)
    loud = float(method.together) if loudness is None else loudness
    additive = _energy(noise.additive_db) * share
    proportional = _energy(noise.proportional_db) * loud * share
    # Of one sweep there is nothing between what sounds.
    mixed = 1 - 1 / (method.together if effective is None else max(effective, 1.0))
    shared = 6 * loud**3 * mixed * length_s / method.window_s
    cubic = _energy(noise.cubic_db) * (CUBIC_OF_ONE + (9 * loud * (loud - 1) + shared) / noise.sixth_moment)
    return ExpectedError(_db(additive + proportional + cubic), _db(additive), _db(proportional), _db(cubic))


def degrees_of_freedom(band_hz: tuple[float, float], length_s: float) -> float:
    """How many numbers a causal response of some length has to say in a band.

    band_hz: Lowest and highest frequency in Hz.
    length_s: Length in seconds.
    """
    held = (band_hz[1] - band_hz[0]) * length_s
    return 2 * held + 2 * math.log(max(2 * math.pi * held, 1.0))


def _energy(level_db: float) -> float:
    return float(10.0 ** (level_db / 10))


def _db(energy: float) -> float:
    return 10 * math.log10(energy) if energy > 0 else -math.inf


# Staggered responses come apart when each is over before the next begins; measured, with half of it to spare.
STAGGER_OVER_RESPONSE = 1.2
# What the taps cut off may add this much to the error of an estimate: as much as its noise at -60 dB.
TAIL_DB = -60.0
# The energy is looked at in so many blocks.
BLOCKS = 50
# A decay is fitted after the response has fallen by this, over at least as many blocks.
FALLEN_DB = -6.0
LEAST_BLOCKS = 5
# The response must fall by so much before noise or the last tap hides it.
LEAST_FALL_DB = 15.0


@dataclass(frozen=True, slots=True)
class Decay:
    """How the energy of a position's responses falls.

    rate_db_s: Fall of the energy in dB per second, late in the response, > 0.
    tail_db_at_0: Where that line would begin: energy left at time 0 over all energy.
    floor_db: Energy of the noise in all taps over that of the response.
    sample_rate_hz: Rate in Hz.
    """

    rate_db_s: float
    tail_db_at_0: float
    floor_db: float
    sample_rate_hz: float

    def response_s(self, tail_db: float = TAIL_DB) -> float:
        """Seconds after which less than `tail_db` of the energy is left."""
        return max((self.tail_db_at_0 - tail_db) / self.rate_db_s, 1 / self.sample_rate_hz)

    def needed_taps(self, tail_db: float = TAIL_DB) -> int:
        """Taps that leave less than `tail_db` of the energy out."""
        return math.ceil(self.response_s(tail_db) * self.sample_rate_hz - 1e-9)

    def needed_stagger_s(self, tail_db: float = TAIL_DB) -> float:
        """Shortest stagger in seconds that keeps such responses apart."""
        return STAGGER_OVER_RESPONSE * self.response_s(tail_db)

    def require(self, taps: int, stagger_s: float | None = None, *, tail_db: float = TAIL_DB) -> None:
        """Refuse taps, and a stagger, that are too short for what was measured.

        taps: Taps of the Green's functions.
        stagger_s: Stagger in seconds, where actuators sound together.
        tail_db: Energy that may be cut off, in dB of all.

        Raises InputError: they are too short; the message says what is needed.
        """
        needed = self.needed_taps(tail_db)
        if taps < needed:
            raise InputError(
                f"taps is {taps}; the measured responses need at least {needed} (they fall by {self.rate_db_s:.0f} dB "
                f"a second and are {tail_db:g} dB down after {self.response_s(tail_db):.3g} s)"
            )
        shortest_s = self.needed_stagger_s(tail_db)
        if stagger_s is not None and stagger_s < shortest_s:
            raise InputError(
                f"stagger_s is {stagger_s:g}; the measured responses need at least {shortest_s:.3g} "
                f"({STAGGER_OVER_RESPONSE} times the {self.response_s(tail_db):.3g} s after which they are "
                f"{tail_db:g} dB down)"
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
    if fall_db < LEAST_FALL_DB:
        raise InputError(
            f"the responses fall by {max(fall_db, 0):.0f} dB before noise or their last tap hides them; "
            f"{LEAST_FALL_DB:g} dB are needed to measure their decay: record a longer silence or more sweeps"
        )
    block_s = block / sample_rate_hz
    whole = max(float(blocks.sum()) - BLOCKS * math.exp(floor), 1e-300)
    tail = math.exp(level) / (rate * block_s)
    return Decay(
        rate_db_s=10 / math.log(10) * rate,
        tail_db_at_0=10 * math.log10(tail / whole),
        floor_db=10 * math.log10(BLOCKS * math.exp(floor) / whole),
        sample_rate_hz=sample_rate_hz,
    )


def _first_fallen(blocks: Float64Array) -> int:
    """First block after which the energy stays below its highest by `FALLEN_DB`, leaving enough for a fit."""
    above = np.flatnonzero(blocks > 10 ** (FALLEN_DB / 10) * blocks.max())
    return min(int(above[-1]) + 1, BLOCKS - 2 * LEAST_BLOCKS)


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
    rate, level, floor = (float(one) for one in best.x)
    return rate, level, floor
