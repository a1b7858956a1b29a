"""Four arrow buttons round a choice of the step."""

from __future__ import annotations

from collections.abc import Sequence

from PyQt5.QtCore import Qt, pyqtSignal
from PyQt5.QtWidgets import QComboBox, QGridLayout, QToolButton, QWidget

_PLACES = (("up", "▲", 0, 1, 0, 1), ("left", "◀", 1, 0, -1, 0), ("right", "▶", 1, 2, 1, 0), ("down", "▼", 2, 1, 0, -1))


class Arrows(QWidget):
    """Asks for steps; holding a button repeats it.

    Parameters
    ----------
    steps : sequence of float
        Sizes that can be chosen.
    unit : str
        Their unit.
    chosen : int
        Which of them is chosen first.
    """

    stepped = pyqtSignal(float, float)

    def __init__(self, steps: Sequence[float], unit: str, chosen: int) -> None:
        super().__init__()
        self._steps = tuple(steps)
        self.size_choice = QComboBox()
        self.size_choice.addItems([f"{step:g} {unit}" for step in steps])
        self.size_choice.setCurrentIndex(chosen)
        self.size_choice.setAccessibleName(f"Step of the arrows in {unit}")
        self.size_choice.setToolTip(f"Step of the arrows, in {unit}; Page up and Page down choose another")
        self.buttons: dict[str, QToolButton] = {}
        grid = QGridLayout(self)
        grid.setContentsMargins(0, 0, 0, 0)
        for word, sign, row, column, x, y in _PLACES:
            button = QToolButton()
            button.setText(sign)
            button.setAutoRepeat(True)
            button.setAutoRepeatInterval(120)
            button.setAccessibleName(f"Move the beam {word}")
            button.setToolTip(f"Move the beam {word} by a step (arrow key on the picture)")
            button.clicked.connect(lambda _checked=False, x=x, y=y: self.step(x, y))
            grid.addWidget(button, row, column, Qt.AlignmentFlag.AlignCenter)
            self.buttons[word] = button
        grid.addWidget(self.size_choice, 1, 1)

    def step(self, x: int, y: int) -> None:
        """Ask for a step along x, y or both."""
        size = self._steps[self.size_choice.currentIndex()]
        self.stepped.emit(size * x, size * y)
