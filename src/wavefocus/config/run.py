"""The run file: which positions, which sweep, how it is captured, limits of quality and of drift."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from wavefocus.config.emulation import PlateKeys, RigFault
from wavefocus.config.fields import (
    ALWAYS,
    DERIVED,
    FREE,
    Finite,
    NonNegative,
    Positive,
    Switch,
    Table,
    Text,
    Whole,
    default,
    like,
    mistake,
)


def _second_look(value: object) -> object:
    """Banks of before hold true or false."""
    return {True: "auto", False: "never"}[value] if isinstance(value, bool) else value


class QualityLimits(Table):
    """When a measured position is good enough.

    A suspect record makes its position poor only if its residual in volts is also above that of the quietest record: a
    far actuator's record is mostly noise and still honest, a near one's residual is large in volts and still small next
    to its response. The reference may be `CALIBRATION_SPARE` times `reference_db` from its calibration.
    """

    poor_residual_db: Annotated[Finite, ALWAYS] = default(
        -50.0, "A record is suspect when its fit leaves more than this unexplained", le=0
    )
    excess_noise_db: Annotated[Positive, ALWAYS] = default(
        8.0, "A suspect record makes its position poor when it is this much above the quietest record"
    )
    poor_snr_db: Annotated[Finite, ALWAYS] = default(
        20.0, "A position is poor when even its best record has less signal-to-noise ratio"
    )
    max_attempts: Annotated[Whole, ALWAYS] = default(3, "Attempts at a position", ge=1, le=100)
    poor_harmonic_db: Finite = default(
        -42.0, "A record is clipped when its third harmonic at the loudest moment is above this", le=0
    )
    speckle_step_mm: NonNegative = default(
        0.1, "Distance that the laser moves aside to find light when speckle dims it", le=2
    )
    remeasure_pass: Whole = default(1, "Rounds at the end over all positions that are not valid", ge=0, le=10)
    second_look: Annotated[Literal["twice", "auto", "never"], BeforeValidator(_second_look)] = default(
        "auto",
        '"twice": measure twice the positions that the others cannot judge (too few, too far); else they '
        'stay valid. "auto" and "never" are of earlier versions and mean the same',
    )
    reference_db: Positive = default(
        0.1, "Largest deviation of the reference's level; from its calibration 2.5 times that", le=20
    )

    @property
    def confirms(self) -> bool:
        """Whether positions that neighbours cannot judge are measured twice."""
        return self.second_look == "twice" and self.remeasure_pass > 0


class DriftLimits(Table):
    """How often the sentinel position is measured again, and how far it may be from its first measurement.

    At the default noise a re-measured position correlates above 0.999.
    """

    every_positions: Whole = default(50, "Positions after which the sentinel position is measured again", ge=1)
    every_s: Positive = default(3600.0, "Time after which it is measured again, if that comes first")
    warn_level_db: Positive = default(0.5, "Largest change of level before a warning")
    stop_level_db: Positive = default(3.0, "Largest change of level before the campaign stops")
    warn_delay_samples: Positive = default(0.5, "Largest shift in time before a warning")
    stop_delay_samples: Positive = default(5.0, "Largest shift in time before the campaign stops")
    warn_correlation: Finite = default(
        0.98, "Smallest correlation with the first measurement before a warning", gt=0, lt=1
    )
    stop_correlation: Finite = default(0.9, "Smallest correlation before the campaign stops", gt=0, lt=1)

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


_STAGGER_OVER_RESPONSE = 1.2
"""Staggered responses come apart when each is over before the next begins; measured for this design."""

Waveform = Literal["linear", "multisine"]
"""See `wavefocus.calibration.excitation`."""


class Grid(Table):
    """Where to measure: a grid inside the surface, or a list of positions in its place."""

    lattice: Annotated[Literal["square", "hexagonal"], DERIVED] = default(
        "square", 'Arrangement of the positions; hexagonal needs fewer, and no interpolation "bilinear"'
    )
    spacing_mm: Annotated[Positive, DERIVED] = default(4.0, "Distance of neighbouring positions")
    margin_mm: Annotated[NonNegative, DERIVED] = default(
        14.3, "Distance kept from the outline, less than half the surface's width"
    )
    positions_file: Annotated[Text | None, DERIVED] = default(
        None, "CSV file with the header x_mm,y_mm, in place of a lattice"
    )
    regular_positions: Annotated[Whole | None, FREE, Field(ge=1)] = default(
        None, "Positions on the lattice, in banks of earlier versions that were refined"
    )
    check_positions: Annotated[Whole, Field(ge=0, le=1000), DERIVED] | None = default(
        None,
        "Positions off the lattice, measured to judge what is interpolated; 24 by default where its spacing "
        "is above half a wavelength, else 0",
    )

    @model_validator(mode="after")
    def _checks_need_a_lattice(self) -> Grid:
        if self.check_positions and self.positions_file is not None:
            raise mistake("check_positions", self.check_positions, "must be 0 or absent with positions_file")
        return self


class Sweep(Table):
    """The sweep that drives each actuator, or another waveform that fills a band."""

    start_hz: Annotated[Positive, ALWAYS] = default(20.0, "Start of the sweep")
    stop_hz: Annotated[Positive, ALWAYS] = default(
        500.0, "End of the sweep, above start_hz and below half of sample_rate_hz"
    )
    # It fades in and out over 10 ms each, and must sound in between.
    duration_s: Annotated[Finite, ALWAYS] = default(1.0, "Duration of one sweep", ge=0.05, le=3600)
    amplitude_v: Annotated[Positive, ALWAYS] = default(1.0, "Peak of the sweep, at most the rig's player.limit_v")

    waveform: Waveform = default("linear", "A linear sweep, or a multisine: all frequencies of the band throughout")

    @model_validator(mode="after")
    def _upwards(self) -> Sweep:
        if self.stop_hz <= self.start_hz:
            raise mistake("stop_hz", self.stop_hz, f"must be above start_hz = {self.start_hz:g}")
        return self


class Capture(Table):
    """How each position is recorded."""

    averages: Annotated[Whole, ALWAYS] = default(3, "Sweeps per actuator and position", ge=1, le=1000)
    decay_s: Annotated[Positive, ALWAYS] = default(
        0.2, "Silence after each sweep; the response must be over by then", le=3600
    )
    excitation: Annotated[Literal["sequential", "staggered"], ALWAYS] = default(
        "sequential", "One actuator after another, or all at once"
    )
    taps: Annotated[Whole, ALWAYS] = default(
        2000, "Length of a Green's function in samples, at most decay_s * sample_rate_hz", ge=1, le=10_000_000
    )
    sample_rate_hz: Annotated[Positive, ALWAYS] = default(
        10_000.0, "Rate of the recordings and of the bank", le=10_000_000
    )
    stagger_s: Annotated[Positive, ALWAYS] = Field(
        description="Staggered: from one actuator's start to the next one's, at least 1.2 taps / sample_rate_hz"
    )
    groups: Annotated[Whole, ALWAYS] = default(
        1, "Staggered: records per position, the actuators divided among them", ge=1, le=1024
    )
    periods: Annotated[Whole, ALWAYS] = default(1, "Staggered: periods of a record", ge=1, le=1000)
    level_db: Finite = default(0.0, "Drive relative to amplitude_v", ge=-40, le=0)
    keep_raw: Annotated[Switch, FREE] = default(False, "Keep the recordings in BANK.raw.h5, for wavefocus estimate")

    def _unused_in_plan(self) -> frozenset[str]:
        return frozenset() if self.excitation == "staggered" else frozenset({"stagger_s", "groups", "periods"})

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
            stagger_s = 1.25 * data.get("taps", 2000) / data.get("sample_rate_hz", 1e4)
        except (TypeError, ZeroDivisionError, OverflowError):
            stagger_s = math.nan
        # Without a response length no stagger follows; the mistake is reported at taps and sample_rate_hz.
        return {**data, "stagger_s": stagger_s if 0 < stagger_s < math.inf else 0.25}

    @model_validator(mode="after")
    def _response_fits(self) -> Capture:
        longest = self.decay_s * self.sample_rate_hz
        if self.taps > longest + 1e-6:
            allowed = f"must be at most {int(longest + 1e-6)} (decay_s * sample_rate_hz)"
            raise mistake("taps", self.taps, allowed)
        shortest_s = _STAGGER_OVER_RESPONSE * self.response_s
        if self.stagger_s < shortest_s * (1 - 1e-12):
            allowed = (
                f"must be at least {shortest_s:g} ({_STAGGER_OVER_RESPONSE} times the response "
                f"of taps / sample_rate_hz = {self.response_s:g} s)"
            )
            raise mistake("stagger_s", self.stagger_s, allowed)
        return self


class _Settled(Table):
    """What a trial of earlier versions has settled before a staggered campaign; only a bank says it."""

    asked: Capture
    reason: Text


class FaultFile(Table):
    """A file of faults, as ``fault_plan`` may name one."""

    fault: tuple[RigFault, ...] = ()


def _rising(course: tuple[tuple[float, float], ...]) -> tuple[tuple[float, float], ...]:
    for (first_s, _), (second_s, _) in pairwise(course):
        if second_s <= first_s:
            raise mistake("", course, "must be pairs of seconds and value, the seconds rising")
    return course


_Course = Annotated[tuple[tuple[NonNegative, Finite], ...], AfterValidator(_rising)]


class Virtual(PlateKeys):
    """Settings of the virtual rig."""

    seed: Annotated[Whole, ALWAYS] = default(1, "The same seed gives the same bytes", ge=0, le=2**63 - 1)
    noise_v: Annotated[NonNegative | None, ALWAYS] = default(None, "Rms noise at the vibrometer's output")
    crosstalk: Annotated[Finite, Field(ge=-1, le=1)] | None = default(
        None, "Share of the loopback voltage that leaks into the response input; 0 by default"
    )
    crosstalk_delay_s: Annotated[NonNegative, Field(le=0.01)] | None = default(
        None, "How much later the leak comes than the loopback's voltage; 0 by default"
    )
    fault_plan: Annotated[tuple[RigFault, ...], FREE] = default(
        (), "Faults that the instruments show: a list, or a TOML file of [[fault]] tables"
    )
    room_c: Annotated[_Course, FREE] = default(
        (), "Temperature of the room: pairs of seconds, rising, and degrees Celsius"
    )
    speed_per_k: Finite | None = default(
        None, "Change of the wave speed per kelvin of the room above 21 degrees Celsius, relative"
    )
    loss_per_k: Finite | None = default(None, "The same of the loss")
    light: Annotated[_Course, FREE] = default(
        (), "Share of light that comes back to the vibrometer: pairs of seconds, rising, and 0 to 1"
    )

    def plan_values(self) -> dict[str, Any]:
        """A plate whose keys are given is named, the default one too."""
        return super().plan_values() | ({"plate": self.plate} if self.plate_keys else {})


class Tolerance(Table):
    """When a scan agrees with its prediction."""

    normalised_error: Positive = default(0.05, "Norm of scan minus prediction over norm of the scan")
    correlation: Finite = default(0.99, "Correlation of scan and prediction", gt=0, le=1)
    focus_error_mm: Positive = default(4.0, "Distance of the measured from the intended focus")


Line = Annotated[Text, like(r"[^\x00-\x1f\x7f-\x9f]+", "must be one line of text"), Field(max_length=1000)]


class _Person(Table):
    """Somebody who made the measurements."""

    name: Line = Field(description="Name as on a paper")
    orcid: Annotated[Text, like(r"\d{4}-\d{4}-\d{4}-\d{3}[\dX]", 'must be like "0000-0002-1825-0097"')] | None = (
        default(None, "ORCID identifier")
    )
    affiliation: Line | None = default(None, "University, institute or company")


class Publication(Table):
    """What is said of the measurements where they are published; no part of the plan."""

    title: Line | None = default(None, "Title of the data set")
    description: Annotated[Text, like(r"[^\x00-\x08\x0b-\x1f\x7f-\x9f]+", "must be plain text")] | None = default(
        None, "What was measured, and what for; one paragraph or more"
    )
    licence: Line | None = default(
        None, 'Licence as an SPDX identifier ("CC-BY-4.0", "CC0-1.0"), an address or a sentence'
    )
    people: tuple[_Person, ...] = default((), "Who made the measurements: a list of { name, orcid, affiliation }")
    organisation: Line | None = default(None, "Who publishes them")
    database: Line | None = default(None, "Name of the collection that they belong to")
    room: Line | None = default(None, "The room or set-up that the plate stood in")
    keywords: tuple[Line, ...] = default((), "Words to find them by")
    references: tuple[Line, ...] = default((), "Papers about them, as DOIs or addresses")

    @property
    def texts(self) -> dict[str, str]:
        """Each key that is given, as one text."""
        lists = {
            "people": [
                person.name + (f" (https://orcid.org/{person.orcid})" if person.orcid else "") for person in self.people
            ],
            "keywords": list(self.keywords),
            "references": list(self.references),
        }
        plain = {key: value for key, value in self if isinstance(value, str)}
        return plain | {key: "; ".join(texts) for key, texts in lists.items() if texts}


class PublicationFile(Table):
    """The table ``[publication]`` of a run file, or of a file of its own."""

    publication: Publication


class RunConfig(Table):
    """A validated run file."""

    rig: Annotated[Text, FREE] = default(
        "virtual", 'The rig file, relative to this file; "virtual" is the built-in virtual rig'
    )
    grid: Grid = Grid()
    sweep: Sweep = Sweep()
    capture: Capture
    virtual: Virtual | None = None
    quality: QualityLimits = QualityLimits()
    drift: Annotated[DriftLimits, FREE] = DriftLimits()
    tolerance: Annotated[Tolerance, FREE] = Tolerance()
    publication: Annotated[Publication, FREE] = Publication()
    settled: Annotated[_Settled | None, FREE] = None

    def rig_file(self, run_file: Path) -> Path | None:
        """The rig file that this run, of that file, names; None for the built-in virtual rig."""
        return None if self.rig == "virtual" else run_file.parent / self.rig

    def with_schedule(self, capture: Capture, reason: str) -> RunConfig:
        """Make it the run with the capture that a trial has settled, and why."""
        return self.model_copy(update={"capture": capture, "settled": _Settled(asked=self.capture, reason=reason)})

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
