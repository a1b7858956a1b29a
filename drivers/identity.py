"""Who a device is, for comparing the device of one run with that of another."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class DeviceIdentity:
    """Who a device says it is, without its settings and without the way to it; equal for the same device in any run.

    Parameters
    ----------
    maker, product, serial : str
        As the device states them; empty where it does not. A device that answers with one text, whose parts nobody
        has specified, has that text as its product.
    """

    maker: str
    product: str
    serial: str = ""

    def __str__(self) -> str:
        name = f"{self.maker} {self.product}".strip()
        return f"{name}, serial number {self.serial}" if self.serial else name
