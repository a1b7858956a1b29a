"""The box for numbers: point and comma are both the decimal separator, in every locale, and grouping is refused.

Qt's own boxes read a text by the locale and drop what does not fit, key by key: "0,2" becomes 2, "1,5" 15.
"""

import math
import re
from decimal import ROUND_HALF_UP, Decimal

from PyQt5.QtCore import QLocale
from PyQt5.QtGui import QValidator
from PyQt5.QtWidgets import QDoubleSpinBox, QToolTip

# Digits with at most one separator; no grouping, no other scripts' digits, no words such as nan.
_NUMBER = re.compile(r"[+-]?(?:[0-9]+[.,]?[0-9]*|[.,][0-9]+)(?:[eE][+-]?[0-9]{1,3})?")


def typed_number(text: str) -> float | None:
    """Return the number that a person typed, None where the text is not a number.

    text: Digits with a point or a comma as the decimal separator, perhaps with a sign and an exponent.
    """
    text = text.strip()
    return float(text.replace(",", ".")) if _NUMBER.fullmatch(text) else None


class NumberBox(QDoubleSpinBox):
    """A number with its unit; what is typed counts when it is finished (Enter, Tab, or another widget is used).

    A text that is not a number, is out of range or, in a box for whole numbers, has a fraction, is refused as a whole:
    the box then shows the former value, and says so.
    """

    def __init__(self, decimals: int, low: float, high: float, *, prefix: str = "", suffix: str = "") -> None:
        super().__init__()
        self.setLocale(QLocale.c())  # a decimal point is shown, as in files
        self.setKeyboardTracking(False)  # "0.2" is not 0 on the way
        self.setDecimals(decimals)
        self.setRange(low, high)
        self.setPrefix(prefix)
        self.setSuffix(suffix)

    def whole(self) -> int:
        """Return the value of a box without decimals."""
        return round(self.value())

    def value(self) -> float:
        """Return the number that is shown; a text that is not one is refused first."""
        number = self._number(self.text())
        if number is None:
            self.interpretText()
        return super().value() if number is None else number

    def validate(self, text: str | None, position: int) -> tuple[QValidator.State, str, int]:
        """Return whether a text is a number; no key is refused, for a number without it would be another one."""
        text = text or ""
        finished = self._number(text) is not None
        return QValidator.State.Acceptable if finished else QValidator.State.Intermediate, text, position

    def fixup(self, text: str | None) -> str:
        """Report a text that is refused; Qt then shows the former value."""
        typed, low, high = self._without_unit(text or ""), self.minimum(), self.maximum()
        kind = "number" if self.decimals() else "whole number"
        limits = f"{self.textFromValue(low)} to {self.textFromValue(high)}{self.suffix()}"
        allowed = kind if typed_number(typed) is None else f"{kind} from {limits}"
        sentence = f"“{typed}” is not a {allowed}; the value stays {self.textFromValue(super().value())}{self.suffix()}"
        QToolTip.showText(self.mapToGlobal(self.rect().bottomLeft()), sentence, self)
        return text or ""

    def valueFromText(self, text: str | None) -> float:  # noqa: N802
        number = self._number(text or "")
        return super().value() if number is None else number

    def textFromValue(self, value: float) -> str:  # noqa: N802
        """Return a value as short as its decimals allow."""
        text = f"{value:.{self.decimals()}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text

    def _without_unit(self, text: str) -> str:
        return text.removeprefix(self.prefix().rstrip()).strip().removesuffix(self.suffix().strip()).strip()

    def _number(self, text: str) -> float | None:
        """Return the number of a text, rounded to the decimals of the box; None where the box cannot hold it."""
        number = typed_number(self._without_unit(text))
        if number is None or not math.isfinite(number):
            return None
        if not self.decimals() and not number.is_integer():
            return None
        step = Decimal(1).scaleb(-self.decimals())
        rounded = float(Decimal(repr(number)).quantize(step, ROUND_HALF_UP)) if abs(number) < 1e15 else number
        # A value that rounding makes vanish, 0.0001 in a box of three decimals, is not in its range.
        return rounded if self.minimum() <= number <= self.maximum() else None
