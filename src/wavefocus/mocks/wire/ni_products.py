"""NI boxes: what each can do, by its data sheet, and how it turns volts into counts.

Sources: NI USB-621x user manual and specifications (one converter behind a multiplexer); NI 6356 specifications (a
converter for each input, 1.25 MS/s per channel).
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from wavefocus.drivers.protocols import Float64Array

DIFFERENTIAL, RSE, NRSE = "differential", "rse", "nrse"


@dataclass(frozen=True, slots=True)
class Converter:
    """One input's way from volts to codes and, as NI-DAQmx scales them, back to volts.

    range_v: Range of the input in volts, to either side.
    bits: Bits of a code.
    offset_v, step_v: Volts at code 0 and per code, as calibrated.
    """

    range_v: float
    bits: int
    offset_v: float
    step_v: float

    def volts(self, analog_v: Float64Array) -> Float64Array:
        """What the driver reports for some voltages: whole codes, those at the end where it is beyond."""
        codes = np.rint((analog_v - self.offset_v) / self.step_v)
        np.clip(codes, -(2 ** (self.bits - 1)), 2 ** (self.bits - 1) - 1, out=codes)
        return np.asarray(self.offset_v + self.step_v * codes)


@dataclass(frozen=True, slots=True)
class Product:
    """One model.

    name: As NI-DAQmx gives it: ``"USB-6211"``.
    inputs: Single-ended analog inputs.
    pair: Inputs k and k + pair make differential input k.
    ranges_v: Ranges to either side of 0 V, smallest first.
    aggregate_hz: Conversions per second, all channels together; of each channel, where sampling is simultaneous.
    timebase_hz: What sample rates are whole fractions of.
    triggers: Terminals that can start a task.
    spare_codes: Part of the codes outside the range.
    simultaneous: Whether every input has a converter of its own.
    outputs: Analog outputs.
    output_range_v: Lowest and highest output voltage.
    lines: Digital outputs: ``"port0/line0"`` and so on.
    """

    name: str
    inputs: int
    pair: int
    bits: Mapping[str, int]
    ranges_v: Mapping[str, tuple[float, ...]]
    aggregate_hz: float
    timebase_hz: float
    triggers: tuple[str, ...]
    spare_codes: float = 0.0
    simultaneous: bool = False
    outputs: int = 2
    output_range_v: tuple[float, float] = (-10.0, 10.0)
    lines: tuple[str, ...] = ()

    @property
    def all_ranges_v(self) -> tuple[float, ...]:
        """Ranges of any terminal configuration, smallest first."""
        return tuple(sorted({range_v for ranges_v in self.ranges_v.values() for range_v in ranges_v}))

    @property
    def slowest_hz(self) -> float:
        """Lowest sample rate: a 32-bit divider of the timebase."""
        return self.timebase_hz / 2**32

    def terminals(self, number: int) -> tuple[str, ...]:
        """Terminal configurations that an input can have."""
        paired = number % (2 * self.pair) < self.pair
        return tuple(terminal for terminal in self.bits if paired or terminal != DIFFERENTIAL)

    def range_v(self, terminal: str, largest_v: float) -> float | None:
        """Smallest range that a voltage fits into, None if it fits into none."""
        return next((range_v for range_v in self.ranges_v[terminal] if largest_v <= range_v * (1 + 1e-9)), None)

    def converter(self, terminal: str, range_v: float, serial_number: int, number: int) -> Converter:
        """The converter at one input, with the small errors that its calibration corrects.

        serial_number: Of the box: every box has errors of its own.
        """
        bits = self.bits[terminal]
        nominal_v = 2 * range_v * (1 + self.spare_codes) / 2**bits
        offset, gain = np.random.default_rng([serial_number, number, round(1000 * range_v)]).uniform(-1, 1, 2)
        return Converter(range_v, bits, 3.0 * offset * nominal_v, nominal_v * (1 + 5e-4 * gain))

    def fastest_hz(self, channels: int) -> float:
        """Highest sample rate of a task."""
        return self.aggregate_hz if self.simultaneous else self.aggregate_hz / channels

    def coerced_rate_hz(self, rate_hz: float) -> float:
        """The rate nearest above that the timebase gives."""
        return self.timebase_hz / max(1, math.floor(self.timebase_hz / rate_hz * (1 + 1e-12)))

    def channel_delay_s(self, rate_hz: float, channels: int) -> float:
        """How much later each channel of a task is converted than the one before."""
        if self.simultaneous:
            return 0.0
        fastest_s = 1 / self.aggregate_hz
        share_s = 1 / (rate_hz * channels)
        # NI-DAQmx converts as fast as the box can and adds this for settling, where the sample rate leaves room for it;
        # else it spreads the conversions evenly (USB-621x user manual, AI Convert Clock; property AI Convert Rate).
        return max(fastest_s, min(fastest_s + 10e-6, share_s))


def _lines(port: int, count: int) -> tuple[str, ...]:
    return tuple(f"port{port}/line{number}" for number in range(count))


RANGES_621X_V = (0.2, 1.0, 5.0, 10.0)

# Part of the codes that the USB-621x keep outside the range for their calibration (user manual, table 4-1: 320 uV per
# code at +-10 V).
PRODUCTS = {
    product.name: product
    for product in (
        Product(
            name="USB-6211",
            inputs=16,
            pair=8,
            bits={DIFFERENTIAL: 16, RSE: 16, NRSE: 16},
            ranges_v={DIFFERENTIAL: RANGES_621X_V, RSE: RANGES_621X_V, NRSE: RANGES_621X_V},
            aggregate_hz=250e3,
            timebase_hz=20e6,
            triggers=tuple(f"PFI{number}" for number in range(4)),
            spare_codes=0.05,
            lines=_lines(1, 4),
        ),
        Product(
            name="USB-6356",
            inputs=8,
            pair=8,
            bits={DIFFERENTIAL: 16},
            ranges_v={DIFFERENTIAL: (1.0, 2.0, 5.0, 10.0)},
            aggregate_hz=1.25e6,
            timebase_hz=100e6,
            triggers=tuple(f"PFI{number}" for number in range(16)),
            simultaneous=True,
            outputs=0,
            lines=_lines(0, 8),
        ),
    )
}
"""Models by name: one with a converter behind a multiplexer, and one with a converter for each input.

The USB-6356 that is emulated has no analog outputs, so that a rig without them is met.
"""
