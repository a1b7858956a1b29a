"""The run file: which positions, which sweep, how it is captured and when it is good enough."""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from wavefocus.config.fields import Finite, NonNegative, Positive, Switch, Table, Text, Whole, mistake

STAGGER_OVER_RESPONSE = 1.2
"""Staggered responses come apart when each is over before the next begins; measured for this design."""

DEFAULT_STAGGER_OVER_RESPONSE = 1.25
SHORTEST_SWEEP_S = 0.05
"""A sweep fades in and out over 10 ms each, and must sound in between."""


class Grid(Table):
    """Where to measure: a square grid inside the surface, or a list of positions in its place."""

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
    keep_raw: Switch = False

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
        if self.excitation == "staggered":
            raise mistake("excitation", self.excitation, 'must be "sequential": this version captures sequentially')
        if self.keep_raw:
            raise mistake("keep_raw", self.keep_raw, "must be false: this version keeps no raw recordings")
        return self


class Fault(Table):
    """A fault for a virtual instrument to show, so that recovery can be watched."""

    role: Text
    operation: Text
    kind: Text
    at_call: Whole | None = None
    position: Annotated[Whole, Field(ge=0)] | None = None
    attempt: Annotated[Whole, Field(ge=1)] | None = None
    record: Annotated[Whole, Field(ge=0)] | None = None
    purpose: Literal["capture", "sentinel", "scan"] | None = None
    count: Annotated[Whole, Field(ge=1)] = 1
    level_db: Finite = -3.0
    tries: Annotated[Whole, Field(ge=0)] = 1

    @model_validator(mode="after")
    def _known_to_the_virtual_instruments(self) -> Fault:
        from mocks import faults  # only a run with a fault plan needs them

        try:
            faults.Fault(**self.model_dump())
        except ValueError as error:
            raise mistake("", self.model_dump(exclude_defaults=True), str(error)) from None
        return self


class FaultFile(Table):
    """A file of faults, as ``fault_plan`` may name one."""

    fault: tuple[Fault, ...] = ()


class Virtual(Table):
    """Settings of the virtual rig."""

    seed: Annotated[Whole, Field(ge=0, le=2**63 - 1)] = 1
    noise_v: NonNegative | None = None
    fault_plan: tuple[Fault, ...] = ()


class Quality(Table):
    """When a measured position is good enough."""

    poor_residual_db: Annotated[Finite, Field(le=0)] = -50.0
    excess_noise_db: Positive = 8.0
    poor_snr_db: Finite = 20.0
    max_attempts: Annotated[Whole, Field(ge=1, le=100)] = 3


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
    tolerance: Tolerance = Tolerance()

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
