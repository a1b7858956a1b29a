"""The plan: everything that a campaign will do, as data that dry run, engine and resume all walk."""

from collections import deque
from dataclasses import dataclass, field
from statistics import median
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from wavefocus.acquisition.setup import RecordMargins, record_samples
from wavefocus.calibration import Float64Array, Int64Array
from wavefocus.calibration.estimator.noise_error import noise_error_db
from wavefocus.calibration.excitation import PlayedExcitation, StaggeredSignal
from wavefocus.config.run import DriftLimits, QualityLimits
from wavefocus.storage.ledger.layout import OnGrid

# Time of a mirror move, of starting a task and of a commit, for the estimate before a run.
POSITION_OVERHEAD_S = 0.05
LEAK_S = 0.52
"""Length of the sweep that plays on the loopback alone, and of the longest delay that is looked for."""
CHECK_LOOKS = 4
"""Times that a check position is measured: of the mean, the noise is 6 dB lower, which the errors between positions of
a coarse grid are judged by."""


@dataclass(frozen=True, slots=True)
class Plan(OnGrid):
    """A campaign: which positions, with what excitation.

    position_mm, float64 (positions, 2): The grid, in the order of measurement, which is the bank's.
    actuator_mm, float64 (actuators, 2): Where the actuators are.
    excitation: What plays in each record where actuators sound one after the other.
    taps: Length L of the Green's functions.
    sha256: Hash of all that a resume must not change.
    quality: When a position is good enough.
    staggered: What plays instead where several actuators sound at once.
    drift: How often the sentinel position is measured again, and how far it may drift.
    check_rows: Bank rows of the check positions, which are measured `CHECK_LOOKS` times and averaged.
    """

    position_mm: Float64Array
    actuator_mm: Float64Array
    excitation: PlayedExcitation
    taps: int
    sha256: str
    quality: QualityLimits = field(default_factory=QualityLimits)
    staggered: StaggeredSignal | None = None
    drift: DriftLimits = field(default_factory=DriftLimits)
    check_rows: frozenset[int] = frozenset()

    @property
    def records(self) -> int:
        """Records of a position."""
        return self.actuators if self.staggered is None else self.staggered.groups

    def looks(self, *rows: int) -> int:
        """How often some positions are measured in all, each once but for check positions."""
        # Counted anew after each position: thousands of rows, of which mostly none is a check position.
        more = sum(row in self.check_rows for row in rows) if self.check_rows else 0
        return len(rows) + (CHECK_LOOKS - 1) * more

    def to_do(self, status: NDArray[np.uint8]) -> Int64Array:
        """Bank rows still to be measured, in order: the plan minus what is committed."""
        return np.flatnonzero(status == 0)

    def position_s(self, margins: RecordMargins) -> float:
        """Seconds that one position takes: its records and the overhead around them."""
        rate = self.excitation.sample_rate_hz
        if self.staggered is None:
            record_s = record_samples(margins, self.excitation.averages * self.excitation.period_samples, rate) / rate
        else:
            used = lead_samples(self.staggered, margins) + self.staggered.used_samples
            record_s = margins.pre_roll_s + used / rate
        return self.records * record_s + POSITION_OVERHEAD_S

    def campaign_s(self, rows: Int64Array, margins: RecordMargins) -> float:
        """Seconds that some positions take; sentinel, second looks and looks at the leak included."""
        position_s = self.position_s(margins)
        count = self.looks(*rows.tolist()) + self.second_looks(rows)
        passes = self.drift.passes(count, position_s)
        leak_s = record_samples(margins, 0, self.excitation.sample_rate_hz) / self.excitation.sample_rate_hz + LEAK_S
        return (count + passes) * position_s + (passes + 1) * leak_s

    def second_looks(self, rows: Int64Array) -> int:
        """Number of positions that no others can be expected to judge, so that they are measured twice.

        rows: The positions that are measured.
        """
        if not self.quality.confirms:
            return 0
        from wavefocus.calibration.coarse_grid.left_out_rows import MIN_POSITIONS

        return len(rows) if len(rows) < MIN_POSITIONS else 0


def row_error_db(plan: Plan, snr_db: NDArray[np.floating]) -> Float64Array:
    """`noise_error_db` of rows that a plan measures, by the signal-to-noise ratios of their records."""
    sweep, signal = plan.excitation, plan.staggered
    period_s = (sweep if signal is None else signal).period_samples / sweep.sample_rate_hz
    response_s = plan.taps / sweep.sample_rate_hz
    return noise_error_db(snr_db, band_hz=sweep.band_hz, response_s=response_s, period_s=period_s)


def lead_samples(signal: StaggeredSignal, margins: RecordMargins) -> int:
    """Samples that a periodic signal plays before it counts: the player's latency, and one response to build up."""
    return round(margins.post_roll_s * signal.sweep.sample_rate_hz) + signal.taps


def sentinel_of(status: NDArray[np.uint8]) -> int | None:
    """The position re-measured for drift: the first valid one, if any."""
    valid = np.flatnonzero(status == 1)
    return int(valid[0]) if len(valid) else None


# Recent enough to follow a rig that slows down, long enough that a few slow positions do not move the finish.
LATEST = 30


Measurement = Literal["attempt", "sentinel", "leak"]


class CampaignPace:
    """Learns from every attempt; one clock per instance.

    The median of the latest attempts says how long one takes, so that single long ones (an audio server that stumbled)
    do not move it. How many attempts a position takes is their mean over as many positions: repeats are rare and
    cost time all the same. Outages are not counted, for `working_s` stands still meanwhile.

    working_s: What the clock says at the beginning.
    """

    def __init__(self, working_s: float) -> None:
        self._last_s = working_s
        self._took_s: dict[Measurement, deque[float]] = {
            "attempt": deque(maxlen=LATEST), "sentinel": deque(maxlen=LATEST), "leak": deque(maxlen=1)
        }  # fmt: skip
        self._attempts_of: deque[int] = deque(maxlen=LATEST)

    def done(self, what: Measurement, working_s: float, looks: int = 1) -> None:
        """All records of an attempt, or a measurement of the sentinel or of the leak, came to an end at `working_s`.

        looks: How often the attempt measures its position.
        """
        self._took_s[what].append((working_s - self._last_s) / looks)
        self._last_s = working_s

    def position_settled(self, attempts: int) -> None:
        """A position is done with, after so many attempts in this session."""
        self._attempts_of.append(attempts)

    @property
    def position_s(self) -> float:
        """Seconds that a position takes, its expected repeats included; 0 before the first."""
        if not self._took_s["attempt"]:
            return 0.0
        attempts = sum(self._attempts_of) / len(self._attempts_of) if self._attempts_of else 1.0
        return median(self._took_s["attempt"]) * max(1.0, attempts)

    def remaining_s(self, positions: int, sentinel_passes: int, working_s: float | None = None) -> float:
        """Seconds for so many positions and measurements of the sentinel.

        positions: Positions not begun yet, check positions as often as they are measured.
        sentinel_passes: Measurements of the sentinel to come.
        working_s: What the clock says, where one more position is being recorded: what that still takes counts, too.
        """
        under_way_s = 0.0 if working_s is None else max(0.0, self.position_s - (working_s - self._last_s))
        # Before the first, a sentinel is taken for a position like any other.
        sentinel_s = median(self._took_s["sentinel"] or [self.position_s])
        return under_way_s + positions * self.position_s + sentinel_passes * (sentinel_s + sum(self._took_s["leak"]))


def schedule_name(plan: Plan) -> str:
    """What a plan's schedule is called: ``sequential 3 x 1 s``, ``staggered 250 ms, groups of 5``."""
    excitation, signal = plan.excitation, plan.staggered
    if signal is None:
        return f"sequential {excitation.averages} x {excitation.duration_s:g} s"
    name = f"staggered {1e3 * signal.stagger_samples / excitation.sample_rate_hz:g} ms"
    name += f", {signal.periods} periods" if signal.periods > 1 else ""
    return name + (f", groups of {signal.slots}" if signal.groups > 1 else "")
