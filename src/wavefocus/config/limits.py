"""Limits of point quality and of drift: tables of the run file, and what the engine judges by."""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import BeforeValidator, Field, model_validator

from wavefocus.config.fields import ALWAYS, Finite, NonNegative, Positive, Table, Whole, mistake


def _second_look(value: object) -> object:
    """Banks of before hold true or false."""
    return {True: "auto", False: "never"}[value] if isinstance(value, bool) else value


class QualityLimits(Table):
    """When a measured position is good enough.

    A suspect record makes its position poor only if its residual in volts is also above that of the quietest record: a
    far actuator's record is mostly noise and still honest, a near one's residual is large in volts and still small next
    to its response. The reference may be `CALIBRATION_SPARE` times `reference_db` from its calibration.
    """

    poor_residual_db: Annotated[Finite, Field(le=0), ALWAYS] = Field(
        default=-50.0, description="A record is suspect when its fit leaves more than this unexplained"
    )
    excess_noise_db: Annotated[Positive, ALWAYS] = Field(
        default=8.0,
        description="A suspect record makes its position poor when it is this much above the quietest record",
    )
    poor_snr_db: Annotated[Finite, ALWAYS] = Field(
        default=20.0, description="A position is poor when even its best record has less signal-to-noise ratio"
    )
    max_attempts: Annotated[Whole, Field(ge=1, le=100), ALWAYS] = Field(default=3, description="Attempts at a position")
    poor_harmonic_db: Annotated[Finite, Field(le=0)] = Field(
        default=-42.0, description="A record is clipped when its third harmonic at the loudest moment is above this"
    )
    speckle_step_mm: Annotated[NonNegative, Field(le=2)] = Field(
        default=0.1, description="Distance that the laser moves aside to find light when speckle dims it"
    )
    remeasure_pass: Annotated[Whole, Field(ge=0, le=10)] = Field(
        default=1, description="Rounds at the end over all positions that are not valid"
    )
    second_look: Annotated[Literal["twice", "auto", "never"], BeforeValidator(_second_look)] = Field(
        default="auto",
        description='"twice": measure twice the positions that the others cannot judge (too few, too far); else they '
        'stay valid. "auto" and "never" are of earlier versions and mean the same',
    )
    reference_db: Annotated[Positive, Field(le=20)] = Field(
        default=0.1, description="Largest deviation of the reference's level; from its calibration 2.5 times that"
    )

    @property
    def confirms(self) -> bool:
        """Whether positions that neighbours cannot judge are measured twice."""
        return self.second_look == "twice" and self.remeasure_pass > 0


class DriftLimits(Table):
    """How often the sentinel position is measured again, and how far it may be from its first measurement.

    At the default noise a re-measured position correlates above 0.999.
    """

    every_positions: Annotated[Whole, Field(ge=1)] = Field(
        default=50, description="Positions after which the sentinel position is measured again"
    )
    every_s: Positive = Field(default=3600.0, description="Time after which it is measured again, if that comes first")
    warn_level_db: Positive = Field(default=0.5, description="Largest change of level before a warning")
    stop_level_db: Positive = Field(default=3.0, description="Largest change of level before the campaign stops")
    warn_delay_samples: Positive = Field(default=0.5, description="Largest shift in time before a warning")
    stop_delay_samples: Positive = Field(default=5.0, description="Largest shift in time before the campaign stops")
    warn_correlation: Annotated[Finite, Field(gt=0, lt=1)] = Field(
        default=0.98, description="Smallest correlation with the first measurement before a warning"
    )
    stop_correlation: Annotated[Finite, Field(gt=0, lt=1)] = Field(
        default=0.9, description="Smallest correlation before the campaign stops"
    )

    @model_validator(mode="after")
    def _warned_first(self) -> DriftLimits:
        for name in ("level_db", "delay_samples"):
            warn, stop = getattr(self, f"warn_{name}"), getattr(self, f"stop_{name}")
            if stop < warn:
                raise mistake(f"stop_{name}", stop, f"must be at least warn_{name} = {warn:g}")
        if self.stop_correlation > self.warn_correlation:
            allowed = f"must be at most warn_correlation = {self.warn_correlation:g}"
            raise mistake("stop_correlation", self.stop_correlation, allowed)
        return self

    def passes(self, positions: int, position_s: float) -> int:
        """How often the sentinel is measured with so many positions of so many seconds each, at their end too."""
        if positions < 2 or position_s <= 0:
            return 0
        between = min(self.every_positions, max(1, math.ceil(self.every_s / position_s)))
        return (positions - 1) // between + 1
