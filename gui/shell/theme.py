"""Light and dark theme: colours of widgets and plots, and the style of check boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import pyqtgraph
from PyQt5.QtCore import QPointF, QRectF, Qt
from PyQt5.QtGui import QColor, QPainter, QPalette, QPen, QPolygonF
from PyQt5.QtWidgets import QApplication, QProxyStyle, QStyle, QStyleOption, QWidget

if TYPE_CHECKING:
    from pyqtgraph import PlotItem

DARK_BELOW = 128
_SMALLEST_PT, _LARGEST_PT = 7, 24


@dataclass(frozen=True, slots=True)
class Theme:
    """Colours.

    Parameters
    ----------
    name : str
        ``"light"`` or ``"dark"``.
    window, base, alternate, button, text, faint, accent : str
        Of widgets.
    grid, cell : str
        Lines that must not compete with data; positions that are not measured.
    ink : str
        Of words on a coloured ground.
    good, warning, fault : str
        After Okabe and Ito: told apart with any kind of colour vision.
    traces : tuple of str
        For lines in plots.
    """

    name: str
    window: str
    base: str
    alternate: str
    button: str
    text: str
    faint: str
    accent: str
    grid: str
    cell: str
    ink: str
    good: str
    warning: str
    fault: str
    traces: tuple[str, ...]


LIGHT = Theme(
    "light", "#f3f4f6", "#ffffff", "#f1f4f8", "#e8ebef", "#1b1f24", "#5b6572", "#0b5c94", "#c3cad2", "#d9dee4",
    "#ffffff", "#0072b2", "#b26a00", "#b83a00", ("#0072b2", "#d55e00", "#117a5b", "#a3488c", "#8a6d00"),
)  # fmt: skip
DARK = Theme(
    "dark", "#22262b", "#191c20", "#20242a", "#2e343b", "#e8ebee", "#9aa5b1", "#56b4e9", "#4a535d", "#3a424b",
    "#10151a", "#56b4e9", "#f0b030", "#ff8a4c", ("#56b4e9", "#ff8a4c", "#35c49b", "#e29ac6", "#f0e442"),
)  # fmt: skip
CHOICES = ("system", "light", "dark")


def theme_named(choice: str, system: QPalette) -> Theme:
    """The theme of a choice; ``"system"`` follows the desktop's palette."""
    if choice == "system":
        return DARK if system.color(QPalette.ColorRole.Window).lightness() < DARK_BELOW else LIGHT
    return DARK if choice == "dark" else LIGHT


def palette_of(theme: Theme) -> QPalette:
    """The palette of all widgets."""
    role = QPalette.ColorRole
    palette = QPalette()
    for roles, colour in (
        ((role.Window,), theme.window),
        ((role.Base,), theme.base),
        ((role.AlternateBase,), theme.alternate),
        ((role.Button,), theme.button),
        ((role.WindowText, role.Text, role.ButtonText, role.ToolTipText), theme.text),
        ((role.ToolTipBase,), theme.base),
        ((role.Highlight, role.Link), theme.accent),
        ((role.HighlightedText,), theme.ink),
        ((role.PlaceholderText,), theme.faint),
    ):
        for one in roles:
            palette.setColor(one, QColor(colour))
    for one in (role.WindowText, role.Text, role.ButtonText):
        palette.setColor(QPalette.ColorGroup.Disabled, one, QColor(theme.faint))
    return palette


def set_theme(application: QApplication, theme: Theme) -> None:
    """Dress the application; plots that exist are dressed by their owners."""
    application.setPalette(palette_of(theme))
    pyqtgraph.setConfigOptions(background=theme.base, foreground=theme.text)
    sheet = (
        f"QToolTip {{ color: {theme.text}; background: {theme.base}; border: 1px solid {theme.grid}; padding: 3px; }}"
        f"QToolButton:checked {{ background: {theme.accent}; color: {theme.window}; border: 1px solid {theme.accent};"
        " border-radius: 3px; padding: 3px 4px; }"
        f"QLabel[role='faint'] {{ color: {theme.faint}; }}"
        f"QLabel[role='strong'] {{ font-weight: 600; }}"
    )
    if sheet != application.styleSheet():  # the same again would polish every widget anew
        application.setStyleSheet(sheet)


def theme_axes(plot: PlotItem, theme: Theme) -> None:
    """Give a plot's axes and title the theme's colours."""
    for name in ("left", "bottom", "right", "top"):
        axis = plot.getAxis(name)
        axis.setPen(pyqtgraph.mkPen(theme.grid))
        axis.setTextPen(pyqtgraph.mkPen(theme.text))


def resized_text(application: QApplication, step: int) -> int:
    """Make all text larger or smaller by some points; return its size now."""
    font = application.font()
    size_pt = min(max(font.pointSize() + step, _SMALLEST_PT), _LARGEST_PT)
    font.setPointSize(size_pt)
    application.setFont(font)
    return size_pt


_BOXES = (QStyle.PrimitiveElement.PE_IndicatorCheckBox, QStyle.PrimitiveElement.PE_IndicatorItemViewItemCheck)
_ROUNDING = 0.15
_STROKE = 0.13
# Corners of the tick, as parts of the box's side.
_TICK = ((0.24, 0.52), (0.43, 0.71), (0.77, 0.31))
_BAR = ((0.25, 0.5), (0.75, 0.5))


class TickStyle(QProxyStyle):
    """Fusion, with boxes drawn from the palette: accent and a tick when on, a bar when only a part is on."""

    def __init__(self) -> None:
        super().__init__("Fusion")

    def drawPrimitive(  # noqa: N802
        self,
        element: QStyle.PrimitiveElement,
        option: QStyleOption | None,
        painter: QPainter | None,
        widget: QWidget | None = None,
    ) -> None:
        """Draw a box here, and all else as Fusion does."""
        if element in _BOXES and option is not None and painter is not None:
            _draw_box(option, painter)
        else:
            super().drawPrimitive(element, option, painter, widget)


def _draw_box(option: QStyleOption, painter: QPainter) -> None:
    state, palette, flags = option.state, option.palette, QStyle.StateFlag
    enabled = bool(state & flags.State_Enabled)
    on, part = bool(state & flags.State_On), bool(state & flags.State_NoChange)
    faint, accent = palette.color(QPalette.ColorRole.PlaceholderText), palette.color(QPalette.ColorRole.Highlight)
    ground = palette.color(QPalette.ColorRole.Base if enabled else QPalette.ColorRole.Window)
    outline, sign = faint, faint
    if enabled and (on or part):
        ground, outline, sign = accent, accent, palette.color(QPalette.ColorRole.HighlightedText)
    elif enabled and state & flags.State_MouseOver:
        outline = accent
    elif not enabled:
        outline = _between(faint, ground)
    side = min(option.rect.width(), option.rect.height()) - 1.0
    box = QRectF(0.0, 0.0, side, side)
    box.moveCenter(QRectF(option.rect).center())
    painter.save()
    painter.setRenderHint(QPainter.RenderHint.Antialiasing)
    painter.setPen(QPen(outline, 1.0))
    painter.setBrush(ground)
    painter.drawRoundedRect(box, _ROUNDING * side, _ROUNDING * side)
    if on or part:
        pen = QPen(sign, _STROKE * side, Qt.PenStyle.SolidLine, Qt.PenCapStyle.RoundCap, Qt.PenJoinStyle.RoundJoin)
        painter.setPen(pen)
        corners = [QPointF(box.left() + x * side, box.top() + y * side) for x, y in (_TICK if on else _BAR)]
        painter.drawPolyline(QPolygonF(corners))
    painter.restore()


def _between(one: QColor, other: QColor) -> QColor:
    return QColor((one.red() + other.red()) // 2, (one.green() + other.green()) // 2, (one.blue() + other.blue()) // 2)
