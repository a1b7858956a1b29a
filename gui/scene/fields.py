"""Fields of forms: numbers with their unit, points, choices; each tells only what people change."""

from __future__ import annotations

from collections.abc import Sequence

from PyQt5.QtCore import QEvent, QLocale, Qt, pyqtSignal
from PyQt5.QtGui import QKeyEvent, QKeySequence, QWheelEvent
from PyQt5.QtWidgets import QCheckBox, QComboBox, QDoubleSpinBox, QHBoxLayout, QLineEdit, QSizePolicy, QWidget

_DECIMALS = 6
_WIDE = 1e9


class NumberField(QDoubleSpinBox):
    """A number with its unit.

    Parameters
    ----------
    name, unit : str
        What it is, and its unit, empty for none.
    low, high : float
        What is allowed.
    step : float
        Of the arrows.
    tip : str
        What it means.
    """

    edited = pyqtSignal(object)
    decimals_shown = _DECIMALS

    def __init__(self, name: str, unit: str, low: float, high: float, step: float, tip: str) -> None:
        super().__init__()
        self.setAccessibleName(f"{name} in {unit}" if unit else name)
        self.setLocale(QLocale.c())  # a decimal point, as in files
        self.setDecimals(self.decimals_shown)
        self.setRange(low, high)
        self.setSingleStep(step)
        self.setKeyboardTracking(False)
        if unit:
            self.setSuffix(f" {unit}")
        self.setToolTip(f"{tip}; {_allowed(low, high, unit)}")
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.setMinimumWidth(self.fontMetrics().horizontalAdvance("-0000") + 30)
        self.valueChanged.connect(lambda value: self.edited.emit(self._told(value)))

    def show_value(self, value: float) -> None:
        """Show a value without telling that it was changed."""
        if value != self.value():
            self.blockSignals(True)
            self.setValue(value)
            self.blockSignals(False)

    def event(self, event: QEvent | None) -> bool:
        """Leave undo to the scene, once what is typed counts."""
        if event is not None and event.type() == QEvent.Type.ShortcutOverride:
            typed = self.text() != f"{self.textFromValue(self.value())}{self.suffix()}"
            if not typed and _is_undo(event):
                return False
        return super().event(event)

    def textFromValue(self, value: float) -> str:  # noqa: N802
        """As many decimals as say something."""
        text = f"{value:.{self.decimals_shown}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text

    def _told(self, value: float) -> float:
        return value

    def wheelEvent(self, event: QWheelEvent | None) -> None:  # noqa: N802
        """Let the form scroll, unless the field is being edited."""
        if event is not None and not self.hasFocus():
            event.ignore()
        else:
            super().wheelEvent(event)


class WholeField(NumberField):
    """A whole number."""

    decimals_shown = 0

    def _told(self, value: float) -> float:
        return int(value)


class PairField(QWidget):
    """Two numbers in a row, such as a point's coordinates.

    Parameters
    ----------
    fields : sequence of NumberField
        The two.
    """

    edited = pyqtSignal(object)

    def __init__(self, *fields: NumberField) -> None:
        super().__init__()
        self.fields = fields
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.setSpacing(4)
        for field in fields:
            row.addWidget(field)
            field.edited.connect(lambda _value: self.edited.emit(tuple(one.value() for one in self.fields)))
        self.setFocusProxy(fields[0])

    def show_value(self, value: Sequence[float]) -> None:
        """Show both."""
        for field, one in zip(self.fields, value, strict=True):
            field.show_value(one)


class OptionalField(QWidget):
    """A number that may be left out.

    Parameters
    ----------
    name : str
        What it is.
    field : NumberField
        The number.
    """

    edited = pyqtSignal(object)

    def __init__(self, name: str, field: NumberField) -> None:
        super().__init__()
        self.field, self.switch = field, QCheckBox()
        self.switch.setAccessibleName(f"Whether there is a {name}")
        self.switch.setToolTip(field.toolTip())
        field.setEnabled(False)
        row = QHBoxLayout(self)
        row.setContentsMargins(0, 0, 0, 0)
        row.addWidget(self.switch)
        row.addWidget(field, stretch=1)
        self.setFocusProxy(self.switch)
        self.switch.clicked.connect(lambda on: self.edited.emit(field.value() if on else None))
        field.edited.connect(self.edited)

    def show_value(self, value: float | None) -> None:
        """Show a number, or that there is none."""
        self.switch.setChecked(value is not None)
        self.field.setEnabled(value is not None)
        if value is not None:
            self.field.show_value(value)


class SwitchField(QCheckBox):
    """Yes or no.

    Parameters
    ----------
    words, tip : str
        What is on when it is on.
    """

    edited = pyqtSignal(object)

    def __init__(self, words: str, tip: str) -> None:
        super().__init__(words)
        self.setAccessibleName(words)
        self.setToolTip(tip)
        self.clicked.connect(self.edited.emit)

    def show_value(self, value: bool) -> None:
        """Show whether it is on."""
        self.setChecked(value)


class ChoiceField(QComboBox):
    """One of several words.

    Parameters
    ----------
    name : str
        What is chosen.
    choices : sequence of (value, words)
        What there is.
    tip : str
        What it means.
    """

    edited = pyqtSignal(object)

    def __init__(self, name: str, choices: Sequence[tuple[str, str]], tip: str) -> None:
        super().__init__()
        self.setAccessibleName(name)
        self.setToolTip(tip)
        for value, words in choices:
            self.addItem(words, value)
        self.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.activated.connect(lambda _index: self.edited.emit(self.currentData()))

    def show_value(self, value: str) -> None:
        """Show which one it is."""
        self.setCurrentIndex(self.findData(value))

    def wheelEvent(self, event: QWheelEvent | None) -> None:  # noqa: N802
        """Let the form scroll, unless the field is being edited."""
        if event is not None and not self.hasFocus():
            event.ignore()
        else:
            super().wheelEvent(event)


class TextField(QLineEdit):
    """A line of text, which may not be empty.

    Parameters
    ----------
    name, tip : str
        What it is, and what it means.
    """

    edited = pyqtSignal(object)

    def __init__(self, name: str, tip: str) -> None:
        super().__init__()
        self.setAccessibleName(name)
        self.setToolTip(tip)
        self.setAcceptDrops(False)  # the window takes what is dropped
        self._shown = ""
        self.textEdited.connect(self._edited)
        self.editingFinished.connect(lambda: self.show_value(self._shown))

    def show_value(self, value: str) -> None:
        """Show a text."""
        self._shown = value
        if value != self.text():
            self.setText(value)

    def event(self, event: QEvent | None) -> bool:
        """Leave undo to the scene."""
        if event is not None and event.type() == QEvent.Type.ShortcutOverride and _is_undo(event):
            return False
        return super().event(event)

    def _edited(self, text: str) -> None:
        if text:
            self._shown = text
            self.edited.emit(text)


def _is_undo(event: QEvent) -> bool:
    """Whether a field is asked if it wants an undo's keys for itself."""
    if not isinstance(event, QKeyEvent):
        return False
    undoes = event.matches(QKeySequence.StandardKey.Undo) or event.matches(QKeySequence.StandardKey.Redo)
    if undoes:
        event.ignore()
    return undoes


def coordinates(name: str, tip: str) -> PairField:
    """Two fields for a place on the surface."""
    return PairField(
        *(NumberField(f"{name}: {axis}", "mm", -_WIDE, _WIDE, 1.0, f"{tip}: {axis}") for axis in ("x", "y"))
    )


def _allowed(low: float, high: float, unit: str) -> str:
    unit = f" {unit}" if unit else ""
    if low <= -_WIDE and high >= _WIDE:
        return "any number" + (f" of{unit}" if unit else "")
    if high >= _WIDE:
        return f"{low:g}{unit} or more"
    return f"{low:g} to {high:g}{unit}"
