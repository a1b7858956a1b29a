"""A calibration file taken into the rig that names it: what it has measured wins over what the rig file says."""

from __future__ import annotations

from typing import Any

from pydantic import ValidationError

from config.calibration_file import CalibrationRecord
from config.fields import mistake


def with_calibration(data: dict[str, Any]) -> dict[str, Any]:
    """A rig's tables with the values of its calibration in them; unchanged where there is none.

    The calibration wins over what a rig file can only know roughly: ``mirror.distance_mm``,
    ``recorder.inter_channel_delay_s`` and ``player.full_scale_v``. Two measured values of one thing are a
    contradiction, and so are figures of another wiring.

    Parameters
    ----------
    data : dict
        The rig's tables, defaults filled in but not validated; what is no table is left to be refused later.

    Raises
    ------
    PydanticCustomError
        A contradiction.
    """
    care = data.get("calibration")
    if not isinstance(care, dict) or care.get("measured") is None:
        return data
    try:
        record = CalibrationRecord.model_validate(care["measured"])
    except ValidationError:  # told at its own place
        return data
    mirror, recorder, player = (data.get(name, {}) for name in ("mirror", "recorder", "player"))
    merged = dict(data)
    if record.mirror is not None and isinstance(mirror, dict):
        _refuse_two("mirror.map", mirror.get("map"), record.mirror.map)
        merged["mirror"] = {key: value for key, value in mirror.items() if key != "distance_mm"}
        merged["mirror"]["map"] = record.mirror.map
    if record.inputs is not None and isinstance(recorder, dict):
        merged["recorder"] = {**recorder, "inter_channel_delay_s": record.inputs.inter_channel_delay_s}
    if isinstance(player, dict):
        _refuse_other_wiring(player, record)
        merged["player"] = _with_full_scales(player, record)
    return merged


def calibrated(record: CalibrationRecord) -> str:
    """What a calibration says in place of the rig file, in words."""
    parts = []
    if record.mirror is not None:
        parts.append(f"mirror map (residual {record.mirror.residual_rms_mm:.2f} mm)")
    if record.inputs is not None:
        parts.append(f"inter-channel delay {1e6 * record.inputs.inter_channel_delay_s:.2f} us")
    if record.outputs is not None:
        known = sum(one.full_scale_v is not None for one in record.outputs.channel)
        parts.append(f"full scale of {known} outputs" if known else "latency of the outputs")
    return ", ".join(parts) or "nothing that the rig takes up"


def _with_full_scales(player: dict[str, Any], record: CalibrationRecord) -> dict[str, Any]:
    """The player's table with the full scale of every output, the nominal one where none was measured."""
    outputs = record.outputs.channel if record.outputs is not None else ()
    measured = {one.channel: one.full_scale_v for one in outputs if one.full_scale_v is not None}
    channels, loopback = player.get("channels"), player.get("loopback_channel")
    if not measured or not isinstance(channels, list | tuple):
        return player
    used = [channel for channel in (*channels, loopback) if isinstance(channel, int)]
    nominal_v = player.get("full_scale_v", 5.0)
    each = tuple(measured.get(channel, nominal_v) for channel in range(1 + max(used, default=0)))
    _refuse_two("player.channel_full_scale_v", player.get("channel_full_scale_v"), each)
    return {**player, "channel_full_scale_v": each}


def _refuse_two(key: str, own: object, measured: object) -> None:
    if own is not None and _plain(own) != _plain(measured):
        raise mistake(key, own, "contradicts the calibration file; leave one of the two out")


def _refuse_other_wiring(player: dict[str, Any], record: CalibrationRecord) -> None:
    """A calibration made with other cables says nothing about these."""
    or_else = "as in the calibration file, or that was measured with another wiring: run wavefocus calibrate again"
    loopback = player.get("loopback_channel")
    if record.outputs is not None and loopback != record.outputs.loopback_channel:
        raise mistake("player.loopback_channel", loopback, f"must be {record.outputs.loopback_channel}, {or_else}")
    channels = player.get("channels")
    if record.actuators is None or not isinstance(channels, list | tuple):
        return
    for one in record.actuators.actuator:
        if one.actuator >= len(channels) or channels[one.actuator] != one.channel:
            allowed = f"must have actuator {one.actuator} on output {one.channel}, {or_else}"
            raise mistake("player.channels", list(channels), allowed)


def _plain(value: object) -> object:
    """Lists and tuples alike, whole numbers and others alike."""
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return float(value) if isinstance(value, int) else value
