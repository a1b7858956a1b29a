"""Orders to ``wavefocus operate``, and the events of ``operate``, ``calibrate`` and ``play``."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

from wavefocus.config.messages.codec import Message

Role = Literal["mirror", "recorder", "player"]
Numbers = tuple[float, float]


@dataclass(frozen=True)
class Order(Message):
    """Base class of orders; the `done` that ends one repeats its `id`."""

    sparse = True
    id: str | int | float | None = field(default=None, kw_only=True)


@dataclass(frozen=True)
class Jog(Order, order="jog"):
    """Send the beam to a place on the surface, or to angles."""

    x_mm: float | None = None
    y_mm: float | None = None
    x_mrad: float | None = None
    y_mrad: float | None = None


@dataclass(frozen=True)
class Park(Order, order="park"):
    """Send the beam to the safe direction."""


@dataclass(frozen=True)
class ShowLevel(Order, order="level"):
    """Stream levels, or stop; one actuator plays short sweeps meanwhile, where one is named."""

    on: bool = True
    every_s: float = 0.25
    actuator: int | None = None
    level_v: float | None = None


@dataclass(frozen=True)
class TakeSweep(Order, order="sweep"):
    """Record silence and one sweep of an actuator; `level_v` is a peak, by default a safe one."""

    actuator: int
    level_v: float | None = None
    start_hz: float = 40.0
    stop_hz: float = 400.0
    duration_s: float = 0.5


@dataclass(frozen=True)
class Mute(Order, order="mute"):
    """Mute the outputs at once; levels stop too."""


@dataclass(frozen=True)
class ReportState(Order, order="state"):
    """Report where the beam is and whether levels are on."""


@dataclass(frozen=True)
class Reconnect(Order, order="reconnect"):
    """Open a lost instrument afresh."""

    instrument: Role


@dataclass(frozen=True)
class End(Order, order="end"):
    """Mute, park and end."""


ORDERS = (Jog, Park, ShowLevel, TakeSweep, Mute, ReportState, Reconnect, End)


@dataclass(frozen=True)
class Opening(Message, event="opening"):
    """The rig's instruments are being opened."""

    rig: str


@dataclass(frozen=True)
class SurfaceSize:
    """Kind and size of a surface, and the corners of a polygon, as in a rig file."""

    kind: str
    length_mm: float
    width_mm: float
    corners_mm: tuple[Numbers, ...] | None = None


@dataclass(frozen=True)
class Ready(Message, event="ready"):
    """The rig is open: its instruments by role, whether its mirror map was measured, and its limits."""

    name: str
    instruments: Mapping[str, str]
    surface: SurfaceSize
    actuator_mm: tuple[Numbers, ...]
    mapped: bool
    limit_mrad: float
    level_v: float
    largest_level_v: float
    band_hz: Numbers
    range_v: Numbers


@dataclass(frozen=True)
class MirrorMoved(Message, event="mirror"):
    """Where the beam was sent; None before the first move, and in millimetres where it does not meet the surface."""

    x_mm: float | None = None
    y_mm: float | None = None
    x_mrad: float | None = None
    y_mrad: float | None = None
    parked: bool = False


@dataclass(frozen=True)
class LevelsSwitched(Message, event="levels"):
    """Whether levels are streamed, and the actuator that plays meanwhile."""

    on: bool
    actuator: int | None = None


@dataclass(frozen=True)
class ChannelLevel:
    """Level of one input over a tenth of a second; `rms_v` is taken about the offset."""

    rms_v: float
    peak_v: float
    offset_v: float
    range_v: float
    over_range: bool


@dataclass(frozen=True)
class InputLevels:
    """Levels of both inputs."""

    reference: ChannelLevel
    response: ChannelLevel


@dataclass(frozen=True)
class LevelMeasured(InputLevels, Message, event="level"):
    """Levels of both inputs; `light` is the vibrometer's signal level from 0 to 1, None where it has none."""

    light: float | None = None


@dataclass(frozen=True)
class Sweeping(Message, event="sweeping"):
    """A sweep begins."""

    actuator: int
    level_v: float


@dataclass(frozen=True)
class Defect:
    """What is wrong with a record: its code, and a sentence."""

    name: str
    sentence: str


@dataclass(frozen=True)
class SweepFigures:
    """The estimator's figures of a sweep, as of docs/reference/figures.md; NaN where silence leaves none."""

    snr_db: float
    residual_db: float
    noise_v: float
    latency_s: float
    clock_ppm: float
    defects: tuple[Defect, ...]


@dataclass(frozen=True)
class SweepTaken(Message, event="sweep"):
    """A sweep's recording in V, spectra in dB re 1 V/sqrt(Hz), and figures; `trouble` says why there are none."""

    actuator: int
    level_v: float
    start_hz: float
    stop_hz: float
    sample_rate_hz: float
    level: InputLevels
    figures: SweepFigures | None
    trouble: str
    reference_v: tuple[float, ...]
    response_v: tuple[float, ...]
    frequency_hz: tuple[float, ...]
    response_db: tuple[float, ...]
    noise_db: tuple[float, ...]


@dataclass(frozen=True)
class Muted(Message, event="muted"):
    """The outputs are silent."""


@dataclass(frozen=True)
class Reconnected(Message, event="reconnected"):
    """An instrument was opened afresh."""

    instrument: str


@dataclass(frozen=True)
class Refused(Message, event="refused"):
    """An order or an answer is wrong; the sentence says what is allowed."""

    sentence: str


@dataclass(frozen=True)
class Faulted(Message, event="fault"):
    """An instrument failed; `passing`: the order may be given again."""

    instrument: str
    device: str
    operation: str
    cause: str
    remedy: str
    passing: bool
    sentence: str


@dataclass(frozen=True)
class Done(Message, event="done"):
    """An order is over; its `order` and `id` as they were given."""

    sparse = True
    order: str | None = None
    id: str | int | float | None = None
    ok: bool = False


@dataclass(frozen=True)
class Ended(Message, event="ended"):
    """The last message: the outputs are muted, the mirror is parked."""

    muted: bool = True
    parked: bool = True


OPERATE_EVENTS = (
    Opening, Ready, MirrorMoved, LevelsSwitched, LevelMeasured, Sweeping, SweepTaken, Muted, Reconnected, Refused,
    Faulted, Done, Ended,
)  # fmt: skip


@dataclass(frozen=True)
class Playing(Message, event="playing"):
    """``wavefocus play``: a drive begins to play."""

    seconds: float
