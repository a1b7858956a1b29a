"""What error a schedule will leave, before anything is played."""

from __future__ import annotations

import math
from dataclasses import dataclass

from storage.errors import InputError

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
