"""What has changed between two verifications."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING

from wavefocus.rendering.number_text import number, precise
from wavefocus.rendering.verify.record import VerificationRecord
from wavefocus.rendering.verify.results import ActuatorFigures, Change, Changes, Figure, SourceFigures, Symptom
from wavefocus.rendering.verify.symptom_words import sentence

if TYPE_CHECKING:
    from wavefocus.rendering.verify.verdict import Verification

NOTED = {"dB": 0.2, "µs": 20.0, "%": 0.5, "mm": 0.3, "": 0.002}
"""Changes from which on a figure is noted, by its unit: more than what two scans of a steady rig differ by."""


def changes_since(
    before: VerificationRecord, file: str, now: Verification, scene: str, names: Mapping[str, str]
) -> Changes:
    """Compare a verification with an earlier one.

    before, file: The earlier record and its name.
    scene, names: The scene's name, and those of scene file, bank and rig on the command line, as in `write_record`.
    """
    inputs = {"scene": scene, **names}
    earlier = _values(before.figures, before.source_figures, before.actuators)
    later = _values(now.figures, now.sources, now.actuators)
    then, now_found = ({symptom.identity for symptom in symptoms} for symptoms in (before.symptoms, now.symptoms))
    return Changes(
        against=file,
        made=before.made,
        inputs=tuple(
            f"{name}: {getattr(before, name)} then, {value} now"
            for name, value in inputs.items()
            if getattr(before, name) != value
        ),
        symptoms_gone=tuple(symptom for symptom in before.symptoms if symptom.identity not in now_found),
        symptoms_new=tuple(symptom for symptom in now.symptoms if symptom.identity not in then),
        figures=tuple(
            _change(name, unit, earlier.get(name, (unit, None))[1], value) for name, (unit, value) in later.items()
        ),
    )


def change_lines(changes: Changes) -> list[str]:
    """The changes in words: inputs, symptoms, and the figures that are noted."""
    lines = [
        *changes.inputs,
        *(f"no longer: {_text(symptom)}" for symptom in changes.symptoms_gone),
        *(f"new: {_text(symptom)}" for symptom in changes.symptoms_new),
        *(_line(change) for change in changes.figures if change.noted),
    ]
    return lines or ["no figure has changed by more than two scans of a steady rig differ"]


def _text(symptom: Symptom | str) -> str:
    return symptom if isinstance(symptom, str) else sentence(symptom)


def _values(
    figures: Iterable[Figure], sources: Iterable[SourceFigures], actuators: Iterable[ActuatorFigures]
) -> dict[str, tuple[str, float | None]]:
    """Unit and value of all figures, by name."""
    values = {figure.name: (figure.unit, figure.value) for figure in figures}
    for index, source in enumerate(sources, 1):
        values[f"source {index}: error"] = "%", None if source.error is None else 100.0 * source.error
        values[f"source {index}: focus to path point"] = "mm", source.focus_mm
    for index, actuator in enumerate(actuators):
        values |= {
            f"actuator {index}: level": ("dB", actuator.level_db),
            f"actuator {index}: delay": ("µs", actuator.delay_us),
        }
    return values


def _change(name: str, unit: str, before: float | None, now: float | None) -> Change:
    noted = before is not None and now is not None and abs(now - before) >= NOTED[unit]
    return Change(name, unit, before, now, noted)


def _line(change: Change) -> str:
    before, now = (
        precise(value) if not change.unit else number(value, change.unit) for value in (change.before, change.now)
    )
    return f"{change.name}: {before} then, {now} now"
