"""Properties of the emulated NI-DAQmx by the numbers that travel on the wire.

The numbers are those of the header NIDAQmx.h; the nidaqmx package has the same ones.
"""

from __future__ import annotations

from typing import Any

from mocks.wire.ni.ni_errors import NOT_SUPPORTED, NiError
from mocks.wire.ni.ni_products import Product
from mocks.wire.ni.ni_tasks import Channel

ANALOG_INPUT = 10100  # nidaqmx.constants.ChannelType
VOLTAGE = 10322  # nidaqmx.constants.UsageTypeAI


def device_value(product: Product, name: str, serial_number: int, attribute: int) -> Any:
    """A property of the device. Raises NiError."""
    ranges_v = [bound for range_v in product.all_ranges_v for bound in (-range_v, range_v)]
    values = {
        0x0631: product.name,
        0x0632: serial_number,
        0x231E: ", ".join(f"{name}/ai{number}" for number in range(product.inputs)),
        0x2A40: ", ".join(f"/{name}/{terminal}" for terminal in product.triggers),
        0x06CA: False,  # simulated
        0x2985: True,  # digital trigger supported
        0x2984: False,  # analog trigger supported
        0x298F: product.simultaneous,  # simultaneous sampling supported
        0x298C: product.aggregate_hz,
        0x298D: product.aggregate_hz,
        0x298E: product.slowest_hz,
        0x2990: ranges_v,
    }
    return found(values, attribute)


def channel_value(channel: Channel, device: str, attribute: int) -> Any:
    """A property of a channel. Raises NiError."""
    converter = channel.converter
    values = {
        0x1765: float(converter.bits),
        0x1815: converter.range_v,
        0x1816: -converter.range_v,
        0x17DD: converter.range_v,
        0x17DE: -converter.range_v,
        0x1930: [converter.offset_v, converter.step_v, 0.0, 0.0],
        0x187F: ANALOG_INPUT,
        0x0695: VOLTAGE,
        0x18F5: f"{device}/{channel.input}",
    }
    return found(values, attribute)


def found(values: dict[int, Any], attribute: int) -> Any:
    """The value of a property among those that there are; raises `NiError` for others."""
    if attribute not in values:
        raise NiError(NOT_SUPPORTED, f"Property: {attribute:#x}")
    return values[attribute]
