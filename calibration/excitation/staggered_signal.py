"""What plays when several actuators sound at once: one periodic sweep, each actuator a stagger after the one before."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calibration.excitation.sweeps import Excitation
from storage.errors import InputError
from storage.raw.schedule import EMPTY, Schedule, staggered

Float64Array = NDArray[np.float64]

# A record is longer than its periods by this share, twice what the fastest clock allowed takes.
MARGIN_SHARE = 1e-3


@dataclass(frozen=True, slots=True)
class StaggeredSignal:
    """The records of a position in which all actuators, or a group of them, sound at once.

    The base signal is one linear sweep through the band that lasts a whole period; slot k of a record plays it
    k staggers later, round the period. It must have been running for one response before what is
    recorded counts.

    sweep: Rate, band, amplitude and fades; its length, silence and averages do not matter.
    actuators: How many, >= 1.
    taps: Length L of the responses, at most a stagger.
    stagger_samples: Delay from slot to slot, >= 1.
    groups: Records of a position, 1 to `actuators`.
    periods: Periods of a record that count, >= 1.

    Raises InputError: a value outside the range above, or a period too short for its band.
    """

    sweep: Excitation
    actuators: int
    taps: int
    stagger_samples: int
    groups: int = 1
    periods: int = 1

    def __post_init__(self) -> None:
        if not 1 <= self.groups <= self.actuators:
            raise InputError(
                f"capture groups is {self.groups}; allowed is 1 to the number of actuators, {self.actuators}"
            )
        if self.periods < 1:
            raise InputError(f"capture periods is {self.periods}; allowed is 1 or more")
        if not 1 <= self.taps <= self.stagger_samples:
            raise InputError(f"taps is {self.taps}; allowed is 1 to a stagger, {self.stagger_samples} samples")
        self.period_sweep()

    @property
    def slots(self) -> int:
        """Actuators that sound at once, at most."""
        return -(-self.actuators // self.groups)

    @property
    def period_samples(self) -> int:
        """Samples of a period on the playback clock."""
        return self.slots * self.stagger_samples

    @property
    def used_samples(self) -> int:
        """Samples of a record that count: its periods, and a little more whatever the clocks do."""
        return self.periods * self.period_samples + math.ceil(MARGIN_SHARE * self.periods * self.period_samples)

    def period_sweep(self) -> Excitation:
        """One sweep as long as the period, without silence."""
        sweep = self.sweep
        return Excitation(
            sweep.sample_rate_hz,
            sweep.start_hz,
            sweep.stop_hz,
            self.period_samples / sweep.sample_rate_hz,
            0.0,
            sweep.amplitude_v,
            1,
            sweep.fade_s,
        )

    def base_v(self) -> Float64Array:
        """One period of the base signal in volts, shape (period_samples,)."""
        return self.period_sweep().base_v()

    def schedule(self) -> Schedule:
        """What plays when in the records of a position."""
        return staggered(self.actuators, self.stagger_samples / self.sweep.sample_rate_hz, self.groups)

    def played_v(self, lead_samples: int) -> list[tuple[Float64Array, dict[int, Float64Array]]]:
        """What each record plays, as if it had always been running.

        lead_samples: Samples before those that count: the player's latency and the time in which responses build up.

        Returns list of (float64 array, dict from actuator to float64 array), each of shape (lead + used,): the base
        signal for the loopback, and each actuator's signal, in volts.
        """
        base = self.base_v()
        schedule = self.schedule()
        length = lead_samples + self.used_samples
        slots_v = [np.resize(np.roll(base, slot * self.stagger_samples), length) for slot in range(self.slots)]
        return [
            (slots_v[0], {int(one): slots_v[slot] for slot, one in enumerate(row) if one != EMPTY})
            for row in schedule.actuator
        ]
