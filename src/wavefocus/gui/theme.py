"""Light and dark theme, chosen at start: colours of widgets and plots, and the style of check boxes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, ClassVar

import pyqtgraph
from PyQt5.QtGui import QColor, QPainter, QPalette
from PyQt5.QtWidgets import QApplication, QProxyStyle, QStyle, QStyleOption, QWidget

if TYPE_CHECKING:
    from pyqtgraph import PlotItem


@dataclass(frozen=True, slots=True)
class Theme:
    """Colours; `cell` is a position that is not measured, `ink` text on a coloured ground, `traces` lines in plots."""

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

    def trace(self, number: int) -> str:
        """Colour of a line, from 0; they repeat."""
        return self.traces[number % len(self.traces)]


LIGHT = Theme(
    "light", "#f3f4f6", "#ffffff", "#f1f4f8", "#e8ebef", "#1b1f24", "#5b6572", "#0b5c94", "#c3cad2", "#d9dee4",
    "#ffffff", "#0072b2", "#b26a00", "#b83a00", ("#0072b2", "#d55e00", "#117a5b", "#a3488c", "#8a6d00"),
)  # fmt: skip
DARK = Theme(
    "dark", "#22262b", "#191c20", "#20242a", "#2e343b", "#e8ebee", "#9aa5b1", "#56b4e9", "#4a535d", "#3a424b",
    "#10151a", "#56b4e9", "#f0b030", "#ff8a4c", ("#56b4e9", "#ff8a4c", "#35c49b", "#e29ac6", "#f0e442"),
)  # fmt: skip


class Themed:
    """A widget that is drawn in the colours of `theme`, which is chosen before the first widget is made."""

    theme: ClassVar[Theme] = LIGHT


def palette_of(theme: Theme) -> QPalette:
    """The palette of all widgets."""
    role = QPalette.ColorRole
    palette = QPalette(QColor(theme.button), QColor(theme.window))  # derives the shades of frames
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


def use_desktop_theme(application: QApplication) -> None:
    """Draw everything in light or dark colours, as the desktop's palette is."""
    dark = application.palette().color(QPalette.ColorRole.Window).lightness() < 128
    theme = Themed.theme = DARK if dark else LIGHT
    application.setPalette(palette_of(theme))
    pyqtgraph.setConfigOptions(background=theme.base, foreground=theme.text)
    sheet = (
        f"QToolTip {{ color: {theme.text}; background: {theme.base}; border: 1px solid {theme.grid}; padding: 3px; }}"
        f"QToolButton:checked {{ background: {theme.accent}; color: {theme.window}; border: 1px solid {theme.accent};"
        " border-radius: 3px; padding: 3px 4px; }"
        f"QLabel[role='faint'] {{ color: {theme.faint}; }}"
        f"QLabel[role='warning'] {{ color: {theme.warning}; }}"
        f"QLabel[role='fault'] {{ color: {theme.fault}; }}"
        f"QLabel[role='strong'] {{ font-weight: 600; }}"
    )
    if sheet != application.styleSheet():  # the same again would polish every widget anew
        application.setStyleSheet(sheet)


def theme_axes(plot: PlotItem) -> None:
    """Give a plot's axes the theme's colours, and no prefix: the unit is part of the label."""
    theme = Themed.theme
    for name in ("left", "bottom", "right", "top"):
        axis = plot.getAxis(name)
        axis.enableAutoSIPrefix(False)
        axis.setPen(pyqtgraph.mkPen(theme.grid))
        axis.setTextPen(pyqtgraph.mkPen(theme.text))


class BoxStyle(QProxyStyle):
    """Fusion, with outlines of check boxes that are visible in the dark theme too."""

    def __init__(self) -> None:
        super().__init__("Fusion")

    def drawPrimitive(  # noqa: N802
        self,
        element: QStyle.PrimitiveElement,
        option: QStyleOption | None,
        painter: QPainter | None,
        widget: QWidget | None = None,
    ) -> None:
        """Draw with an outline in the colour of placeholders; Fusion derives it from the window's colour."""
        if element == QStyle.PrimitiveElement.PE_IndicatorCheckBox and option is not None:
            outline = option.palette.color(QPalette.ColorRole.PlaceholderText)
            option.palette.setColor(QPalette.ColorRole.Window, outline.lighter(140))
        super().drawPrimitive(element, option, painter, widget)
