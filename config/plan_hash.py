"""The hash of a plan: all that the rows of one bank must have in common."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from config.rig import RigConfig
from config.run import RunConfig, Virtual


def plan_sha256(rig: RigConfig, run: RunConfig, position_mm: NDArray[np.float64]) -> str:
    """Hash all that a resume must not change, so that no bank mixes two plans.

    Positions, actuators, sweep, capture, wiring, inputs, ranges, calibration, quality limits and what a virtual
    rig is like count. Names, file paths, addresses, ports, device names, safety limits, settling time,
    time-outs, verification tolerances, fault plans and what an emulation is like do not: they can change
    without making the rows of one bank differ in kind.

    Parameters
    ----------
    rig, run : RigConfig, RunConfig
        The validated configuration.
    position_mm : float64 array, shape (positions, 2)
        The grid.

    Returns
    -------
    str
        64 hexadecimal digits: SHA-256 of canonical JSON.
    """
    essence = _essence(rig, run, position_mm)
    text = json.dumps(essence, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode("ascii")).hexdigest()


def rig_differences(rig: RigConfig, other: RigConfig, run: RunConfig) -> tuple[str, ...]:
    """Keys of a rig that a resume must not change and in which two rigs differ, as ``recorder.response_range_v``.

    Parameters
    ----------
    rig, other : RigConfig
        The rigs.
    run : RunConfig
        The run that both are to carry out.
    """
    nowhere = np.empty((0, 2))
    own, new = (dict(_leaves("", _essence(one, run, nowhere))) for one in (rig, other))
    return tuple(key for key in sorted({**own, **new}) if own.get(key) != new.get(key))


def _leaves(name: str, value: object) -> Iterator[tuple[str, object]]:
    if isinstance(value, dict):
        for key, beneath in value.items():
            yield from _leaves(f"{name}.{key}" if name else str(key), beneath)
    else:
        yield name, value


def _essence(rig: RigConfig, run: RunConfig, position_mm: NDArray[np.float64]) -> dict[str, object]:
    """All that the hash is taken of."""
    capture = {"averages", "decay_s", "excitation", "taps", "sample_rate_hz"}
    if run.capture.excitation == "staggered":
        capture |= {"stagger_s", "groups", "periods"}
    if run.capture.level_db != 0:
        capture |= {"level_db"}
    return {
        "position_mm": (position_mm + 0.0).tolist(),
        "actuator_mm": rig.actuators.position_mm,
        "surface": rig.surface.model_dump(),
        **_rig_essence(rig),
        "sweep": run.sweep.model_dump(),
        "capture": run.capture.model_dump(include=capture),
        "quality": _quality_essence(run),
        "virtual": _virtual_essence(rig, run),
    }


def _quality_essence(run: RunConfig) -> dict[str, object]:
    """When a row counts as valid and how it was tried; keys that came later, only where they differ from what was."""
    first = {"poor_residual_db", "excess_noise_db", "poor_snr_db", "max_attempts"}
    return run.quality.model_dump(include=first) | run.quality.model_dump(exclude=first, exclude_defaults=True)


def _rig_essence(rig: RigConfig) -> dict[str, object]:
    """What of the instruments makes the rows of one bank differ in kind.

    Keys that a rig does not use are left out, so that banks keep their hash when new keys come.
    """
    recorder = {"driver", "reference_range_v", "response_range_v", "reference_gain", "inter_channel_delay_s",
                "pre_roll_s", "post_roll_s"}  # fmt: skip
    of_driver = {"reference_input", "response_input", "terminal"}
    player = {"driver", "channels", "loopback_channel", "full_scale_v"}
    units = {"full_scale_mrad", "beam_per_mirror", "axes"}
    return {
        "mirror": {"driver": rig.mirror.driver, "matrix": rig.mirror.matrix}
        | rig.mirror.model_dump(include=units, exclude_none=True),
        "recorder": rig.recorder.model_dump(include=recorder)
        | rig.recorder.model_dump(include=of_driver, exclude_none=True),
        "player": rig.player.model_dump(include=player)
        | rig.player.model_dump(include={"channel_full_scale_v"}, exclude_none=True),
        "vibrometer": rig.vibrometer.model_dump(include={"sensitivity_m_s_per_v"})
        | rig.vibrometer.model_dump(include={"latency_s"}, exclude_none=True),
    }


def _virtual_essence(rig: RigConfig, run: RunConfig) -> dict[str, object] | None:
    """What makes a virtual rig's rows what they are; nothing for real instruments, emulated or not."""
    if not rig.is_virtual:
        return None
    essence: dict[str, object] = (run.virtual or Virtual()).model_dump(include={"seed", "noise_v"})
    if not rig.emulation.is_flawless:
        essence["emulation"] = rig.emulation.truth()
    return essence
