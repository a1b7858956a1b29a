"""Forms made from the fields of a table of the scene file: a row for each, with its title, unit, bounds and tooltip."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, Literal, get_args, get_origin

from PyQt5.QtCore import QEvent, Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent, QKeySequence, QWheelEvent
from PyQt5.QtWidgets import QAbstractSpinBox, QCheckBox, QComboBox, QFormLayout, QLabel, QLineEdit, QSizePolicy, QWidget

from wavefocus.config.fields import Table
from wavefocus.gui import widgets as ui
from wavefocus.gui.number_box import NumberBox

_DECIMALS = 6
_WIDE = 1e9
_TINY = 10.0**-_DECIMALS
# A key ends with its unit; the step of the arrows follows from it.
_UNITS = {"_mm_s": ("mm/s", 5.0), "_mm": ("mm", 1.0), "_s": ("s", 0.01), "_hz": ("Hz", 10.0), "_deg": ("°", 5.0),
          "_v": ("V", 0.1)}  # fmt: skip
_NO_UNIT = ("", 0.1)


class Form(QWidget):
    """A row for each field of a table.

    model: Its fields carry titles, descriptions, types and bounds.
    without: Keys that are edited elsewhere.
    needed: Keys that the table may leave out, but that are always given here.
    """

    #: A key, and its new value.
    edited = pyqtSignal(str, object)

    def __init__(self, model: type[Table], without: Sequence[str] = (), needed: Sequence[str] = ()) -> None:
        super().__init__()
        self.fields: dict[str, Any] = {}
        self.labels: dict[str, QLabel] = {}
        self.rows = QFormLayout(self)
        self.rows.setContentsMargins(0, 0, 0, 0)
        self.rows.setVerticalSpacing(4)
        self.rows.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        for key, info in model.model_fields.items():
            if key == "kind" or key in without:
                continue
            title, tip = info.title or key, info.description or ""
            self.fields[key] = field = _field(key, title, tip, info.annotation, info.metadata, needed=key in needed)
            self.labels[key] = label = QLabel("" if isinstance(field, SwitchField) else title)
            label.setBuddy(field)
            label.setToolTip(tip)
            self.rows.addRow(label, field)
            field.edited.connect(lambda value, key=key: self.edited.emit(key, value))

    def insert(self, label: str, field: QWidget) -> None:
        """Put a row of its own kind at the top."""
        self.rows.insertRow(0, QLabel(label), field)

    def show_values(self, table: Table) -> None:
        for key, field in self.fields.items():
            field.show_value(getattr(table, key))

    def show_row(self, key: str, shown: bool) -> None:
        self.fields[key].setVisible(shown)
        self.labels[key].setVisible(shown)


def align(forms: Sequence[QFormLayout]) -> None:
    """Make the labels of several forms equally wide."""
    role = QFormLayout.ItemRole.LabelRole
    items = [form.itemAt(row, role) for form in forms for row in range(form.rowCount())]
    labels = [label for item in items if item is not None and (label := item.widget()) is not None]
    width = max(label.sizeHint().width() for label in labels)
    for label in labels:
        label.setMinimumWidth(width)


class NumberField(NumberBox):
    """A number with its unit; Ctrl+Z and the mouse wheel pass through unless it is being edited."""

    edited = pyqtSignal(object)

    def __init__(
        self, title: str, tip: str, unit: str = "", step: float = 0.1, low: float = -_WIDE, high: float = _WIDE, *,
        decimals: int = _DECIMALS,
    ) -> None:  # fmt: skip
        super().__init__(decimals, low, high, suffix=f" {unit}" if unit else "")
        least = f", {low:g} or more" if low > -_WIDE else ""
        ui.named(self, f"{tip}{least}", f"{title} in {unit}" if unit else title)
        self.setSingleStep(step)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setMinimumWidth(self.fontMetrics().horizontalAdvance("-0000") + 30)
        if not unit and decimals:
            self.setStepType(QAbstractSpinBox.StepType.AdaptiveDecimalStepType)  # 0.01 is a usual amplitude
        self.valueChanged.connect(lambda value: self.edited.emit(value if decimals else int(value)))

    def show_value(self, value: float | None) -> None:
        """Show a value without reporting a change."""
        self.show_number(value or 0.0)

    def event(self, event: QEvent | None) -> bool:
        return False if not self.is_typing() and _is_undo(event) else super().event(event)

    def wheelEvent(self, event: QWheelEvent | None) -> None:  # noqa: N802
        if event is not None and not self.hasFocus():
            event.ignore()
        else:
            super().wheelEvent(event)


class PairField(QWidget):
    """Two numbers in a row, such as a point's coordinates."""

    edited = pyqtSignal(object)

    def __init__(self, *fields: NumberField) -> None:
        super().__init__()
        self.fields = fields
        ui.row(*fields, owner=self, spacing=4)
        for field in fields:
            field.edited.connect(lambda _value: self.edited.emit(tuple(one.value() for one in self.fields)))
        self.setFocusProxy(fields[0])

    def show_value(self, value: Sequence[float]) -> None:
        for field, one in zip(self.fields, value, strict=True):
            field.show_value(one)


class OptionalField(QWidget):
    """A number that may be left out."""

    edited = pyqtSignal(object)

    def __init__(self, title: str, field: NumberField) -> None:
        super().__init__()
        self.field, self.switch = field, ui.named(QCheckBox(), field.toolTip(), f"Use {title}")
        field.setEnabled(False)
        ui.row(self.switch, (field, 1), owner=self)
        self.setFocusProxy(self.switch)
        self.switch.clicked.connect(lambda on: self.edited.emit(field.value() if on else None))
        field.edited.connect(self.edited)

    def show_value(self, value: float | None) -> None:
        self.switch.setChecked(value is not None)
        self.field.setEnabled(value is not None)
        if value is not None:
            self.field.show_value(value)


class SwitchField(QCheckBox):
    """Yes or no."""

    edited = pyqtSignal(object)

    def __init__(self, title: str, tip: str) -> None:
        super().__init__(title)
        ui.named(self, tip, title).clicked.connect(self.edited.emit)

    def show_value(self, value: bool) -> None:
        self.setChecked(value)


class ChoiceField(QComboBox):
    """One of several values."""

    edited = pyqtSignal(object)

    def __init__(self, title: str, tip: str, choices: Sequence[str] = ()) -> None:
        super().__init__()
        ui.named(self, tip, title)
        for value in choices:
            self.addItem(value.replace("_", " "), value)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.activated.connect(lambda _index: self.edited.emit(self.currentData()))

    def show_value(self, value: str) -> None:
        self.setCurrentIndex(self.findData(value))

    def wheelEvent(self, event: QWheelEvent | None) -> None:  # noqa: N802
        if event is not None and not self.hasFocus():
            event.ignore()
        else:
            super().wheelEvent(event)


class TextField(QLineEdit):
    """A line of text, which may not be empty."""

    edited = pyqtSignal(object)

    def __init__(self, title: str, tip: str) -> None:
        super().__init__()
        ui.named(self, tip, title)
        self.setAcceptDrops(False)  # the window accepts dropped files
        self._shown = ""
        self.textEdited.connect(self._edited)
        self.editingFinished.connect(lambda: self.show_value(self._shown))

    def show_value(self, value: str) -> None:
        self._shown = value
        if value != self.text():
            self.setText(value)

    def event(self, event: QEvent | None) -> bool:
        return False if _is_undo(event) else super().event(event)

    def _edited(self, text: str) -> None:
        if text:
            self._shown = text
            self.edited.emit(text)


def _field(key: str, title: str, tip: str, annotation: Any, metadata: Sequence[object], *, needed: bool) -> QWidget:
    """The field of a key, by its type."""
    unit, step = next((_UNITS[ending] for ending in _UNITS if key.endswith(ending)), _NO_UNIT)
    kinds = list(_plain_types(annotation))
    if get_origin(annotation) is Literal:
        return ChoiceField(title, tip, get_args(annotation))
    if kinds == [bool]:
        return SwitchField(title, tip)
    if kinds == [str]:
        return TextField(title, tip)
    if get_origin(annotation) is tuple:
        names = ("x", "y") if unit == "mm" else ("lower", "upper")
        parts = zip(names, get_args(annotation), strict=True)
        return PairField(*(NumberField(f"{title}: {name}", tip, unit, step, *_bounds(part)) for name, part in parts))
    whole = kinds[0] is int
    decimals, step = (0, 1.0) if whole else (_DECIMALS, step)
    number = NumberField(title, tip, unit, step, *_bounds(annotation, metadata), decimals=decimals)
    return OptionalField(title, number) if type(None) in kinds and not needed else number


def _plain_types(annotation: Any) -> Iterator[Any]:
    parts = get_args(annotation)
    if hasattr(annotation, "__metadata__"):
        yield from _plain_types(parts[0])
    elif parts:
        for part in parts:
            yield from _plain_types(part)
    else:
        yield annotation


def _bounds(annotation: Any, metadata: Sequence[object] = ()) -> tuple[float, float]:
    """The least and the largest number that a type allows, as far as the form's fields can hold them."""
    marks = [*metadata, *getattr(annotation, "__metadata__", ())]
    for mark in list(marks):
        marks += getattr(mark, "metadata", ())
    least = [one.ge for one in marks if hasattr(one, "ge")] + [one.gt + _TINY for one in marks if hasattr(one, "gt")]
    most = [one.le for one in marks if hasattr(one, "le")]
    inner = [_bounds(part) for part in get_args(annotation) if hasattr(part, "__metadata__")]
    return max([-_WIDE, *least, *(one[0] for one in inner)]), min([_WIDE, *most, *(one[1] for one in inner)])


def _is_undo(event: QEvent | None) -> bool:
    """Whether a field is asked if it handles the keys of undo itself; those are for the scene."""
    if not isinstance(event, QKeyEvent) or event.type() != QEvent.Type.ShortcutOverride:
        return False
    undoes = event.matches(QKeySequence.StandardKey.Undo) or event.matches(QKeySequence.StandardKey.Redo)
    if undoes:
        event.ignore()
    return undoes
