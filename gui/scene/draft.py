"""A scene as people edit it: every key of the scene file, immutable, and not yet checked."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import ClassVar, Literal

PointMm = tuple[float, float]
Emission = Literal["continuous", "per_point"]


@dataclass(frozen=True, slots=True)
class PointDraft:
    """A source that stands still."""

    kind: ClassVar[str] = "point"
    at_mm: PointMm = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class LineDraft:
    """A straight line."""

    kind: ClassVar[str] = "line"
    start_mm: PointMm = (-30.0, 0.0)
    end_mm: PointMm = (30.0, 0.0)


@dataclass(frozen=True, slots=True)
class CircleDraft:
    """An arc or several turns of a circle, anticlockwise where turns are positive."""

    kind: ClassVar[str] = "circle"
    centre_mm: PointMm = (0.0, 0.0)
    radius_mm: float = 20.0
    turns: float = 1.0
    start_deg: float = 0.0


@dataclass(frozen=True, slots=True)
class PolylineDraft:
    """Straight lines through points."""

    kind: ClassVar[str] = "polyline"
    points_mm: tuple[PointMm, ...] = ((-20.0, -10.0), (0.0, 20.0), (20.0, -10.0))
    closed: bool = False


@dataclass(frozen=True, slots=True)
class SvgDraft:
    """A path of a drawing; the file's name is absolute, empty while none is chosen."""

    kind: ClassVar[str] = "svg"
    file: str = ""
    path_id: str = ""
    scale: float = 1.0
    origin_mm: PointMm = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class TextDraft:
    """The outlines of letters."""

    kind: ClassVar[str] = "text"
    string: str = "text"
    height_mm: float = 20.0
    centre_mm: PointMm = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ImpulseDraft:
    """One sample of 1."""

    kind: ClassVar[str] = "impulse"


@dataclass(frozen=True, slots=True)
class SineDraft:
    """A sine of amplitude 1 and phase 0, without a fade."""

    kind: ClassVar[str] = "sine"
    frequency_hz: float = 200.0
    duration_s: float = 0.1


@dataclass(frozen=True, slots=True)
class NoiseDraft:
    """Band-limited noise, scaled to peak 1."""

    kind: ClassVar[str] = "noise"
    band_hz: tuple[float, float] = (50.0, 450.0)
    duration_s: float = 0.015
    seed: int = 1


@dataclass(frozen=True, slots=True)
class FileDraft:
    """A sound file, resampled and scaled to peak 1; its name is absolute, empty while none is chosen."""

    kind: ClassVar[str] = "file"
    path: str = ""


PathDraft = PointDraft | LineDraft | CircleDraft | PolylineDraft | SvgDraft | TextDraft
SignalDraft = ImpulseDraft | SineDraft | NoiseDraft | FileDraft

PATHS: tuple[type[PathDraft], ...] = (PointDraft, LineDraft, CircleDraft, PolylineDraft, TextDraft, SvgDraft)
SIGNALS: tuple[type[SignalDraft], ...] = (ImpulseDraft, SineDraft, NoiseDraft, FileDraft)


@dataclass(frozen=True, slots=True)
class SourceDraft:
    """One source.

    Parameters
    ----------
    path, signal : PathDraft, SignalDraft
        Where it goes and what it emits.
    start_s : float
        When it starts.
    speed_mm_s, step_mm : float or None
        How fast it moves and how far its path's samples are apart; a point needs neither.
    amplitude : float
        At the focus, in the bank's response unit, where the scene normalises.
    emission : {"continuous", "per_point"}
        Whether the signal runs on along the path or every sample of it emits all of it anew.
    """

    path: PathDraft
    signal: SignalDraft = field(default_factory=NoiseDraft)
    start_s: float = 0.0
    speed_mm_s: float | None = 80.0
    step_mm: float | None = 4.0
    amplitude: float = 1.0
    emission: Emission = "continuous"


@dataclass(frozen=True, slots=True)
class RegularisationDraft:
    """How weak and strong actuators are evened out; 0 is off."""

    saturation: float = 0.0
    saturation_absolute: float = 0.0
    normalise: bool = True


@dataclass(frozen=True, slots=True)
class OutputDraft:
    """Between grid positions, and at the amplifier; None is no limit."""

    interpolation: str = "nearest"
    limit_v: float | None = None
    limit_rms_v: float | None = None


@dataclass(frozen=True, slots=True)
class SceneDraft:
    """All of a scene; unlike a scene, it may have no source yet."""

    name: str = "scene"
    sources: tuple[SourceDraft, ...] = ()
    regularisation: RegularisationDraft = field(default_factory=RegularisationDraft)
    output: OutputDraft = field(default_factory=OutputDraft)

    def with_source(self, index: int, source: SourceDraft) -> SceneDraft:
        """The same scene with another source in one place."""
        return replace(self, sources=(*self.sources[:index], source, *self.sources[index + 1 :]))

    def with_sources(self, sources: tuple[SourceDraft, ...]) -> SceneDraft:
        """The same scene with other sources."""
        return replace(self, sources=sources)
