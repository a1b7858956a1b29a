"""Output devices by host API and name, never by index: indices change when something is plugged in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from drivers.identity import DeviceIdentity


@dataclass(frozen=True, slots=True)
class OutputDevice:
    """An output as PortAudio lists it.

    Parameters
    ----------
    index : int
        PortAudio's own, good for one process only.
    host_api, name : str
        Which driver model offers it (``"ASIO"``, ``"Core Audio"``, ``"JACK Audio Connection Kit"``) and its name there.
    channels : int
        Largest number of output channels.
    rate_hz : float
        The rate it is set to or prefers, in Hz.
    """

    index: int
    host_api: str
    name: str
    channels: int
    rate_hz: float

    @property
    def identity(self) -> DeviceIdentity:
        """Its name; PortAudio knows neither maker nor serial number.

        With ALSA the name ends in the card's number, " (hw:2,0)", which depends on what was plugged in first.
        """
        name = self.name.partition(" (hw:")[0] if self.host_api == "ALSA" else self.name
        return DeviceIdentity("", name)

    def __str__(self) -> str:
        return f"{self.name!r} ({self.host_api}, {self.channels} channels, {self.rate_hz:g} Hz)"


class DeviceChoiceError(Exception):
    """There is no device that is and does what was asked for, or more than one.

    Parameters
    ----------
    cause, remedy : str
        As of `drivers.errors.InstrumentError`.
    absent : bool
        Whether it may yet come, so that trying again can help.
    """

    def __init__(self, cause: str, remedy: str, *, absent: bool = False) -> None:
        super().__init__(f"{cause}; {remedy}")
        self.cause = cause
        self.remedy = remedy
        self.absent = absent


def choose(devices: Sequence[OutputDevice], host_apis: Sequence[str], host_api: str | None, name: str) -> OutputDevice:
    """The one device that is meant.

    Parameters
    ----------
    devices : sequence of OutputDevice
        What there is.
    host_apis : sequence of str
        What PortAudio was built with and finds at work.
    host_api : str or None
        Name of a host API, in either case; None for any.
    name : str
        The device's name, or a part of it that no other has.

    Raises
    ------
    DeviceChoiceError
        There is no such host API or device, or there are several.
    """
    apis = ", ".join(repr(one) for one in host_apis) or "none"
    if host_api is not None and host_api.casefold() not in (one.casefold() for one in host_apis):
        raise DeviceChoiceError(
            f"there is no host API {host_api!r}; there are {apis}",
            "start its server or install its driver, or correct player.host_api",
            absent=True,
        )
    within = [one for one in devices if host_api is None or one.host_api.casefold() == host_api.casefold()]
    exact = [one for one in within if one.name.casefold() == name.casefold()]
    found = exact or [one for one in within if name.casefold() in one.name.casefold()]
    if len(found) == 1:
        return found[0]
    if found:
        raise DeviceChoiceError(
            f"{len(found)} outputs are called that: {_listed(found)}",
            "set player.host_api and player.device to what only one of them has",
        )
    offered = f"host API {host_api!r} has" if host_api is not None else f"the host APIs {apis} have"
    raise DeviceChoiceError(
        f"there is no output of that name; {offered} {_listed(within)}",
        "plug it in and switch it on, or correct player.device",
        absent=True,
    )


def _listed(devices: Sequence[OutputDevice]) -> str:
    return ", ".join(str(one) for one in devices) or "no outputs"
