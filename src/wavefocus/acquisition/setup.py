"""A rig as the engine sees it: instruments, their wiring, conditions that are watched, and one record."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Literal, TypeAlias

from wavefocus.calibration import Float64Array
from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.protocols import (
    Clock,
    DeviceIdentity,
    Mirror,
    Player,
    Recorder,
    Recording,
    RecordLabel,
    RecordRequest,
)
from wavefocus.drivers.registry import VibrometerReading
from wavefocus.drivers.timeouts import RECONNECTING, Role

if TYPE_CHECKING:
    from wavefocus.config.rig import BandSection, RigConfig
    from wavefocus.config.rig_instruments import RecorderSection

Sensor = Callable[[], float]
"""Returns a value between two records, in the unit of its range, or raises InstrumentError."""


@dataclass(frozen=True, slots=True)
class AllowedRange:
    """Where a condition must stay.

    words: What it is, for people: ``"reference level"``.
    unit: Of all limits.
    band: Limits beyond which measuring is suspended, and those within which it goes on.
    """

    words: str
    unit: str
    band: BandSection

    def left(self, value: float) -> str:
        """Why this value is no good, in words; empty where it is."""
        least, most = self.band.leaves_below, self.band.leaves_above
        if least is not None and value < least:
            return f"{self.words} {value:.3g} {self.unit} is below {least:g} {self.unit}"
        if most is not None and value > most:
            return f"{self.words} {value:.3g} {self.unit} is above {most:g} {self.unit}"
        return ""

    def is_back(self, value: float) -> bool:
        """Whether this value lets measuring go on."""
        least, most = self.band.returns_above, self.band.returns_below
        return (least is None or value >= least) and (most is None or value <= most)


@dataclass(frozen=True, slots=True)
class Watch:
    """What is watched in a campaign.

    bands: Ranges by condition: ``"reference"`` (energy of the reference against what the drive makes, in dB) and
        ``"noise"`` (of the response above the sweep's band, as rms of white noise, in V) come from records; any other
        name needs a sensor.
    sensors: What is asked after each position.
    probe_every_s: How often it is looked whether all is well again, > 0.
    give_up_after_s: Longest suspension.
    """

    bands: Mapping[str, AllowedRange]
    sensors: Mapping[str, Sensor]
    probe_every_s: float = 30.0
    give_up_after_s: float = 7200.0


NOTHING_WATCHED = Watch({}, {})


# Longest wait for the mirror to stand still.
SETTLE_S = 5.0
# Larger differences between the stated delay of the response input and the device's are reported: 0.5 us are an error
# of -58 dB at 400 Hz.
MAX_DELAY_DIFFERENCE_S = 0.5e-6


@dataclass(frozen=True, slots=True)
class Openers:
    """A rig before it is opened: its file, and functions that open each instrument or raise InstrumentError.

    clock: The time that the instruments live by.
    connect: Plugs the response input of a virtual rig into one of its outputs, or into the vibrometer.
    sensors: Those that need no instrument: of a vibrometer's controller, and of a virtual rig's surroundings.
    """

    rig: RigConfig
    clock: Clock
    mirror: Callable[[], Mirror]
    recorder: Callable[[], Recorder]
    player: Callable[[], Player]
    vibrometer: Callable[[], VibrometerReading]
    connect: Callable[[str], object] | None = None
    sensors: Mapping[str, Sensor] = field(default_factory=dict)

    @property
    def limit_s(self) -> float:
        """Longest that each may take."""
        return RECONNECTING * self.rig.recovery.hung_after_s


@dataclass(frozen=True, slots=True)
class Setup:
    """The instruments of a rig, how they are wired and how they are calibrated.

    mirror, recorder, player: The instruments.
    clock: The time that they live by.
    mirror_map: From surface millimetres to mirror angles.
    actuator_channels: Player channel of each actuator, in the bank's order of actuators.
    loopback_channel: Player channel that is wired to the recorder's reference input.
    range_v: Input ranges in volts of (reference, response).
    response_per_volt: Response unit per DAQ volt, by default (m/s)/V: the vibrometer's sensitivity.
    reference_gain: DAQ volts on the reference channel per volt of drive.
    inter_channel_delay_s: How much later the response channel is sampled than the reference channel.
    vibrometer_latency_s: How much later the vibrometer's voltage is than the velocity that it stands for.
    pre_roll_s, post_roll_s: Recording before the player starts, and after it should have ended; the post-roll covers
        the player's unknown latency.
    recovery_s: How long a lost instrument is waited for before the session ends, >= 0.
    watch: Conditions under which measuring makes sense.
    response_ranges_v: Input ranges that the response may be measured with when it is over the configured one; none, if
        unknown.
    """

    mirror: Mirror
    recorder: Recorder
    player: Player
    clock: Clock
    mirror_map: MirrorMap
    actuator_channels: tuple[int, ...]
    loopback_channel: int
    range_v: tuple[float, float]
    response_per_volt: float
    reference_gain: float = 1.0
    inter_channel_delay_s: float = 0.0
    vibrometer_latency_s: float = 0.0
    pre_roll_s: float = 0.02
    post_roll_s: float = 0.1
    recovery_s: float = 600.0
    watch: Watch = NOTHING_WATCHED
    response_ranges_v: tuple[float, ...] = ()

    @property
    def response_delay_s(self) -> float:
        """How much later than the reference the surface is, as the response channel shows it."""
        return self.inter_channel_delay_s - self.vibrometer_latency_s

    def signals_v(self, signal_v: Float64Array, *actuators: int) -> dict[int, Float64Array]:
        """One signal for the loopback and some actuators, by player channel."""
        channels = [self.actuator_channels[actuator] for actuator in actuators]
        return dict.fromkeys((self.loopback_channel, *channels), signal_v)

    def close(self) -> None:
        """Mute the player, park the mirror and release every instrument, whatever fails on the way.

        Raises ExceptionGroup: of all that failed, after everything was tried. KeyboardInterrupt: an impatient Ctrl-C;
        it cut one step short, and the others were tried.
        """
        player, recorder, mirror = self.player, self.recorder, self.mirror
        try_all(player.mute, recorder.abort, mirror.park, player.close, recorder.close, mirror.close)


def try_all(*steps: Callable[[], object]) -> None:
    """Take every step, whatever fails on the way.

    Raises ExceptionGroup: of all that failed. KeyboardInterrupt: it cut one step short, and the others were tried.
    """
    failures: list[Exception] = []
    interrupt: KeyboardInterrupt | None = None
    for step in steps:
        try:
            step()
        except Exception as failure:
            failures.append(failure)
        except KeyboardInterrupt as impatience:
            interrupt = impatience
    if interrupt is not None:
        for also in failures:
            interrupt.add_note(str(also))
        raise interrupt
    if failures:
        raise ExceptionGroup("the instruments could not all be put to rest", failures)


def wired(
    rig: RigConfig, mirror: Mirror, recorder: Recorder, player: Player, clock: Clock, vibrometer: VibrometerReading
) -> Setup:
    """Open instruments with the wiring and the calibration of their rig file; nothing is watched."""
    wiring = rig.recorder
    return Setup(
        mirror=mirror,
        recorder=recorder,
        player=player,
        clock=clock,
        mirror_map=MirrorMap(rig.mirror.matrix),
        actuator_channels=rig.player.channels,
        loopback_channel=rig.player.loopback_channel,
        range_v=(wiring.reference_range_v, wiring.response_range_v),
        response_per_volt=vibrometer.sensitivity_m_s_per_v,
        reference_gain=wiring.reference_gain,
        inter_channel_delay_s=wiring.inter_channel_delay_s,
        vibrometer_latency_s=vibrometer.latency_s or 0.0,
        pre_roll_s=wiring.pre_roll_s,
        post_roll_s=wiring.post_roll_s,
        recovery_s=rig.recovery.give_up_after_s,
    )


@contextmanager
def naming_role(role: Role) -> Iterator[None]:
    """Note the role on an error that its instrument raises: drivers name devices, recovery needs the role.

    role: Whose methods are called inside.
    """
    try:
        yield
    except InstrumentError as failure:
        failure.role = failure.role or role
        raise


def to_lost_error(failure: InstrumentError, cause: str) -> InstrumentLostError:
    """A failure in the words of a loss, of the same role."""
    lost = InstrumentLostError(failure.instrument, failure.operation, cause, failure.remedy)
    lost.role = failure.role
    return lost


ROLES: tuple[Role, ...] = ("mirror", "recorder", "player")


def names_of(setup: Setup) -> dict[str, str]:
    """What mirror, recorder and player say they are, by role.

    Raises InstrumentLostError: one does not say; not even passingly may that fail in an instrument that was just
    opened. InstrumentError: it says that it is another.
    """

    def name(role: Role) -> str:
        try:
            with naming_role(role):
                return str(getattr(setup, role).identify())
        except TransientInstrumentError as failure:
            raise to_lost_error(failure, failure.cause) from failure

    return {role: name(role) for role in ROLES}


def silence(setup: Setup) -> list[InstrumentError]:
    """Mute the player, drop a record under way and close the shutter, if any, each whatever the others do.

    Returns what failed, with its role; empty when all is silent.
    """
    player, recorder, mirror = setup.player.mute, setup.recorder.abort, setup.mirror.block
    steps: dict[Role, Callable[[], None]] = {"player": player, "recorder": recorder, "mirror": mirror}
    failures: list[InstrumentError] = []
    for role, quieten in steps.items():
        try:
            with naming_role(role):
                quieten()
        except InstrumentError as failure:
            failures.append(failure)
    return failures


# Steps of a record: the recorder is about to be started; it has started; the player has the signals.
Step = Literal["starting", "started", "playing"]
# A driver that has not answered this long after the record should have ended is not going to.
ANSWER_MARGIN_S = 5.0


RecordMargins: TypeAlias = "Setup | RecorderSection"
"""What says how long a record is before and after its signal."""


def record_samples(margins: RecordMargins, signal_samples: int, sample_rate_hz: float) -> int:
    """Samples per channel of a record around a signal, pre-roll and post-roll included."""
    return round((margins.pre_roll_s + margins.post_roll_s) * sample_rate_hz) + signal_samples


def take_record(
    setup: Setup,
    signals_v: Mapping[int, Float64Array],
    sample_rate_hz: float,
    label: RecordLabel,
    samples: int | None = None,
    reached: Callable[[Step], object] = lambda step: None,
) -> Recording:
    """Play signals and record reference and response around them.

    The recorder starts first: none of the low-cost DAQ boxes can trigger on an
    audio-level signal, so start offset and clock ratio are found from the reference
    channel afterwards.

    signals_v, mapping from player channel to float64 (samples,): Output volts, all of one length.
    sample_rate_hz: Rate of the signals and of the record.
    label: What the record is for.
    samples: Samples of the record; by default ``record_samples(...)``, so that it outlasts the signal.
    reached: Called when a step is reached, so that its instant can be noted.

    Returns as many samples of both channels.
    Raises InstrumentError: of the instrument that failed, with its role; the player is muted and the recorder stopped.
    An instrument that cannot even be silenced after a passing failure counts as lost.
    """
    whole = record_samples(setup, len(next(iter(signals_v.values()))), sample_rate_hz)
    request = RecordRequest(whole if samples is None else samples, sample_rate_hz, setup.range_v, label)
    timeout_s = max(request.duration_s, whole / sample_rate_hz) + ANSWER_MARGIN_S
    player, recorder = setup.player, setup.recorder
    try:
        reached("starting")
        with naming_role("recorder"):
            recorder.start(request)
        reached("started")
        setup.clock.sleep(setup.pre_roll_s)
        with naming_role("player"):
            player.play(signals_v, sample_rate_hz)
            reached("playing")
            player.wait(timeout_s)
        with naming_role("recorder"):
            return recorder.read(timeout_s)
    except BaseException as failure:
        for also in silence(setup):
            if isinstance(failure, TransientInstrumentError):
                raise to_lost_error(also, also.cause) from failure
            failure.add_note(str(also))
        raise


def record_silence(
    recorder: Recorder, seconds: float, sample_rate_hz: float, range_v: tuple[float, float], label: RecordLabel
) -> Recording:
    """Record for a while, > 0 s, while nothing plays; raises InstrumentError of the recorder, which was stopped."""
    request = RecordRequest(max(1, round(seconds * sample_rate_hz)), sample_rate_hz, range_v, label)
    with naming_role("recorder"):
        try:
            recorder.start(request)
            return recorder.read(request.duration_s + ANSWER_MARGIN_S)
        except BaseException:
            recorder.abort()
            raise


def start_move(setup: Setup, x_mm: float, y_mm: float) -> None:
    """Let the mirror set out for a place, and return at once.

    Raises InstrumentError: of the mirror.
    """
    x_mrad, y_mrad = setup.mirror_map.angles_mrad(x_mm, y_mm)
    with naming_role("mirror"):
        setup.mirror.move_to(float(x_mrad), float(y_mrad))


def point_at(setup: Setup, x_mm: float, y_mm: float) -> None:
    """Point at a place and wait until the beam stands; where the move is under way already, this only waits.

    Raises InstrumentError: of the mirror.
    """
    start_move(setup, x_mm, y_mm)
    with naming_role("mirror"):
        setup.mirror.wait_settled(SETTLE_S)


def identities_of(setup: Setup) -> dict[str, DeviceIdentity]:
    """Who mirror, recorder and player are, by role."""
    return {role: getattr(setup, role).identity for role in ROLES}
