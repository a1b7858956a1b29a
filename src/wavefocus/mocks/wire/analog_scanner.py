"""A pair of galvanometers that follow two analog outputs of the emulated NI box."""

import math
from collections.abc import Mapping
from dataclasses import dataclass

from wavefocus.mocks.virtual.mirror import MirrorMotion


@dataclass(frozen=True, slots=True)
class AnalogScanner:
    """Called with the levels of the box's outputs; the beam turns by twice the mirror's angle.

    motion: How the mirror moves.
    outputs: Names of the outputs of x and y.
    volts_per_degree: What its jumper is set to, which need not be what the rig file says.
    """

    motion: MirrorMotion
    outputs: tuple[str, str]
    volts_per_degree: float = 0.8

    def __call__(self, levels: Mapping[str, float]) -> None:
        """Follow new voltages."""
        x_v, y_v = (levels.get(name, 0.0) for name in self.outputs)
        mrad_per_v = 2 * 1000 * math.radians(1) / self.volts_per_degree
        self.motion.start(x_v * mrad_per_v, y_v * mrad_per_v)
