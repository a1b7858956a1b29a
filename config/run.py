"""The run file: which positions, which sweep, how it is captured and when it is good enough."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from config.fields import Finite, NonNegative, Positive, Switch, Table, Text, Whole, mistake

STAGGER_OVER_RESPONSE = 1.2
"""Staggered responses come apart when each is over before the next begins; measured for this design."""

DEFAULT_STAGGER_OVER_RESPONSE = 1.25
SHORTEST_SWEEP_S = 0.05
"""A sweep fades in and out over 10 ms each, and must sound in between."""


class Grid(Table):
    """Where to measure: a grid inside the surface, or a list of positions in its place."""

    lattice: Literal["square", "hexagonal"] = "square"
    spacing_mm: Positive = 4.0
    margin_mm: NonNegative = 14.3
    positions_file: Text | None = None


class Sweep(Table):
    """The linear sweep that drives each actuator."""

    start_hz: Positive = 20.0
    stop_hz: Positive = 500.0
    duration_s: Annotated[Finite, Field(ge=SHORTEST_SWEEP_S, le=3600)] = 1.0
    amplitude_v: Positive = 1.0

    @model_validator(mode="after")
    def _upwards(self) -> Sweep:
        if self.stop_hz <= self.start_hz:
            raise mistake("stop_hz", self.stop_hz, f"must be above start_hz = {self.start_hz:g}")
        return self


class Capture(Table):
    """How each position is recorded."""

    averages: Annotated[Whole, Field(ge=1, le=1000)] = 3
    decay_s: Annotated[Positive, Field(le=3600)] = 0.2
    excitation: Literal["sequential", "staggered"] = "sequential"
    taps: Annotated[Whole, Field(ge=1, le=10_000_000)] = 2000
    sample_rate_hz: Annotated[Positive, Field(le=10_000_000)] = 10_000.0
    stagger_s: Positive
    groups: Annotated[Whole, Field(ge=1, le=1024)] = 1
    periods: Annotated[Whole, Field(ge=1, le=1000)] = 1
    level_db: Annotated[Finite, Field(ge=-40, le=0)] = 0.0
    when_staggered_does_not_pay: Literal["choose", "refuse", "keep"] = "choose"
    allowed_loss_db: NonNegative = 3.0
    keep_raw: Switch = False

    @property
    def stagger_samples(self) -> int:
        """Samples from one actuator's start to the next one's."""
        return round(self.stagger_s * self.sample_rate_hz)

    @property
    def response_s(self) -> float:
        """Length of a Green's function in seconds."""
        return self.taps / self.sample_rate_hz

    @model_validator(mode="before")
    @classmethod
    def _stagger_from_response(cls, data: Any) -> Any:
        if not isinstance(data, dict) or "stagger_s" in data:
            return data
        try:
            stagger_s = DEFAULT_STAGGER_OVER_RESPONSE * data.get("taps", 2000) / data.get("sample_rate_hz", 1e4)
        except (TypeError, ZeroDivisionError, OverflowError):
            stagger_s = math.nan
        # Without a response length no stagger follows; what is wrong is told at taps and sample_rate_hz.
        return {**data, "stagger_s": stagger_s if 0 < stagger_s < math.inf else 0.25}

    @model_validator(mode="after")
    def _response_fits(self) -> Capture:
        longest = self.decay_s * self.sample_rate_hz
        if self.taps > longest + 1e-6:
            allowed = f"must be at most {int(longest + 1e-6)} (decay_s * sample_rate_hz)"
            raise mistake("taps", self.taps, allowed)
        shortest_s = STAGGER_OVER_RESPONSE * self.response_s
        if self.stagger_s < shortest_s * (1 - 1e-12):
            allowed = (
                f"must be at least {shortest_s:g} ({STAGGER_OVER_RESPONSE} times the response "
                f"of taps / sample_rate_hz = {self.response_s:g} s)"
            )
            raise mistake("stagger_s", self.stagger_s, allowed)
        return self


class Settled(Table):
    """What the trial before a staggered campaign has settled; only a bank says it, never a run file."""

    asked: Capture
    reason: Text


class Fault(Table):
    """A fault for a virtual instrument to show, so that recovery can be watched."""

    role: Text
    operation: Text
    kind: Text
    at_call: Whole | None = None
    position: Annotated[Whole, Field(ge=0)] | None = None
    attempt: Annotated[Whole, Field(ge=1)] | None = None
    record: Annotated[Whole, Field(ge=0)] | None = None
    purpose: Literal["capture", "sentinel", "probe", "scan"] | None = None
    count: Annotated[Whole, Field(ge=1)] = 1
    level_db: Finite = -3.0
    tries: Annotated[Whole, Field(ge=0)] = 1
    spot_mm: tuple[Finite, Finite, Positive] | None = None


class FaultFile(Table):
    """A file of faults, as ``fault_plan`` may name one."""

    fault: tuple[Fault, ...] = ()


def _rising(course: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    for (first_s, _), (second_s, _) in pairwise(course):
        if second_s <= first_s:
            raise mistake("", course, "must be pairs of seconds and value, the seconds rising")
    return course


Course = Annotated[tuple[tuple[NonNegative, Finite], ...], AfterValidator(_rising)]


class Virtual(Table):
    """Settings of the virtual rig."""

    seed: Annotated[Whole, Field(ge=0, le=2**63 - 1)] = 1
    noise_v: NonNegative | None = None
    plate: Literal["soft", "stadium"] = "soft"
    fault_plan: tuple[Fault, ...] = ()
    room_c: Course = ()
    light: Course = ()


def _second_look(value: object) -> object:
    """Banks of before hold true or false."""
    return {True: "auto", False: "never"}[value] if isinstance(value, bool) else value


class Quality(Table):
    """When a measured position is good enough."""

    poor_residual_db: Annotated[Finite, Field(le=0)] = -50.0
    excess_noise_db: Positive = 8.0
    poor_snr_db: Finite = 20.0
    max_attempts: Annotated[Whole, Field(ge=1, le=100)] = 3
    poor_harmonic_db: Annotated[Finite, Field(le=0)] = -42.0
    speckle_step_mm: Annotated[NonNegative, Field(le=2)] = 0.1
    remeasure_pass: Annotated[Whole, Field(ge=0, le=10)] = 1
    second_look: Annotated[Literal["auto", "never"], BeforeValidator(_second_look)] = "auto"
    reference_db: Annotated[Positive, Field(le=20)] = 0.1


class Drift(Table):
    """How often the sentinel position is measured again, and how far it may be from its first measurement."""

    every_positions: Annotated[Whole, Field(ge=1)] = 50
    every_s: Positive = 3600.0
    warn_level_db: Positive = 0.5
    stop_level_db: Positive = 3.0
    warn_delay_samples: Positive = 0.5
    stop_delay_samples: Positive = 5.0
    warn_correlation: Annotated[Finite, Field(gt=0, lt=1)] = 0.98
    stop_correlation: Annotated[Finite, Field(gt=0, lt=1)] = 0.9

    @model_validator(mode="after")
    def _warned_first(self) -> Drift:
        for name in ("level_db", "delay_samples"):
            warn, stop = getattr(self, f"warn_{name}"), getattr(self, f"stop_{name}")
            if stop < warn:
                raise mistake(f"stop_{name}", stop, f"must be at least warn_{name} = {warn:g}")
        if self.stop_correlation > self.warn_correlation:
            allowed = f"must be at most warn_correlation = {self.warn_correlation:g}"
            raise mistake("stop_correlation", self.stop_correlation, allowed)
        return self


class Tolerance(Table):
    """When a scan agrees with its prediction."""

    normalised_error: Positive = 0.05
    correlation: Annotated[Finite, Field(gt=0, le=1)] = 0.99
    focus_error_mm: Positive = 4.0


class RunConfig(Table):
    """A validated run file."""

    rig: Text = "virtual"
    grid: Grid = Grid()
    sweep: Sweep = Sweep()
    capture: Capture
    virtual: Virtual | None = None
    quality: Quality = Quality()
    drift: Drift = Drift()
    tolerance: Tolerance = Tolerance()
    settled: Settled | None = None

    @property
    def awaits_trial(self) -> bool:
        """Whether a trial has still to say if staggered capture pays."""
        capture = self.capture
        return (
            self.settled is None and capture.excitation == "staggered" and capture.when_staggered_does_not_pay != "keep"
        )

    def settled_as(self, capture: Capture, reason: str) -> RunConfig:
        """Make it the run with the capture that a trial has settled, and why."""
        return self.model_copy(update={"capture": capture, "settled": Settled(asked=self.capture, reason=reason)})

    @model_validator(mode="before")
    @classmethod
    def _capture_always(cls, data: Any) -> Any:
        return {"capture": {}, **data} if isinstance(data, dict) else data

    @model_validator(mode="after")
    def _below_nyquist(self) -> RunConfig:
        nyquist_hz = self.capture.sample_rate_hz / 2
        if self.sweep.stop_hz >= nyquist_hz:
            allowed = f"must be below {nyquist_hz:g} (half of capture.sample_rate_hz)"
            raise mistake("sweep.stop_hz", self.sweep.stop_hz, allowed)
        return self


def default_run() -> RunConfig:
    """The run of an empty run file: the virtual rig, all defaults."""
    return RunConfig.model_validate({})
