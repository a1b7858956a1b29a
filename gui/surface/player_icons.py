"""Signs of a player's buttons, drawn: not every font has them."""

from __future__ import annotations

from collections.abc import Callable

from PyQt5.QtCore import QPointF, QRectF, Qt
from PyQt5.QtGui import QColor, QIcon, QPainter, QPen, QPixmap, QPolygonF

from gui.shell.theme import Theme

_SIDE = 64


def player_icon(sign: str, theme: Theme) -> QIcon:
    """The sign ``"play"``, ``"pause"``, ``"back"``, ``"on"`` or ``"loop"`` in the colour of text."""
    icon = QIcon()
    for state, colour in ((QIcon.State.Off, theme.text), (QIcon.State.On, theme.text)):
        # A button that is down stands on the accent's colour, but for play, whose sign changes instead.
        down = state == QIcon.State.On and sign == "loop"
        icon.addPixmap(_drawn(sign, QColor(theme.window if down else colour)), QIcon.Mode.Normal, state)
        icon.addPixmap(_drawn(sign, QColor(theme.faint)), QIcon.Mode.Disabled, state)
    return icon


def _drawn(sign: str, colour: QColor) -> QPixmap:
    picture = QPixmap(_SIDE, _SIDE)
    picture.fill(Qt.GlobalColor.transparent)
    painter = QPainter(picture)
    painter.setRenderHint(QPainter.RenderHint.Antialiasing)
    painter.scale(_SIDE / 16, _SIDE / 16)
    painter.setPen(Qt.PenStyle.NoPen)
    painter.setBrush(colour)
    _SIGNS[sign](painter)
    painter.end()
    return picture


def _triangle(painter: QPainter, *corners: tuple[float, float]) -> None:
    painter.drawPolygon(QPolygonF([QPointF(x, y) for x, y in corners]))


def _play(painter: QPainter) -> None:
    _triangle(painter, (4, 2), (14, 8), (4, 14))


def _pause(painter: QPainter) -> None:
    painter.drawRect(QRectF(3.5, 2.5, 3, 11))
    painter.drawRect(QRectF(9.5, 2.5, 3, 11))


def _back(painter: QPainter) -> None:
    painter.drawRect(QRectF(3, 3, 2, 10))
    _triangle(painter, (13, 3), (13, 13), (5.5, 8))


def _on(painter: QPainter) -> None:
    painter.drawRect(QRectF(11, 3, 2, 10))
    _triangle(painter, (3, 3), (3, 13), (10.5, 8))


def _loop(painter: QPainter) -> None:
    pen = QPen(painter.brush().color(), 1.8)
    painter.setPen(pen)
    painter.setBrush(Qt.BrushStyle.NoBrush)
    painter.drawArc(QRectF(3, 3.5, 10, 10), 90 * 16, -290 * 16)
    painter.setBrush(pen.color())
    painter.setPen(Qt.PenStyle.NoPen)
    _triangle(painter, (8.4, 0.4), (8.4, 6.6), (4, 3.5))


_SIGNS: dict[str, Callable[[QPainter], None]] = {
    "play": _play, "pause": _pause, "back": _back, "on": _on, "loop": _loop,
}  # fmt: skip
