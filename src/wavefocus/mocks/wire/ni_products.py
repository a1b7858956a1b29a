"""NI boxes: what each can do, by its data sheet, and how it turns volts into counts.

Sources: NI USB-621x user manual and specifications (one converter behind a multiplexer); NI 6356 specifications (a
converter for each input, 1.25 MS/s per channel).
"""

import math
from dataclasses import dataclass

import numpy as np

from wavefocus.drivers.protocols import Float64Array

DIFFERENTIAL, RSE, NRSE = "differential", "rse", "nrse"
_CODES = 2**16
"""Codes of a converter."""
_PAIR = 8
"""Inputs k and k + _PAIR make differential input k."""
OUTPUT_V = 10.0
"""Largest output voltage to either side."""
SINGLE_ENDED_V = 10.0
"""Largest range of a single-ended input (USB-6008/6009 specifications: 20 V between two inputs alone)."""


@dataclass(frozen=True, slots=True)
class Channel:
    """One voltage channel, from volts to codes and, as NI-DAQmx scales them, back to volts.

    name: In the task.
    input: ``"ai0"``.
    range_v: Range of the input in volts, to either side.
    offset_v, step_v: Volts at code 0 and per code, as calibrated.
    """

    name: str
    input: str
    range_v: float
    offset_v: float
    step_v: float

    def converted(self, analog_v: Float64Array) -> Float64Array:
        """What the driver reports for some voltages: whole codes, those at the end where it is beyond."""
        codes = np.clip(np.rint((analog_v - self.offset_v) / self.step_v), -_CODES // 2, _CODES // 2 - 1)
        return np.asarray(self.offset_v + self.step_v * codes)


@dataclass(frozen=True, slots=True)
class Product:
    """One model.

    name: As NI-DAQmx gives it: ``"USB-6211"``.
    inputs: Single-ended analog inputs.
    terminals: Terminal configurations.
    ranges_v: Ranges to either side of 0 V, smallest first.
    aggregate_hz: Conversions per second, all channels together; of each channel, where sampling is simultaneous.
    timebase_hz: What sample rates are whole fractions of.
    triggers: Terminals that can start a task.
    outputs: Analog outputs.
    lines: Digital outputs: ``"port0/line0"`` and so on.
    spare_codes: Part of the codes outside the range.
    simultaneous: Whether every input has a converter of its own.
    """

    name: str
    inputs: int
    terminals: tuple[str, ...]
    ranges_v: tuple[float, ...]
    aggregate_hz: float
    timebase_hz: float
    triggers: tuple[str, ...]
    outputs: int
    lines: tuple[str, ...]
    spare_codes: float = 0.0
    simultaneous: bool = False

    @property
    def slowest_hz(self) -> float:
        """Lowest sample rate: a 32-bit divider of the timebase."""
        return self.timebase_hz / 2**32

    def terminals_of(self, number: int) -> tuple[str, ...]:
        """Terminal configurations that an input can have."""
        paired = number % (2 * _PAIR) < _PAIR
        return tuple(terminal for terminal in self.terminals if paired or terminal != DIFFERENTIAL)

    def channel(self, name: str, number: int, largest_v: float, serial_number: int) -> Channel | None:
        """A channel of the smallest range that a voltage fits into; None if it fits into none.

        serial_number: Of the box: every box has small errors of its own, which its calibration corrects.
        """
        range_v = next((range_v for range_v in self.ranges_v if largest_v <= range_v * (1 + 1e-9)), None)
        if range_v is None:
            return None
        nominal_v = 2 * range_v * (1 + self.spare_codes) / _CODES
        offset, gain = np.random.default_rng([serial_number, number, round(1000 * range_v)]).uniform(-1, 1, 2)
        return Channel(name, f"ai{number}", range_v, 3.0 * offset * nominal_v, nominal_v * (1 + 5e-4 * gain))

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
        # NI-DAQmx converts as fast as the box can and adds 10 us for settling, where the sample rate leaves room for
        # it; else it spreads the conversions evenly (USB-621x user manual, AI Convert Clock; property AI Convert Rate).
        return max(fastest_s, min(fastest_s + 10e-6, 1 / (rate_hz * channels)))


PRODUCTS = {
    product.name: product
    for product in (
        Product(
            name="USB-6211",
            inputs=16,
            terminals=(DIFFERENTIAL, RSE, NRSE),
            ranges_v=(0.2, 1.0, 5.0, 10.0),
            aggregate_hz=250e3,
            timebase_hz=20e6,
            triggers=tuple(f"PFI{number}" for number in range(4)),
            outputs=2,
            lines=tuple(f"port1/line{number}" for number in range(4)),
            spare_codes=0.05,  # kept for calibration (user manual, table 4-1: 320 uV per code at +-10 V)
        ),
        Product(
            name="USB-6356",
            inputs=8,
            terminals=(DIFFERENTIAL,),
            ranges_v=(1.0, 2.0, 5.0, 10.0),
            aggregate_hz=1.25e6,
            timebase_hz=100e6,
            triggers=tuple(f"PFI{number}" for number in range(16)),
            outputs=0,
            lines=tuple(f"port0/line{number}" for number in range(8)),
            simultaneous=True,
        ),
    )
}
"""Models by name: one with a converter behind a multiplexer, and one with a converter for each input.

The USB-6356 that is emulated has no analog outputs, so that a rig without them is met.
"""
