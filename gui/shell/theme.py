"""Light and dark: the colours of widgets and plots, chosen so that nobody needs to tell red from green."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import pyqtgraph
from PyQt5.QtGui import QColor, QPalette
from PyQt5.QtWidgets import QApplication

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


def put_on(application: QApplication, theme: Theme) -> None:
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


def dress_axes(plot: PlotItem, theme: Theme) -> None:
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
