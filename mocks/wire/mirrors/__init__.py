"""Emulated mirror controllers, one module for each dialect of drivers/mirror/."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import ClassVar

from drivers.registry import Registry
from mocks.wire.mirrors.motion import MirrorMotion


class MirrorDevice(ABC):
    """A controller with one mirror, as the commands of a dialect reach it; implements `SerialDevice`.

    baud: Bits per second that it listens at.
    command_end: The character that ends a command.
    """

    role = "mirror"
    name: str
    baud: ClassVar[int] = 115200
    command_end: ClassVar[str] = "\n"

    def __init__(self, motion: MirrorMotion) -> None:
        self._motion = motion

    @classmethod
    def turning(cls, motion: MirrorMotion, full_scale_mrad: float | None) -> MirrorDevice:
        """A device whose mirror turns by so much at full deflection, by default as far as its kind does."""
        return cls(motion)

    @abstractmethod
    def operation(self, command: str) -> str:
        """The verb of a command in fault plans: identify, move, park, busy, where, enable, or its own."""

    @abstractmethod
    def answer(self, command: str) -> str:
        """Carry a command out and answer it, line ends included; empty where there is no answer."""

    @abstractmethod
    def refusal(self, command: str) -> str:
        """An error code in place of an answer."""

    @abstractmethod
    def impostor(self, command: str) -> str:
        """What another device would answer to the question who it is."""

    def restart(self) -> None:
        """Forget what power-off makes it forget."""
        self._motion.start(0.0, 0.0)


MIRROR_DEVICES: Registry[type[MirrorDevice]] = Registry("mocks.wire.mirrors")


def mirror_device(dialect: str, motion: MirrorMotion, full_scale_mrad: float | None = None) -> MirrorDevice:
    """A device that speaks a dialect. Raises ValueError.

    motion: How its mirror moves. Of a mirror that cannot be asked whether it moves, the longest move must be shorter
        than the settling time of the near side.
    full_scale_mrad: Optical angle at full deflection.
    """
    devices = MIRROR_DEVICES.all()
    if dialect not in devices:
        raise ValueError(f"there is no mirror dialect {dialect!r}; there are {', '.join(devices)}")
    return devices[dialect].turning(motion, full_scale_mrad)
