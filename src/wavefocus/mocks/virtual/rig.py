"""A rig to practise on: three instruments, one plate and one clock, all virtual."""

import numpy as np
from numpy.typing import NDArray

from wavefocus.drivers.protocols import Instruments
from wavefocus.mocks.virtual.faults import RigFault
from wavefocus.mocks.virtual.laboratory import PatchBay, VirtualClock, sensor_of
from wavefocus.mocks.virtual.mirror import VirtualMirror
from wavefocus.mocks.virtual.player import VirtualPlayer
from wavefocus.mocks.virtual.recorder import VirtualRecorder
from wavefocus.mocks.virtual.settings import MirrorGeometry, VirtualSettings
from wavefocus.mocks.virtual.synthesis import Synthesis

__all__ = ["MirrorGeometry", "RigFault", "VirtualRig", "VirtualSettings"]


class VirtualRig:
    """Mirror, recorder and player before one soft plate; only voltages come out of them.

    A signal sample k of the player appears in the record at sample offset + k * clock_ratio (rates
    being equal), the offset not known. Everything random depends on the seed and the record's label, so
    neither the order of takes nor what happened before them changes a byte.

    settings: The rig; the default rig, if absent.

    instruments: The three instruments and their clock.
    patch_bay: What is plugged into the response input; the vibrometer, until somebody plugs in something else.
    sensors: ``"room"`` and ``"light"``.
    """

    def __init__(self, settings: VirtualSettings | None = None) -> None:
        self.settings = settings or VirtualSettings()
        self._synthesis = Synthesis(self.settings)
        self.patch_bay = PatchBay(self.settings.channel_of_actuator, self.settings.channel_of_loopback)
        clock = VirtualClock(realtime=self.settings.realtime)
        mirror = VirtualMirror(self.settings, clock)
        player = VirtualPlayer(self.settings, clock)
        recorder = VirtualRecorder(self.settings, clock, mirror, player, self._synthesis, self.patch_bay)
        player.follow(recorder.label_under_way)
        self.sensors = {
            "room": sensor_of(clock, self.settings.room_c),
            "light": sensor_of(clock, self.settings.light),
        }
        self.instruments = Instruments(mirror=mirror, recorder=recorder, player=player, clock=clock)

    def truth(self, x_mm: float, y_mm: float, taps: int, sample_rate_hz: float = 10_000.0) -> NDArray[np.float64]:
        """The plate's true Green's functions at one point, for tests and the demo's last line.

        From player volts to surface velocity as the vibrometer shows it: amplifier, coil, plate and
        vibrometer low-pass are in, the delay between the recorder's channels is not.

        x_mm, y_mm: Point on the surface in mm.
        taps: Length of the FIRs, > 0.
        sample_rate_hz: Their rate on the player's clock in Hz.

        Returns float64 (actuators, taps): in (m/s)/V.
        """
        return self._synthesis.green((float(x_mm), float(y_mm)), taps, float(sample_rate_hz))

    def truth_spectra(
        self, position_mm: NDArray[np.float64], taps: int, length: int, bins: slice, sample_rate_hz: float = 10_000.0
    ) -> NDArray[np.complex128]:
        """Some bins of the transforms of `truth` at many points, within 1e-6, without the transforms.

        position_mm, float64 (positions, 2): Points on the surface in mm, not on a magnet.
        taps: Length of the FIRs, > 0.
        length: Length of the transform that the FIRs are padded to.
        bins: Which bins, start and stop given.
        sample_rate_hz: Rate of the FIRs on the player's clock in Hz.

        Returns complex128 (positions, actuators, bins).
        """
        return self._synthesis.green_spectra(position_mm, taps, float(sample_rate_hz), length, bins)
