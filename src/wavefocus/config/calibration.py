"""Calibration files: their model, how they are read, written, named in a rig file and merged into a rig."""

from __future__ import annotations

import tomllib
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import AwareDatetime, Field, ValidationError, model_validator

from wavefocus.config.fields import Finite, Matrix, NonNegative, PointMm, Positive, Table, Text, Whole, mistake
from wavefocus.config.loading import parse_toml, printable, read_toml, shown, validated
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.storage.errors import ExistsError, InputError
from wavefocus.storage.output_files import replacement, write_whole
from wavefocus.storage.text_file import read_text

FORMAT = "wavefocus-calibration"
FORMAT_VERSION = 1

_Polarity = Literal[1, -1]
Index = Annotated[Whole, Field(ge=0, le=4095)]


class Fiducial(Table):
    """A mark on the surface, where the mirror stood when the beam was on it, and by how much the map misses it."""

    place_mm: PointMm
    angles_mrad: tuple[Finite, Finite]
    residual_mm: NonNegative


class _PartMeasured(Table):
    """When a part was measured, and on which device."""

    at: AwareDatetime
    device: Text
    identity: DeviceIdentity | None = None


class MirrorMeasured(_PartMeasured):
    """The projective map H of ``(tan x, tan y, 1) ~ H (x_mm, y_mm, 1)``."""

    map: Matrix
    residual_rms_mm: NonNegative
    fiducial: Annotated[tuple[Fiducial, ...], Field(min_length=4, max_length=1000)]


class InputsMeasured(_PartMeasured):
    """How much later the response input is sampled than the reference input."""

    inter_channel_delay_s: Annotated[Finite, Field(ge=-0.001, le=0.001)]


class OutputMeasured(Table):
    """One output of the player: latency relative to the loopback output, volts at full scale, sign."""

    channel: Index
    latency_s: Annotated[Finite, Field(ge=-1, le=1)]
    full_scale_v: Positive | None = None
    polarity: _Polarity


class OutputsMeasured(_PartMeasured):
    """The player's outputs, the loopback's own among them."""

    loopback_channel: Index
    channel: Annotated[tuple[OutputMeasured, ...], Field(min_length=1, max_length=4096)]

    @model_validator(mode="after")
    def _each_once(self) -> OutputsMeasured:
        seen = [output.channel for output in self.channel]
        for index, channel in enumerate(seen):
            if channel in seen[:index]:
                raise mistake(f"channel.[{index}].channel", channel, "is there already")
        return self


class ActuatorMeasured(Table):
    """One actuator: sign and level of its response against the others, at the same distance from each."""

    actuator: Annotated[Whole, Field(ge=0, le=1023)]
    channel: Index
    polarity: _Polarity
    level_db: Finite
    verdict: Literal["good", "weak", "dead", "reversed", "unlike"]


class ActuatorsMeasured(_PartMeasured):
    """The actuators, checked against each other."""

    distance_mm: Positive
    actuator: Annotated[tuple[ActuatorMeasured, ...], Field(min_length=1, max_length=1024)]


class CalibrationRecord(Table):
    """All that a calibration file holds; what was not measured is left out."""

    format: Literal["wavefocus-calibration"]
    format_version: Literal[1]
    made: AwareDatetime
    software: Text
    rig: Text
    mirror: MirrorMeasured | None = None
    inputs: InputsMeasured | None = None
    outputs: OutputsMeasured | None = None
    actuators: ActuatorsMeasured | None = None


def load_calibration(path: Path) -> CalibrationRecord:
    """Read a calibration file.

    Raises InputError: anything in the file is wrong, or it is of another format or version.
    """
    data = read_toml(path, "calibration")
    if data.get("format") == FORMAT and data.get("format_version") != FORMAT_VERSION:
        version = shown(data.get("format_version"))
        raise InputError(f"{path}: format_version = {version}: must be {FORMAT_VERSION}; a newer wavefocus wrote it")
    return validated(CalibrationRecord, data, str(path))


def with_calibration(data: dict[str, Any]) -> dict[str, Any]:
    """A rig's tables with the values of its calibration in them; unchanged where there is none.

    The calibration overrides what a rig file holds roughly: ``mirror.distance_mm``,
    ``recorder.inter_channel_delay_s`` and ``player.full_scale_v``. Two measured values of one thing are a
    contradiction, and so are figures of another wiring.

    Raises PydanticCustomError: A contradiction.
    """
    section = data.get("calibration")
    if not isinstance(section, dict) or section.get("measured") is None:
        return data
    try:
        record = CalibrationRecord.model_validate(section["measured"])
    except ValidationError:  # reported at its own place
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
        known = sum(output.full_scale_v is not None for output in record.outputs.channel)
        parts.append(f"full scale of {known} outputs" if known else "latency of the outputs")
    return ", ".join(parts) or "nothing that the rig uses"


def _with_full_scales(player: dict[str, Any], record: CalibrationRecord) -> dict[str, Any]:
    """The player's table with the full scale of every output, the nominal one where none was measured."""
    outputs = record.outputs.channel if record.outputs is not None else ()
    measured = {output.channel: output.full_scale_v for output in outputs if output.full_scale_v is not None}
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
    for actuator in record.actuators.actuator:
        if actuator.actuator >= len(channels) or channels[actuator.actuator] != actuator.channel:
            allowed = f"must have actuator {actuator.actuator} on output {actuator.channel}, {or_else}"
            raise mistake("player.channels", list(channels), allowed)


def _plain(value: object) -> object:
    """Lists and tuples alike, whole numbers and others alike."""
    if isinstance(value, list | tuple):
        return [_plain(entry) for entry in value]
    return float(value) if isinstance(value, int) else value


def name_calibration(rig_file: Path, name: str) -> None:
    """Write ``file = "NAME"`` into the ``[calibration]`` table of a rig file; the table is made where there is none.

    All else, comments and order included, stays as it was.

    Raises InputError: the file is not TOML, ``calibration`` is not a table, or the file cannot be written.
    """
    import tomlkit  # only this command edits a file

    text = read_text(rig_file)
    wanted = parse_toml(text, str(rig_file))
    table = wanted.setdefault("calibration", {})
    if not isinstance(table, dict):
        raise InputError(printable(f"{rig_file}: calibration = {shown(table)}: must be a table"))
    table["file"] = name
    new = "[calibration]"
    with suppress(tomlkit.exceptions.TOMLKitError):  # it reads less than Python does: 100 levels
        document = tomlkit.parse(text)
        if "calibration" not in document:
            document["calibration"] = tomlkit.table()
        document["calibration"]["file"] = name
        new = tomlkit.dumps(document)
    if tomllib.loads(new) != wanted:
        raise InputError(f'{rig_file}: cannot be edited; write file = "{name}" into its table [calibration] by hand')
    write_whole(rig_file.resolve(), new)


_HEAD = """\
# Measured by wavefocus calibrate; named in rig.toml by [calibration] file, and stronger than what stands there.
"""
NOTES = {
    "mirror": "the projective map (tan x, tan y, 1) ~ map (x_mm, y_mm, 1); residual: by how much it misses each mark",
    "inputs": "how much later the response input is sampled than the reference input",
    "outputs": "latency relative to the loopback output; volts at full scale; polarity -1: wires crossed",
    "actuators": "polarity and level of each, measured at the same distance from it; level against their median",
}


def write_calibration(path: Path, record: CalibrationRecord) -> None:
    """Write a calibration file; one that is there is never overwritten.

    Raises ExistsError: the file is there already. Raises InputError: it cannot be written.
    """
    text = _HEAD + _toml(record)
    try:
        with replacement(path, new=True) as temporary:
            temporary.write_bytes(text.encode())
    except FileExistsError:
        raise ExistsError(printable(f"{path}: is there already and is not overwritten; name another file")) from None
    except OSError as error:
        raise InputError(printable(f"{path}: cannot be written: {error.strerror or error}")) from None


def _toml(record: CalibrationRecord) -> str:
    import tomlkit  # only commands that write a file

    data, document = record.model_dump(exclude_none=True), tomlkit.document()
    for name in [*(key for key in data if key not in NOTES), *(key for key in NOTES if key in data)]:
        if name not in NOTES:
            document[name] = data[name]
            continue
        table: Any = tomlkit.table().comment(NOTES[name])
        for key, value in data[name].items():
            table[key] = _lines(value) if value and isinstance(value, tuple) and isinstance(value[0], dict) else value
        document[name] = table
    return tomlkit.dumps(document)


def _lines(rows: tuple[dict[str, Any], ...]) -> Any:
    """Tables with a line each."""
    import tomlkit

    array = tomlkit.array().multiline(True)
    for row in rows:
        array.append(tomlkit.item(row, array))
    return array
