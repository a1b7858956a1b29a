"""What plays when in the records of a position."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.errors import InputError

Int32Array = NDArray[np.int32]
Float64Array = NDArray[np.float64]

EMPTY = -1


@dataclass(frozen=True, slots=True, eq=False)
class Schedule:
    """Which actuators each record drives, with the base signal how much delayed and how strong.

    Out of range, InputError; also where a record plays nothing or an actuator twice, or where no record plays an
    actuator below the highest.

    actuator, int32 (records, slots): Actuators from 0; -1 is an empty slot.
    delay_s, float64 (records, slots): Delay of each slot against the base signal in seconds on the playback clock, >=
        0.
    gain, float64 (records, slots): Drive volts of each slot per volt of the base signal, not 0.
    period_s: Period of the base signal on the playback clock, which is then already running when a record starts; 0
        where each record begins and ends in silence.
    """

    actuator: Int32Array
    delay_s: Float64Array
    gain: Float64Array
    period_s: float = 0.0

    def __post_init__(self) -> None:
        kinds: dict[str, type] = {"actuator": np.int32, "delay_s": np.float64, "gain": np.float64}
        for name, kind in kinds.items():
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), kind))
        if self.actuator.ndim != 2 or not self.actuator.size:
            raise InputError(f"/schedule/actuator has shape {self.actuator.shape}; (record, slot) is needed")
        for name in ("delay_s", "gain"):
            if getattr(self, name).shape != self.actuator.shape:
                shape = getattr(self, name).shape
                raise InputError(f"/schedule/{name} has shape {shape}; that of /schedule/actuator is needed")
        if not (np.isfinite(self.period_s) and self.period_s >= 0):
            raise InputError(f"period_s is {self.period_s:g}; 0 or a period in seconds is needed")
        if self.actuator.min() < EMPTY:
            raise InputError(f"/schedule/actuator holds {self.actuator.min()}; actuators from 0, or -1, are needed")
        driven = self.actuator != EMPTY
        if not driven.any(axis=1).all():
            silent = int(np.flatnonzero(~driven.any(axis=1))[0])
            raise InputError(f"/schedule/actuator plays nothing in record {silent}; at least one actuator is needed")
        for record, row in enumerate(self.actuator):
            played, times = np.unique(row[row != EMPTY], return_counts=True)
            if times.max() > 1:
                twice = int(played[times > 1][0])
                raise InputError(f"/schedule/actuator plays actuator {twice} twice in record {record}; once is allowed")
        missing = np.setdiff1d(np.arange(self.actuators), self.actuator[driven])
        if missing.size:
            raise InputError(f"/schedule/actuator never plays actuator {missing[0]}; every one from 0 on is needed")
        delays, gains = self.delay_s[driven], self.gain[driven]
        if not (np.isfinite(delays).all() and delays.min() >= 0):
            raise InputError(f"/schedule/delay_s holds {delays[~(delays >= 0)][:1]}; 0 or more is needed")
        if not (np.isfinite(gains).all() and gains.all()):
            raise InputError("/schedule/gain holds 0 or a value that is not finite; each slot needs a gain")
        if self.period_s and delays.max() >= self.period_s:
            raise InputError(
                f"/schedule/delay_s holds {delays.max():g}; less than period_s = {self.period_s:g} is needed"
            )

    @property
    def records(self) -> int:
        """Records of a position."""
        return len(self.actuator)

    @property
    def actuators(self) -> int:
        """Number of actuators."""
        return int(self.actuator.max()) + 1

    @property
    def is_sequential(self) -> bool:
        """Whether each record plays one actuator, not delayed, with silence around it."""
        driven = self.actuator != EMPTY
        return self.period_s == 0 and bool((driven.sum(axis=1) == 1).all()) and not self.delay_s[driven].any()

    def slots(self, record: int) -> tuple[Int32Array, Float64Array, Float64Array]:
        """Actuators, delays in seconds and gains of the slots of a record that are not empty."""
        driven = self.actuator[record] != EMPTY
        return self.actuator[record][driven], self.delay_s[record][driven], self.gain[record][driven]


def sequential(actuators: int) -> Schedule:
    """One record per actuator."""
    one = (actuators, 1)
    return Schedule(np.arange(actuators, dtype=np.int32)[:, None], np.zeros(one), np.ones(one))


def staggered(actuators: int, stagger_s: float, groups: int = 1) -> Schedule:
    """All actuators in one record, or in one per group, each a stagger after the one before.

    Actuator k plays in group k modulo `groups`, so that those that are neighbours on the rim sound in
    different records or far apart.

    actuators: How many, >= 1.
    stagger_s: Delay from slot to slot in seconds, > 0.
    groups: Records per position, 1 to `actuators`.

    Raises InputError: a value outside the range above.
    """
    if not 1 <= groups <= actuators:
        raise InputError(f"groups is {groups}; 1 to the number of actuators, {actuators}, is needed")
    if not (np.isfinite(stagger_s) and stagger_s > 0):
        raise InputError(f"stagger_s is {stagger_s:g}; a time above 0 is needed")
    slots = -(-actuators // groups)
    actuator = np.full((groups, slots), EMPTY, dtype=np.int32)
    for index in range(actuators):
        actuator[index % groups, index // groups] = index
    delays = np.tile(stagger_s * np.arange(slots), (groups, 1))
    return Schedule(actuator, delays, np.ones((groups, slots)), slots * stagger_s)
