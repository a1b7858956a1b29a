"""The virtual bench that a rig file describes: what its tables believe, and what its emulation says is true."""

from dataclasses import replace

import numpy as np

from wavefocus.config.emulation import Emulation, plate_of, strength
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import Virtual
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import MirrorGeometry, VirtualSettings
from wavefocus.mocks.virtual.synthesis import output_errors
from wavefocus.storage.errors import InputError


def virtual_rig(
    rig: RigConfig, virtual: Virtual | None = None, *, realtime: bool = False, outputs: int = 0
) -> VirtualRig:
    """Build the virtual rig that a configuration describes; `realtime` and `outputs` as of its settings."""
    return VirtualRig(replace(virtual_settings(rig, virtual), realtime=realtime, outputs=outputs))


def virtual_settings(rig: RigConfig, virtual: Virtual | None = None) -> VirtualSettings:
    """What the bench behind a rig is like, for the virtual rig and for emulated wires.

    Raises InputError: a bank's plate is one that only earlier versions simulated.
    """
    emulation, defaults = rig.emulation, VirtualSettings()
    plate = plate_of(virtual, emulation)
    if plate.gone is not None:
        key, value, instead = plate.gone
        raise InputError(f'{key} = "{value}": {instead}; banks of such a plate are read, and not measured on')
    seed = emulation.seed if virtual is None else virtual.seed
    noise_v, crosstalk, leak_s = (
        getattr(emulation if virtual is None or getattr(virtual, key) is None else virtual, key)
        for key in ("noise_v", "crosstalk", "crosstalk_delay_s")
    )
    delay_s = emulation.inter_channel_delay_s
    latency_s, gain = _outputs(rig, emulation)
    return VirtualSettings(
        seed=seed, noise_v=defaults.noise_v if noise_v is None else noise_v,
        reference_noise_v=(
            defaults.reference_noise_v if emulation.reference_noise_v is None else emulation.reference_noise_v
        ),
        noise_per_response=emulation.noise_per_response, cubic_per_v2=emulation.cubic_per_v2,
        crosstalk=crosstalk, crosstalk_delay_s=leak_s, clock_ppm=emulation.clock_ppm,
        actuator_mm=rig.actuators.position_mm, actuator_channels=_wired(rig),
        loopback_channel=rig.player.loopback_channel, output_latency_s=latency_s, output_gain=gain,
        actuator_strength=strength(emulation, len(rig.actuators.position_mm)),
        plate=plate.plate, plate_keys=tuple(plate.plate_keys.items()), outline=rig.surface.outline,
        mirror=MirrorGeometry(matrix=emulation.mirror_map or rig.mirror.matrix),
        settle_s=rig.mirror.settle_s, limit_mrad=rig.mirror.limit_mrad, park_mrad=rig.mirror.park_mrad,
        full_scale_v=rig.player.full_scale_v,
        sensitivity_m_s_per_v=rig.vibrometer.sensitivity_m_s_per_v or defaults.sensitivity_m_s_per_v,
        inter_channel_delay_s=rig.recorder.inter_channel_delay_s if delay_s is None else delay_s,
        vibrometer_latency_s=rig.vibrometer.latency_s or 0.0, room_c=_room_c(emulation, virtual) or defaults.room_c,
        light=defaults.light if virtual is None or not virtual.light else virtual.light,
        fault_plan=() if virtual is None else virtual.fault_plan,
    )  # fmt: skip


def _wired(rig: RigConfig) -> tuple[int, ...]:
    """The output that each actuator hangs on."""
    exchanged = dict(rig.emulation.swapped_outputs)
    exchanged |= {other: one for one, other in exchanged.items()}
    return tuple(exchanged.get(channel, channel) for channel in rig.player.channels)


def _room_c(emulation: Emulation, virtual: Virtual | None) -> tuple[tuple[float, float], ...]:
    if virtual is not None and virtual.room_c:
        return virtual.room_c
    return () if emulation.room_c is None else ((0.0, emulation.room_c),)


def _outputs(rig: RigConfig, emulation: Emulation) -> tuple[tuple[float, ...] | None, tuple[float, ...] | None]:
    """Latency of each output, and its volts per volt asked for; None where there is nothing to find.

    Volts are asked for by the full scale that the rig believes in, so what a calibration has found is gone.
    """
    latency_spread_s, gain_spread_db = emulation.output_latency_spread_s, emulation.output_gain_spread_db
    late_s, factor = output_errors(rig.player.outputs, latency_spread_s, gain_spread_db, emulation.seed)
    factor[list(emulation.reversed_outputs)] *= -1
    factor[: len(emulation.output_gains_db)] *= 10.0 ** (np.array(emulation.output_gains_db) / 20.0)
    late_s[: len(emulation.output_delays_s)] += emulation.output_delays_s
    gain = factor * rig.player.full_scale_v / np.array(rig.player.output_full_scale_v)
    return tuple(late_s.tolist()) if late_s.any() else None, tuple(gain.tolist()) if (gain != 1.0).any() else None
