"""Settings of the virtual rig, and the laser in front of its plate."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from wavefocus.config.emulation import RigFault
from wavefocus.config.outline import Outline


@dataclass(frozen=True, slots=True)
class MirrorGeometry:
    """How the laser stands before the surface.

    matrix: Projective map from (x, y, 1) in mm to the slopes, whose arc tangents are the mirror's angles; the default
        is the straight map at 1000 mm.
    """

    matrix: tuple[tuple[float, float, float], ...] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1000.0))

    def angles_mrad(self, x_mm: float, y_mm: float) -> tuple[float, float]:
        """Optical angles that put the laser on a surface point."""
        x, y, depth = np.array(self.matrix) @ (x_mm, y_mm, 1.0)
        return 1000 * float(np.arctan2(x, depth)), 1000 * float(np.arctan2(y, depth))

    def spot_mm(self, x_mrad: float, y_mrad: float) -> tuple[float, float]:
        """Surface point that the laser meets."""
        slopes = (np.tan(x_mrad / 1000), np.tan(y_mrad / 1000), 1.0)
        x, y, scale = np.linalg.solve(np.array(self.matrix), slopes)
        return float(x / scale), float(y / scale)


_OUTLINE = Outline.stadium(250.0, 150.0)  # the paper, section IV.A: a stadium of 25 cm x 15 cm


@dataclass(frozen=True, slots=True)
class VirtualSettings:
    """A virtual rig; the same settings give the same rig, byte for byte. Rig and run files check what they hold.

    seed: Seed of everything random, >= 0.
    noise_v: Noise of the vibrometer at the response input, volts rms, >= 0. The converter's own rounding (0.09 mV rms
        at a range of 10 V) comes on top.
    reference_noise_v: Noise of the reference input, volts rms, >= 0.
    noise_per_response: Noise that grows with the response: volts rms per volt of it at every instant, >= 0.
    cubic_per_v2: A response of u volts comes out as u + cubic_per_v2 * u**3, in 1/V^2.
    crosstalk: Share of the loopback voltage that leaks into the response input, within +-1.
    crosstalk_delay_s: How much later it comes there than at the reference input, in s, 0 to 0.01.
    pickup: Channels of single outputs, and the share of their voltage that the response input picks up.
    clock_ppm: How much faster the recorder's clock is than the player's, in parts per million, within +-1000.
    inter_channel_delay_s: How much later the response is sampled than the reference, in s, within +-0.001; negative
        where the response input is converted first.
    vibrometer_latency_s: How much later the vibrometer's voltage is than the velocity that it stands for, in s, 0 to
        0.001.
    latency_s: Shortest and longest time from the call of play to the first sample, in s.
    actuator_mm: Positions of the actuators in mm.
    actuator_channels: Player channel that each actuator hangs on; by default actuator i on channel i.
    loopback_channel: Player channel that is looped back to the reference input; by default the one after the last.
    output_latency_s: How much later than the player's latency each of its outputs is, in s, within +-0.001; 0 if
        absent.
    output_gain: Volts at each output per volt asked for, negative where its wires are crossed; 1 if absent.
    actuator_strength: Factor on each actuator's own strength: 0 where it is dead, negative where it is reversed; 1 if
        absent.
    plate: Name of the plate, as registered in `wavefocus.mocks.plates`.
    plate_keys: Settings that only this plate has, by name.
    outline: Of the plate.
    mirror: Where the laser stands.
    settle_s, slew_mrad_s, limit_mrad, park_mrad: The mirror: settling time, speed of a move, largest angle per axis,
        safe direction.
    sensitivity_m_s_per_v: Surface velocity per volt of the vibrometer, in (m/s)/V, > 0.
    gain_spread_db: Largest deviation of an actuator's gain in dB, >= 0.
    dropout_probability: Probability that an attempt of as many records as there are actuators loses the vibrometer
        signal for 2-10 ms in one of them (speckle), 0 to 1.
    lost_signal_v: Noise of the vibrometer without a signal, volts rms.
    full_scale_v: Largest output voltage of the player, > 0.
    largest_range_v: Largest range of the recorder in volts, > 0.
    input_ranges_v: Ranges that the recorder says it has, in volts; it takes any up to the largest.
    room_c, light: Instants in s on the rig's clock, rising, with the room's temperature in degrees Celsius, and with
        the share of light that comes back to the vibrometer, as its controller would report it.
    realtime: Let virtual seconds last a second.
    outputs: Outputs of the player, where it has more than are wired.
    """

    seed: int = 1
    noise_v: float = 1.5e-4
    reference_noise_v: float = 1e-4
    noise_per_response: float = 0.0
    cubic_per_v2: float = 0.0
    crosstalk: float = 0.0
    crosstalk_delay_s: float = 0.0
    pickup: tuple[tuple[int, float], ...] = ()
    clock_ppm: float = 30.0
    inter_channel_delay_s: float = 5e-6
    vibrometer_latency_s: float = 0.0
    latency_s: tuple[float, float] = (0.005, 0.030)
    actuator_mm: tuple[tuple[float, float], ...] = field(default_factory=lambda: rim_places(20))
    actuator_channels: tuple[int, ...] | None = None
    loopback_channel: int | None = None
    output_latency_s: tuple[float, ...] | None = None
    output_gain: tuple[float, ...] | None = None
    actuator_strength: tuple[float, ...] | None = None
    plate: str = "soft"
    plate_keys: tuple[tuple[str, Any], ...] = ()
    outline: Outline = _OUTLINE
    mirror: MirrorGeometry = field(default_factory=MirrorGeometry)
    settle_s: float = 0.005
    slew_mrad_s: float = 20_000.0
    limit_mrad: float = 250.0
    park_mrad: tuple[float, float] = (-240.0, -240.0)
    sensitivity_m_s_per_v: float = 0.125
    gain_spread_db: float = 2.0
    dropout_probability: float = 0.01
    lost_signal_v: float = 1.0
    full_scale_v: float = 5.0
    largest_range_v: float = 10.0
    input_ranges_v: tuple[float, ...] = (0.2, 1.0, 5.0, 10.0)
    fault_plan: tuple[RigFault, ...] = ()
    room_c: tuple[tuple[float, float], ...] = ((0.0, 21.0),)
    light: tuple[tuple[float, float], ...] = ((0.0, 1.0),)
    realtime: bool = False
    outputs: int = 0

    @property
    def actuators(self) -> int:
        """Number of actuators."""
        return len(self.actuator_mm)

    @property
    def channel_of_actuator(self) -> tuple[int, ...]:
        """Player channel of each actuator."""
        return tuple(range(self.actuators)) if self.actuator_channels is None else self.actuator_channels

    @property
    def channel_of_loopback(self) -> int:
        """Player channel that is looped back to the reference input."""
        if self.loopback_channel is not None:
            return self.loopback_channel
        return max(self.channel_of_actuator, default=-1) + 1

    @property
    def player_channels(self) -> int:
        """How many channels the player has."""
        return max(*self.channel_of_actuator, self.channel_of_loopback, self.outputs - 1) + 1

    @property
    def clock_ratio(self) -> float:
        """Rate of the recorder's clock over that of the player's."""
        return 1 + self.clock_ppm * 1e-6


def rim_places(count: int, inset_mm: float = 6.0) -> tuple[tuple[float, float], ...]:
    """Places equally spaced on the stadium's rim, moved inwards, the first half a spacing from the right end."""
    rim = Outline.stadium(250.0 - 2 * inset_mm, 150.0 - 2 * inset_mm)
    arc_mm = (np.arange(count) + 0.5) * rim.perimeter_mm / count
    return tuple((float(x), float(y)) for x, y in rim.at(arc_mm))
