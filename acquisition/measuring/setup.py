"""A rig as the engine sees it: instruments, wiring and calibration; whose call failed, and how all fall silent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from acquisition.quality.watch import NOTHING_WATCHED, Watch
from calibration.rig.mirror_map import MirrorMap
from drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from drivers.protocols import Float64Array, Instrument, Instruments
from drivers.timeouts import Role


@dataclass(frozen=True, slots=True)
class Setup:
    """The instruments of a rig, how they are wired and how they are calibrated.

    instruments: Mirror, recorder, player and the clock they live by.
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
    settle_timeout_s: Longest wait for the mirror to stand still.
    recovery_s: How long a lost instrument is waited for before the session ends, >= 0.
    watch: Conditions under which measuring makes sense.
    response_ranges_v: Input ranges that the response may be measured with when it is over the configured one; none, if
        unknown.
    """

    instruments: Instruments
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
    settle_timeout_s: float = 5.0
    recovery_s: float = 600.0
    watch: Watch = NOTHING_WATCHED
    response_ranges_v: tuple[float, ...] = ()

    @property
    def response_delay_s(self) -> float:
        """How much later than the reference the surface is, as the response channel shows it."""
        return self.inter_channel_delay_s - self.vibrometer_latency_s

    @property
    def widest_response_v(self) -> float:
        """Largest input range that the response may be measured with."""
        return max((self.range_v[1], *self.response_ranges_v))

    def signals_v(self, signal_v: Float64Array, *actuators: int) -> dict[int, Float64Array]:
        """One signal for the loopback and some actuators, by player channel."""
        return dict.fromkeys((self.loopback_channel, *(self.actuator_channels[one] for one in actuators)), signal_v)

    def close(self) -> None:
        """Mute the player, park the mirror and release every instrument, whatever fails on the way.

        Raises ExceptionGroup: of all that failed, after everything was tried. KeyboardInterrupt: an impatient Ctrl-C;
        it cut one step short, and the others were tried.
        """
        failures: list[Exception] = []
        interrupt: KeyboardInterrupt | None = None
        roles = self.instruments
        for step in (
            roles.player.mute,
            roles.recorder.abort,
            roles.mirror.park,
            roles.player.close,
            roles.recorder.close,
            roles.mirror.close,
        ):
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


@contextmanager
def asking(role: Role) -> Iterator[None]:
    """Note the role on an error that its instrument raises: drivers name devices, recovery needs the role.

    role: Whose methods are called inside.
    """
    try:
        yield
    except InstrumentError as failure:
        failure.role = failure.role or role
        raise


def as_lost(failure: InstrumentError, cause: str) -> InstrumentLostError:
    """A failure in the words of a loss, of the same role."""
    lost = InstrumentLostError(failure.instrument, failure.operation, cause, failure.remedy)
    lost.role = failure.role
    return lost


def instrument_of(instruments: Instruments, role: str) -> Instrument:
    """The instrument that has a role."""
    by_role: dict[str, Instrument] = {
        "mirror": instruments.mirror,
        "recorder": instruments.recorder,
        "player": instruments.player,
    }
    return by_role[role]


def names_of(instruments: Instruments) -> tuple[str, str, str]:
    """What mirror, recorder and player say they are.

    Raises InstrumentLostError: one does not say; not even passingly may that fail in an instrument that was just
    opened. InstrumentError: it says that it is another.
    """
    try:
        with asking("mirror"):
            mirror = instruments.mirror.identify()
        with asking("recorder"):
            recorder = instruments.recorder.identify()
        with asking("player"):
            return mirror, recorder, instruments.player.identify()
    except TransientInstrumentError as failure:
        raise as_lost(failure, failure.cause) from failure


def silence(instruments: Instruments) -> list[InstrumentError]:
    """Mute the player and drop a record under way, each whatever the other does.

    Returns what failed, with its role; empty when all is silent.
    """
    failures: list[InstrumentError] = []
    roles: tuple[Role, Role] = ("player", "recorder")
    for role, quieten in zip(roles, (instruments.player.mute, instruments.recorder.abort), strict=True):
        try:
            with asking(role):
                quieten()
        except InstrumentError as failure:
            failures.append(failure)
    return failures
