"""Commands that a queue carries out: their words checked, their input files, instruments and expected duration."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from wavefocus.acquisition.plan import POSITION_OVERHEAD_S, Plan
from wavefocus.acquisition.run_queue import QueueEntry, add_entry, file_digests, read_queue
from wavefocus.campaign.blueprint import Blueprint, blueprint_from_bank, blueprint_from_files, needed_by
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import named_rig
from wavefocus.input_files import input_files, scan_rows
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.errors import InputError, WavefocusError

QUEUED = ("capture", "resume", "remeasure", "verify", "estimate", "render", "predict", "check", "export", "publish")
"""Commands that need nobody and end by themselves."""
_OUTPUTS = ("out", "wav", "picture")


@dataclass(frozen=True, slots=True)
class QueuedCommand:
    """A command and its arguments by their names in Python; files by their full names."""

    name: str
    given: Mapping[str, Any]

    @property
    def bank(self) -> Path | None:
        """The bank that it measures or reads."""
        bank: Path | None = self.given.get("bank")
        return bank


def queued_command(words: Sequence[str], folder: Path) -> QueuedCommand:
    """Read a command line as it is carried out in a folder.

    Raises InputError: it is not a command that a queue carries out, or its arguments are wrong.
    """
    from wavefocus.cli import UsageError, parsed

    if not words:
        raise InputError(f"a command is needed after the queue's name; allowed: {', '.join(QUEUED)}")
    if words[0] not in QUEUED:
        raise InputError(f"{words[0]!r} cannot be queued; allowed: {', '.join(QUEUED)}")
    try:
        command, given = parsed(words)
    except UsageError as wrong:
        raise InputError(str(wrong)) from None
    full = {key: _in_folder(value, folder) for key, value in given.items()}
    return QueuedCommand(command.name, full)


def _in_folder(value: Any, folder: Path) -> Any:
    if isinstance(value, list):
        return [_in_folder(part, folder) for part in value]
    return folder / value if isinstance(value, Path) and str(value) != "virtual" else value


def add_command(queue: Path, words: Sequence[str], folder: Path) -> QueueEntry:
    """Add a command line to a queue, which is made where missing.

    Raises InputError: the command line or one of its files is wrong; a bank may be missing until its turn.
    """
    words = [word for word in words if word != "--json"]  # a queue shows the events of its runs by itself
    folder = folder.absolute()
    command = queued_command(words, folder)
    files = _files_of(command)
    for file in files:
        if not file.is_file():
            raise InputError(f"{file}: no such file")
    earlier = read_queue(queue) if queue.exists() else ()
    expected_s = _expected_s(command, earlier)
    return add_entry(queue, words, folder, file_digests(input_files(*files)), command.bank, expected_s)


def _files_of(command: QueuedCommand) -> list[Path]:
    """Files that people write and a command reads; banks grow while a queue is carried out, and are left out."""
    given = {key: value for key, value in command.given.items() if key not in _OUTPUTS}
    paths = [part for value in given.values() for part in (value if isinstance(value, list) else [value])]
    return [path for path in paths if isinstance(path, Path) and path.suffix.lower() in (".toml", ".csv")]


def _expected_s(command: QueuedCommand, earlier: Sequence[QueueEntry]) -> float | None:
    """Seconds that a command is expected to take; None where unknown. Raises InputError: a file is wrong."""
    match command.name:
        case "capture":
            blueprint = blueprint_from_files(command.given["run_file"])
            return _capture_s(blueprint, command.given["bank"], command.given["scene_files"])
        case "resume" if command.given["bank"].is_file():
            return _capture_s(blueprint_from_bank(command.given["bank"]), command.given["bank"])
        case "verify":
            return _verify_s(command, earlier)
    return None


def _capture_s(blueprint: Blueprint, bank: Path, scene_files: Sequence[Path] = ()) -> float:
    plan, rows = blueprint.plan, blueprint.plan.order
    if bank.is_file():
        with open_bank(bank) as view:
            rows = plan.to_do(view.status)
    if scene_files:
        needed = needed_by(scene_files, blueprint, checks=True, allow_large=True)
        rows = rows[[int(row) in needed for row in rows]]
    return plan.campaign_s(rows, blueprint.configuration.rig.recorder) if len(rows) else 0.0


def _verify_s(command: QueuedCommand, earlier: Sequence[QueueEntry]) -> float | None:
    from wavefocus.rendering.scene.model import load_scene
    from wavefocus.rendering.scene.size import scene_size

    given = command.given
    scene, rig = load_scene(given["scene_file"], allow_large=True), named_rig(given["rig_file"])
    plan = _plan_of_bank(given["bank"], earlier)
    if plan is None:
        return None
    size = scene_size(scene, sample_rate_hz=plan.excitation.sample_rate_hz, taps=plan.taps, actuators=plan.actuators)
    rows = scan_rows(given["positions"], scene, plan.position_mm, given["scene_file"])
    count = plan.positions if rows is None else len(rows)
    margins_s = rig.recorder.pre_roll_s + rig.recorder.post_roll_s + POSITION_OVERHEAD_S
    return count * (size.seconds + plan.taps / plan.excitation.sample_rate_hz + margins_s)


def _plan_of_bank(bank: Path, earlier: Sequence[QueueEntry]) -> Plan | None:
    """The plan of a bank, or of the run that makes it earlier in the queue; None where unknown."""
    try:
        if bank.is_file():
            return blueprint_from_bank(bank).plan
        for entry in earlier:
            made = queued_command(entry.words, Path(entry.folder))
            if made.name == "capture" and made.bank == bank:
                return blueprint_from_files(made.given["run_file"]).plan
    except WavefocusError:
        return None
    return None


def instrument_names(entry: QueueEntry) -> tuple[str, ...]:
    """Names of the instruments that an entry uses, of a virtual rig its file; none where they cannot be found out.

    What is wrong with its files is reported by the command itself when it runs.
    """
    try:
        command = queued_command(entry.words, Path(entry.folder))
        return tuple(_instruments(*_rig_of(command)))
    except (WavefocusError, OSError):
        return ()


def _rig_of(command: QueuedCommand) -> tuple[RigConfig | None, Path | None]:
    """The rig of a command, and its file where it is known."""
    given = command.given
    rig_file: Path | None = given.get("rig_file")
    if command.name == "capture":
        configuration = blueprint_from_files(given["run_file"]).configuration
        return configuration.rig, configuration.run.rig_file(given["run_file"])
    if command.name not in ("resume", "remeasure", "verify"):
        return None, None
    if rig_file is not None:
        return named_rig(rig_file), None if str(rig_file) == "virtual" else rig_file
    return blueprint_from_bank(given["bank"]).configuration.rig, None


def _instruments(rig: RigConfig | None, rig_file: Path | None) -> Iterator[str]:
    if rig is None:
        return
    if rig.is_virtual:
        if rig_file is not None:
            yield f"rig {rig_file.resolve()}"
        return
    for role in ("mirror", "recorder", "player", "vibrometer"):
        section = getattr(rig, role)
        where = [str(value) for key in ("port", "device", "address") if (value := getattr(section, key, None))]
        if where:
            yield f"{role} {section.driver} at {' of '.join(where)}"
