"""How long the rest of a session takes, and a plan, with the error that it may be expected to leave."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from statistics import median

from acquisition.measuring.record import Rolls
from acquisition.schedule.plan import Plan
from calibration.estimator.schedule_error import Method, Noise, expected_error

# Recent enough to follow a rig that slows down, long enough that a few slow positions do not move the finish.
LATEST = 30


class Pace:
    """Learns from every attempt; one clock per instance.

    The median of the latest attempts says how long one takes, so that single long ones (an audio server that stumbled)
    do not move it. How many attempts a position takes is their mean over as many positions: repeats are rare and
    cost time all the same. Outages are not counted, for `working_s` stands still meanwhile.

    working_s: What the clock says at the beginning.
    """

    def __init__(self, working_s: float) -> None:
        self._last_s = working_s
        self._attempt_s: deque[float] = deque(maxlen=LATEST)
        self._attempts_of: deque[int] = deque(maxlen=LATEST)
        self._sentinel_s: deque[float] = deque(maxlen=LATEST)

    def attempt_done(self, working_s: float) -> None:
        """An attempt had all its records at `working_s`."""
        self._attempt_s.append(working_s - self._last_s)
        self._last_s = working_s

    def sentinel_done(self, working_s: float) -> None:
        """A measurement of the sentinel position came to its end."""
        self._sentinel_s.append(working_s - self._last_s)
        self._last_s = working_s

    def position_settled(self, attempts: int) -> None:
        """A position is done with, after so many attempts in this session."""
        self._attempts_of.append(attempts)

    @property
    def position_s(self) -> float:
        """Seconds that a position takes, its expected repeats included; 0 before the first."""
        if not self._attempt_s:
            return 0.0
        attempts = sum(self._attempts_of) / len(self._attempts_of) if self._attempts_of else 1.0
        return median(self._attempt_s) * max(1.0, attempts)

    def remaining_s(self, positions: int, sentinel_passes: int, working_s: float | None = None) -> float:
        """Seconds for so many positions and measurements of the sentinel.

        positions: Positions not begun yet.
        sentinel_passes: Measurements of the sentinel to come.
        working_s: What the clock says, where one more position is being recorded: what that still takes counts, too.
        """
        under_way_s = 0.0 if working_s is None else max(0.0, self.position_s - (working_s - self._last_s))
        # Before the first, a sentinel is taken for a position like any other.
        sentinel_s = median(self._sentinel_s) if self._sentinel_s else self.position_s
        return under_way_s + positions * self.position_s + sentinel_passes * sentinel_s


# Signal-to-noise ratio at which schedules are compared before anything was measured: the paper's.
ASSUMED_SNR_DB = 40.0


@dataclass(frozen=True, slots=True)
class Expectation:
    """What may be expected of one schedule.

    name: What it is called.
    seconds: The whole campaign's.
    additive_db: Expected relative L2 error in band where noise is always the same, in dB.
    proportional_db: The same where noise grows with all that sounds.
    """

    name: str
    seconds: float
    additive_db: float
    proportional_db: float


def method_of(plan: Plan) -> Method:
    """How a plan's actuators sound."""
    rate, signal, excitation = plan.excitation.sample_rate_hz, plan.staggered, plan.excitation
    if signal is None:
        return Method(excitation.averages * excitation.duration_s, 1, excitation.duration_s + excitation.decay_s)
    period_s = signal.period_samples / rate
    return Method(signal.periods * period_s, signal.slots, period_s)


def schedule_name(plan: Plan) -> str:
    """What a plan's schedule is called: ``sequential 3 x 1 s``, ``staggered 250 ms, groups of 5``."""
    excitation, signal = plan.excitation, plan.staggered
    if signal is None:
        return f"sequential {excitation.averages} x {excitation.duration_s:g} s"
    name = f"staggered {1e3 * signal.stagger_samples / excitation.sample_rate_hz:g} ms"
    name += f", {signal.periods} periods" if signal.periods > 1 else ""
    return name + (f", groups of {signal.slots}" if signal.groups > 1 else "")


def expect(plan: Plan, rolls: Rolls, snr_db: float = ASSUMED_SNR_DB) -> Expectation:
    """Expect hours and errors of a plan under both models of noise.

    rolls: How long a record is before and after its signal.
    snr_db: Response of one actuator that sounds alone, while it sounds, over the noise from 0 to half the sample rate.
    """

    def error_db(noise: Noise) -> float:
        return expected_error(
            method_of(plan),
            noise,
            band_hz=plan.excitation.band_hz,
            sample_rate_hz=plan.excitation.sample_rate_hz,
            taps=plan.taps,
        ).total_db

    return Expectation(
        schedule_name(plan),
        plan.positions * plan.position_s(rolls),
        error_db(Noise(additive_db=-snr_db)),
        error_db(Noise(proportional_db=-snr_db)),
    )
