"""What a plan may be expected to leave of error, and how long it takes, beside what else could be done."""

from __future__ import annotations

from dataclasses import dataclass

from acquisition.measuring.record import Rolls
from acquisition.schedule.plan import Plan
from calibration.estimator.schedule_error import Method, Noise, expected_error

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
