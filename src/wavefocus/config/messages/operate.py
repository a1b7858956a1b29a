"""Orders to ``wavefocus operate``, and the events of ``operate``, ``calibrate`` and ``play``."""

from collections.abc import Mapping

from wavefocus.config.messages import EventMessage, Message, Number, OrderMessage, Refused
from wavefocus.drivers.timeouts import Role

Numbers = tuple[Number, Number]


SWEEP_BAND_HZ = (40.0, 400.0)


class RigOrder(OrderMessage, frozen=True, kw_only=True):
    """Base class of orders; the `done` that ends one repeats its `id`."""

    id: str | int | float | None = None


class Jog(RigOrder, frozen=True, tag="jog"):
    """Send the beam to a place on the surface, or to angles."""

    x_mm: float | None = None
    y_mm: float | None = None
    x_mrad: float | None = None
    y_mrad: float | None = None


class Park(RigOrder, frozen=True, tag="park"):
    """Send the beam to the safe direction."""


class ShowLevel(RigOrder, frozen=True, tag="level"):
    """Stream levels, or stop; one actuator plays short sweeps meanwhile, where one is named."""

    on: bool = True
    every_s: float = 0.25
    actuator: int | None = None
    level_v: float | None = None


class TakeSweep(RigOrder, frozen=True, tag="sweep"):
    """Record silence and one sweep of an actuator; `level_v` is a peak, by default a safe one."""

    actuator: int
    level_v: float | None = None
    start_hz: float = SWEEP_BAND_HZ[0]
    stop_hz: float = SWEEP_BAND_HZ[1]
    duration_s: float = 0.5


class Mute(RigOrder, frozen=True, tag="mute"):
    """Mute the outputs at once; levels stop too."""


class ReportState(RigOrder, frozen=True, tag="state"):
    """Report where the beam is and whether levels are on."""


class Reconnect(RigOrder, frozen=True, tag="reconnect"):
    """Open a lost instrument afresh."""

    instrument: Role


class End(RigOrder, frozen=True, tag="end"):
    """Mute, park and end."""


ORDERS = (Jog, Park, ShowLevel, TakeSweep, Mute, ReportState, Reconnect, End)


class Opening(EventMessage, frozen=True, tag="opening"):
    """The rig's instruments are being opened."""

    rig: str


class SurfaceSize(Message, frozen=True):
    """Kind and size of a surface, and the corners of a polygon, as in a rig file."""

    kind: str
    length_mm: Number
    width_mm: Number
    corners_mm: tuple[Numbers, ...] | None = None


class Ready(EventMessage, frozen=True, tag="ready"):
    """The rig is open: its instruments by role, whether its mirror map was measured, and its limits."""

    name: str
    instruments: Mapping[str, str]
    surface: SurfaceSize
    actuator_mm: tuple[Numbers, ...]
    mapped: bool
    limit_mrad: Number
    level_v: Number
    largest_level_v: Number
    band_hz: Numbers
    range_v: Numbers


class MirrorMoved(EventMessage, frozen=True, tag="mirror"):
    """Where the beam was sent; None before the first move, and in millimetres where it does not meet the surface."""

    x_mm: float | None = None
    y_mm: float | None = None
    x_mrad: float | None = None
    y_mrad: float | None = None
    parked: bool = False


class LevelsSwitched(EventMessage, frozen=True, tag="levels"):
    """Whether levels are streamed, and the actuator that plays meanwhile."""

    on: bool
    actuator: int | None = None


class ChannelLevel(Message, frozen=True):
    """Level of one input over a tenth of a second; `rms_v` is taken about the offset."""

    rms_v: Number
    peak_v: Number
    offset_v: Number
    range_v: Number
    over_range: bool


class InputLevels(Message, frozen=True):
    """Levels of both inputs."""

    reference: ChannelLevel
    response: ChannelLevel


class LevelMeasured(InputLevels, EventMessage, frozen=True, tag="level"):
    """Levels of both inputs; `light` is the vibrometer's signal level from 0 to 1, None where it has none."""

    light: float | None = None


class Sweeping(EventMessage, frozen=True, tag="sweeping"):
    """A sweep begins."""

    actuator: int
    level_v: Number


class Defect(Message, frozen=True):
    """What is wrong with a record: its code, and a sentence."""

    name: str
    sentence: str


class SweepFigures(Message, frozen=True):
    """The estimator's figures of a sweep, as of docs/reference/figures.md; NaN where silence leaves none."""

    snr_db: Number
    residual_db: Number
    noise_v: Number
    latency_s: Number
    clock_ppm: Number
    defects: tuple[Defect, ...]


class SweepTaken(EventMessage, frozen=True, tag="sweep"):
    """A sweep's recording in V, spectra in dB re 1 V/sqrt(Hz), and figures; `trouble` says why there are none."""

    actuator: int
    level_v: Number
    start_hz: Number
    stop_hz: Number
    sample_rate_hz: Number
    level: InputLevels
    figures: SweepFigures | None
    trouble: str
    reference_v: tuple[Number, ...]
    response_v: tuple[Number, ...]
    frequency_hz: tuple[Number, ...]
    response_db: tuple[Number, ...]
    noise_db: tuple[Number, ...]


class Muted(EventMessage, frozen=True, tag="muted"):
    """The outputs are silent."""


class Reconnected(EventMessage, frozen=True, tag="reconnected"):
    """An instrument was opened afresh."""

    instrument: str


class Faulted(EventMessage, frozen=True, tag="fault"):
    """An instrument failed; `passing`: the order may be given again."""

    instrument: str
    device: str
    operation: str
    cause: str
    remedy: str
    passing: bool
    sentence: str


class Done(EventMessage, frozen=True, tag="done", kw_only=True, omit_defaults=True):
    """An order is over; its `order` and `id` as they were given."""

    ok: bool
    order: str | None = None
    id: str | int | float | None = None


class Ended(EventMessage, frozen=True, tag="ended"):
    """The last message: the outputs are muted, the mirror is parked."""

    muted: bool = True
    parked: bool = True


OPERATE_EVENTS = (
    Opening, Ready, MirrorMoved, LevelsSwitched, LevelMeasured, Sweeping, SweepTaken, Muted, Reconnected, Refused,
    Faulted, Done, Ended,
)  # fmt: skip


class DrivePlaying(EventMessage, frozen=True, tag="playing"):
    """``wavefocus play``: a drive begins to play."""

    seconds: Number
