"""A form for the keys of a part of a scene, made from a list of what they are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

from PyQt5.QtCore import pyqtSignal
from PyQt5.QtWidgets import QFormLayout, QLabel, QWidget

from gui.scene.fields import (
    ChoiceField,
    NumberField,
    OptionalField,
    PairField,
    SwitchField,
    TextField,
    WholeField,
    coordinates,
)

AnyField = NumberField | PairField | OptionalField | SwitchField | ChoiceField | TextField

WIDE = 1e9
#: As far as the fields' decimals reach.
TINY = 1e-6


@dataclass(frozen=True, slots=True)
class Key:
    """One key.

    Parameters
    ----------
    name : str
        In the draft.
    words, tip : str
        For people.
    kind : str
        ``"number"``, ``"whole"``, ``"optional"``, ``"place"``, ``"band"``, ``"switch"``, ``"text"`` or ``"choice"``.
    unit : str
        Its unit.
    low, high, step : float
        What is allowed, and the step of the arrows.
    choices : sequence of (value, words)
        Of a choice.
    """

    name: str
    words: str
    tip: str
    kind: str = "number"
    unit: str = ""
    low: float = -WIDE
    high: float = WIDE
    step: float = 1.0
    choices: Sequence[tuple[str, str]] = ()


class Form(QWidget):
    """Fields for the keys of one dataclass.

    Parameters
    ----------
    keys : sequence of Key
        From top to bottom.
    """

    #: A key, and what it is now.
    edited = pyqtSignal(str, object)

    def __init__(self, keys: Sequence[Key]) -> None:
        super().__init__()
        self.fields: dict[str, AnyField] = {}
        self.labels: dict[str, QLabel] = {}
        self.rows = QFormLayout(self)
        self.rows.setContentsMargins(0, 0, 0, 0)
        self.rows.setVerticalSpacing(4)
        self.rows.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        for key in keys:
            field = _field(key)
            label = QLabel("" if key.kind == "switch" else key.words)
            label.setBuddy(field)
            label.setToolTip(key.tip)
            self.rows.addRow(label, field)
            self.fields[key.name], self.labels[key.name] = field, label
            field.edited.connect(lambda value, name=key.name: self.edited.emit(name, value))

    def show_values(self, part: object) -> None:
        """Show a dataclass that has these keys."""
        named = {one.name for one in fields(part)}  # type: ignore[arg-type]
        for name, field in self.fields.items():
            if name in named:
                field.show_value(getattr(part, name))

    def align(self, width: int) -> None:
        """Make the labels of several forms equally wide."""
        for label in self.labels.values():
            label.setMinimumWidth(width)


def _field(key: Key) -> AnyField:
    match key.kind:
        case "place":
            return coordinates(key.words, key.tip)
        case "band":
            return PairField(*(NumberField(f"{key.words}: {end}", key.unit, key.low, key.high, key.step,
                                           f"{key.tip}: {end} end") for end in ("lower", "upper")))  # fmt: skip
        case "switch":
            return SwitchField(key.words, key.tip)
        case "choice":
            return ChoiceField(key.words, key.choices, key.tip)
        case "text":
            return TextField(key.words, key.tip)
        case "optional":
            return OptionalField(key.words, NumberField(key.words, key.unit, key.low, key.high, key.step, key.tip))
    make = WholeField if key.kind == "whole" else NumberField
    return make(key.words, key.unit, key.low, key.high, key.step, key.tip)
