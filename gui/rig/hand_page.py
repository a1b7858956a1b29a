"""The page of a rig in a person's hands."""

from __future__ import annotations

from PyQt5.QtWidgets import QHBoxLayout, QLabel, QPushButton, QVBoxLayout, QWidget

from gui.rig.hands import Hands
from gui.rig.jog_panel import JogPanel
from gui.rig.sound_panel import SoundPanel
from gui.shell.theme import Theme
from gui.shell.widgets import side_by_side

_STATES = {
    "released": "○ the instruments are free",
    "opening": "◌ the instruments are being opened…",
    "ready": "● the instruments are in the window's hands",
    "ending": "◌ muting, parking and giving back…",
}


class HandPage(QWidget):
    """Jogs on the left, hears on the right.

    Parameters
    ----------
    hands : Hands
        Holds the instruments.
    """

    def __init__(self, hands: Hands) -> None:
        super().__init__()
        self._hands = hands
        self._seen = -1
        self.take = QPushButton("&Take the instruments")
        self.release = QPushButton("&Give them back")
        self.mute = QPushButton("M&ute")
        for button, tip in (
            (self.take, "Open mirror, recorder and player in a process of their own"),
            (self.release, "Mute, park and close the instruments, so that a capture or another program can have them"),
            (self.mute, "Silence every output at once and drop what was ordered (Ctrl+0)"),
        ):
            button.setAccessibleName(button.text().replace("&", ""))
            button.setToolTip(tip)
        self.state = QLabel()
        self.state.setAccessibleName("Who holds the instruments")
        self.jog, self.sound = JogPanel(hands), SoundPanel(hands)
        row = QHBoxLayout()
        for widget in (self.take, self.release, self.mute, self.state):
            row.addWidget(widget)
        row.addStretch(1)
        self.splitter = side_by_side((self.jog, 600), (self.sound, 640))
        column = QVBoxLayout(self)
        column.setContentsMargins(4, 6, 4, 4)
        column.addLayout(row)
        column.addWidget(self.splitter, stretch=1)
        self.release.clicked.connect(lambda _checked=False: hands.release())
        self.mute.clicked.connect(self.sound.mute)
        self.sound.actuator.currentIndexChanged.connect(self._show_chosen)

    def draw(self, *, has_rig: bool) -> None:
        """Draw what changed."""
        hands = self._hands
        self.take.setEnabled(has_rig and hands.state == "released")
        if self._seen != hands.revision["state"]:
            self._seen = hands.revision["state"]
            self.release.setEnabled(hands.state in ("opening", "ready"))
            self.mute.setEnabled(hands.state == "ready")
            self.state.setText(_STATES[hands.state])
            told = hands.facts.instruments if hands.facts is not None else {}
            self.state.setToolTip("\n".join(f"{role}: {words}" for role, words in told.items()))
        self.jog.draw()
        self.sound.draw()

    def _show_chosen(self, actuator: int) -> None:
        facts = self._hands.facts
        chosen = facts is not None and 0 <= actuator < len(facts.actuator_mm)
        self.jog.picture.show_chosen(tuple(facts.actuator_mm[actuator]) if facts is not None and chosen else None)

    def apply_theme(self, theme: Theme) -> None:
        """Take the theme's colours."""
        self.jog.apply_theme(theme)
        self.sound.apply_theme(theme)
