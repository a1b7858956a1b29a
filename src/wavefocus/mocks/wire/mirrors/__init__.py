"""Emulated mirror controllers, one module for each dialect of drivers/mirror/."""

from __future__ import annotations

import re

from wavefocus.drivers.registry import Registry
from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.emulated_serial import SerialDevice


class MirrorDevice(SerialDevice):
    """A controller with one mirror, as the commands of a dialect reach it."""

    role = "mirror"
    name: str

    def __init__(self, motion: MirrorMotion) -> None:
        self._motion = motion

    @classmethod
    def turning(cls, motion: MirrorMotion, full_scale_mrad: float | None) -> MirrorDevice:
        """A device whose mirror turns by this angle at full deflection, by default as far as its kind does."""
        return cls(motion)

    def restart(self) -> None:
        """Forget what power-off makes it forget."""
        self._motion.start(0.0, 0.0)


MIRROR_DEVICES: Registry[type[MirrorDevice]] = Registry("wavefocus.mocks.wire.mirrors")


def mirror_device(dialect: str, motion: MirrorMotion, full_scale_mrad: float | None = None) -> MirrorDevice:
    """A device that speaks a dialect. Raises ValueError.

    motion: How its mirror moves. Of a mirror that cannot be asked whether it moves, the longest move must be shorter
        than the settling time of the driver.
    full_scale_mrad: Optical angle at full deflection.
    """
    devices = MIRROR_DEVICES.all()
    if dialect not in devices:
        raise ValueError(f"there is no mirror dialect {dialect!r}; there are {', '.join(devices)}")
    return devices[dialect].turning(motion, full_scale_mrad)


NUMBER = re.compile(r"[+-]?(?:\d+\.?\d*|\.\d+)")


def number(text: str | None) -> float | None:
    """The number that a text is, or None."""
    return float(text) if text is not None and NUMBER.fullmatch(text) else None
