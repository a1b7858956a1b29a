"""The roles of a rig, for blame and for silence: whose call failed, and how all fall silent."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal

from drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from drivers.protocols import Instrument, Instruments

Role = Literal["mirror", "recorder", "player"]


@contextmanager
def asking(role: Role) -> Iterator[None]:
    """Note the role on an error that its instrument raises: drivers name devices, recovery needs to know whose.

    Parameters
    ----------
    role : str
        Whose methods are called inside.
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

    Raises
    ------
    InstrumentLostError
        One does not say; not even passingly may that fail in an instrument that was just opened.
    InstrumentError
        It says that it is another.
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

    Returns
    -------
    list of InstrumentError
        What failed, with its role; empty when all is silent.
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
