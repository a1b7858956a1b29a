"""Plates: responses from actuators to positions, by the plate's name; a new one is a module here."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy
from numpy.typing import NDArray

from wavefocus.config.outline import Outline
from wavefocus.drivers.registry import Registry

Float64Array = NDArray[np.float64]
Complex64Array = NDArray[np.complex64]
Complex128Array = NDArray[np.complex128]
Chain = Callable[[Float64Array], Complex128Array]
"""A transfer function of the frequency in Hz."""

MAGNET_RADIUS_MM = 2.5  # the paper, section IV.A: magnets 5 mm across


@dataclass(frozen=True, slots=True)
class PlateChange:
    """Factors on a plate's wave speed and loss, its density being the same. Raises ValueError.

    Loss is the damping of a gel, and the reciprocal of the quality factor of glass.
    """

    speed: float = 1.0
    loss: float = 1.0

    def __post_init__(self) -> None:
        if not (self.speed > 0 and self.loss >= 0):
            raise ValueError(
                f"at this temperature wave speed and loss would be {self.speed:g} and {self.loss:g} times their own;"
                " choose smaller speed_per_k and loss_per_k"
            )

    def softened(self, chain: Chain) -> Chain:
        """A chain times what a unit force moves: a gel twice as stiff moves half as much."""
        return chain if self.speed == 1 else lambda frequency_hz: chain(frequency_hz) / self.speed**2


UNCHANGED = PlateChange()
REFERENCE_C = 21.0
"""Temperature at which plates are as their keys say."""

MAX_RINGING_S = 20.0
"""What rings longer wraps: such a plate needs taps that hold its whole response."""


def impulse_length(taps: int, sample_rate_hz: float, ringing_s: float = 0.0) -> int:
    """Samples of a transform in which impulse responses do not wrap."""
    # Room after the taps, so that the slow diffusion of far pairs does not wrap.
    room_s = max(1.0, min(ringing_s, MAX_RINGING_S))
    return int(scipy.fft.next_fast_len(taps + round(room_s * sample_rate_hz), real=True))


class Plate(ABC):
    """A plate with actuators on it, each pushing with unit force.

    actuator_mm, float64 (actuators, 2): Where they are.
    outline: Of the plate.
    chain: Transfer function of the signal chain over the frequency in Hz; every response includes it.
    keys: Settings that only some plates have, by name.

    name: What it is registered as.
    unit_force_n: Force in N for which its responses are velocities in m/s.
    ringing_s: How long its responses take to fall by 60 dB, if that can be longer than a gel's.
    """

    name: str
    unit_force_n: float
    ringing_s: float = 0.0

    def __init__(self, actuator_mm: Float64Array, outline: Outline, chain: Chain, **keys: Any) -> None:
        self._actuator_mm = actuator_mm
        self._outline = outline
        self._chain = chain

    @abstractmethod
    def response(
        self, place_mm: tuple[float, float], step_hz: float, bins: int, *, single: bool
    ) -> Complex64Array | Complex128Array:
        """Velocity at a place for each actuator at the frequencies step_hz * (0, 1, ... bins - 1), (actuators, bins).

        place_mm: Point on the surface.
        step_hz: Spacing of the frequencies, > 0.
        bins: How many, > 0.
        single: Give complex64, to a relative error of 1e-6, in place of complex128.
        """

    def fir_spectra(
        self, position_mm: Float64Array, taps: int, sample_rate_hz: float, length: int, bins: slice
    ) -> Complex128Array:
        """Transforms of the FIRs that end after some taps, (positions, actuators, bins), within 1e-5.

        position_mm, float64 (positions, 2): Points on the surface, not on an actuator.
        taps, sample_rate_hz: Length and rate of the FIRs.
        length: Length of the transform.
        bins: Which bins, start and stop given.
        """
        full, folds = impulse_length(taps, sample_rate_hz, self.ringing_s), -(-taps // length)
        spectra = []
        for x, y in np.asarray(position_mm, dtype=np.float64).reshape(-1, 2).tolist():
            whole = scipy.fft.irfft(self.response((x, y), sample_rate_hz / full, full // 2 + 1, single=False), full)
            # Folded, a transform of any length has the values at its frequencies.
            cut = np.zeros((len(whole), folds * length))
            cut[:, :taps] = whole[:, :taps]
            spectra.append(scipy.fft.rfft(cut.reshape(len(whole), folds, length).sum(axis=1))[:, bins])
        return np.stack(spectra)


PLATES: Registry[type[Plate]] = Registry("wavefocus.mocks.plates")
