"""The Files tab: the texts of run and rig file, and beside each what it means."""

from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np
from PyQt5.QtGui import QShowEvent
from PyQt5.QtWidgets import QAction, QStackedWidget, QTabWidget, QWidget

from wavefocus.acquisition.wording import hours
from wavefocus.gui import widgets as ui
from wavefocus.gui.editor.document import TextDocument, TextFiles, closing_question
from wavefocus.gui.editor.text_edit import FileBar, TextPanel
from wavefocus.gui.files import FileKind
from wavefocus.gui.message_bar import error_text
from wavefocus.gui.surface import PlotSurface, plan_surface
from wavefocus.gui.surface_view import SurfaceView, rgba
from wavefocus.gui.tab import ClosingQuestion, Tab, TabContext
from wavefocus.gui.theme import Themed
from wavefocus.storage.errors import WavefocusError

# A surface with lines of text, and a table: titles and rows; both may be empty.
_Meaning = tuple[PlotSurface, Sequence[str], Sequence[str], Sequence[Sequence[str]]]


def _meaning_of_run(text: str, path: Path) -> _Meaning:
    """Grid, actuators and hours of a run. Raises InputError: The run cannot be carried out."""
    from wavefocus.acquisition.plan import schedule_name  # loads SciPy, and this runs in a thread
    from wavefocus.campaign.blueprint import blueprint_of
    from wavefocus.configuration import check_rows, load_run

    configuration = load_run(path, text)
    blueprint = blueprint_of(configuration)
    plan, rig = blueprint.plan, configuration.rig
    checks = check_rows(configuration)
    start_hz, stop_hz = plan.excitation.band_hz
    lines = [
        f"{plan.positions - len(checks)} positions on the grid, {len(checks)} check positions (rings), "
        f"{plan.actuators} actuators",
        f"{hours(plan.campaign_s(plan.order, rig.recorder))} in all; {schedule_name(plan)}, "
        f"{start_hz:g} to {stop_hz:g} Hz, {plan.excitation.amplitude_v:g} V",
        f"bank of {blueprint.bank_header().file_bytes / 1e6:.0f} MB",
    ]
    return plan_surface(rig, np.asarray(configuration.position_mm), checks), lines, (), ()


def _meaning_of_rig(text: str, path: Path) -> _Meaning:
    """Channels and limits of a rig. Raises InputError: The rig file is wrong."""
    from wavefocus.configuration import load_rig
    from wavefocus.rig.limits import limits_of

    rig = load_rig(path, text)
    player, limits = rig.player, limits_of(rig.player)
    rms = "" if limits.rms_v is None else f"{limits.rms_v:g} V"
    rows = [
        (str(actuator), f"{x_mm:g}, {y_mm:g}", str(channel), f"{player.output_full_scale_v[channel]:g} V",
         f"{limits.peak_v:g} V", rms)
        for actuator, ((x_mm, y_mm), channel) in enumerate(zip(rig.actuators.position_mm, player.channels, strict=True))
    ]  # fmt: skip
    rows.append(("loopback", "", str(player.loopback_channel), "", "", ""))
    instruments = ("mirror", "recorder", "player", "vibrometer")
    lines = [
        f"{len(player.channels)} actuators on a surface of {rig.surface.length_mm:g} × {rig.surface.width_mm:g} mm",
        "drivers: " + ", ".join(f"{name} {getattr(rig, name).driver}" for name in instruments),
    ]
    titles = ("actuator", "place (mm)", "channel", "full scale", "limit", "rms limit")
    return plan_surface(rig, np.asarray(rig.actuator_mm), ()), lines, titles, rows


MEANINGS = {"run": _meaning_of_run, "rig": _meaning_of_rig}


_KINDS = {FileKind.RUN: "run", FileKind.RIG: "rig"}


class _FilePage(Themed, QWidget):
    """The text of a run or rig file, and what it means."""

    def __init__(self, kind: str, context: TabContext, owner: QWidget) -> None:
        super().__init__()
        self._context = context
        self.document = TextDocument(kind, self)
        self.files = TextFiles(context, self.document, owner)
        self.editor = TextPanel(self.document)
        self.surface = SurfaceView(f"Surface of the {kind} file")
        self.lines = ui.label("Meaning of the text", wraps=True, selectable=True)
        self.lines.setMinimumHeight(3 * self.lines.fontMetrics().lineSpacing())
        self.table = ui.table(("",), "Channels and limits", ())
        self.table.hide()
        self.bar = FileBar(self, self.document, self.files)
        right = QWidget()
        ui.column((self.surface, 2), self.lines, (self.table, 1), owner=right, spacing=4)
        self.columns = ui.side_by_side((self.editor, 620), (right, 600), growing=[0, 1])
        ui.column(self.bar, (self.columns, 1), owner=self, spacing=4)
        self.document.changed.connect(self._ask)

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802
        super().showEvent(event)
        self._ask()

    def _ask(self) -> None:
        """Find out in a thread what the text means, while it is shown."""
        document = self.document
        if not self.isVisible() or document.mistakes or not document.worth_keeping:
            return
        work = partial(MEANINGS[document.kind], document.toml(), document.place)
        self._context.background.ask(f"{document.kind} text", work, self._show, self._refuse)

    def _show(self, meaning: _Meaning) -> None:
        surface, lines, titles, rows = meaning
        self.surface.show_surface(surface)
        shown = rgba(self.theme.cell) if self.document.kind == "run" else np.zeros(4, np.uint8)
        self.surface.paint(np.tile(shown, (surface.positions, 1)))
        self.lines.setText("\n".join(lines))
        self.table.setColumnCount(len(titles))
        self.table.setHorizontalHeaderLabels(list(titles))
        self.table.setRowCount(len(rows))
        for number, row in enumerate(rows):
            ui.fill_row(self.table, number, row)
        self.table.setVisible(bool(rows))
        self.lines.setStyleSheet("")

    def _refuse(self, failure: Exception) -> None:
        """Say what is wrong with the files together; the surface stays."""
        if not isinstance(failure, WavefocusError | OSError):
            raise failure
        self.lines.setText(error_text(failure).removeprefix(f"{self.document.place}: "))
        self.lines.setStyleSheet(f"QLabel {{ color: {self.theme.fault}; }}")


class FilesTab(Tab):
    """Edits run and rig file; scenes have their own tab."""

    title = "Files"

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.pages = {kind: _FilePage(name, context, self) for kind, name in _KINDS.items()}
        self._stack = QStackedWidget()
        for page in self.pages.values():
            self._stack.addWidget(page)
        choices = [(kind, kind.capitalize(), f"The text of the {kind}", kind) for kind in _KINDS]
        self.buttons = ui.exclusive_buttons(choices, lambda kind: self.show_page(FileKind(kind)))
        ui.column(ui.row(*self.buttons.values(), None), (self._stack, 1), owner=self, margins=ui.PAGE_MARGINS)
        self.remember(**{f"{name}_columns": self.pages[kind].columns for kind, name in _KINDS.items()})
        for page in self.pages.values():
            page.files.restore_unsaved()

    def menu_actions(self) -> list[QAction | None]:
        return [ui.action(self, f"&{kind.capitalize()}", partial(self.show_page, kind)) for kind in _KINDS]

    def show_page(self, kind: FileKind) -> None:
        """Show the run file or the rig file."""
        self.buttons[kind].setChecked(True)
        self._stack.setCurrentWidget(self.pages[kind])
        stack = self.parentWidget()
        tabs = None if stack is None else stack.parentWidget()
        if isinstance(tabs, QTabWidget):
            tabs.setCurrentWidget(self)

    def use_shared(self, kind: FileKind, path: Path) -> None:
        """Show the run and rig file of the other tabs; a text with unsaved changes stays."""
        page = self.pages.get(kind)
        if page is not None and page.document.saved and page.document.path != path:
            page.files.show(path)

    def closing_question(self) -> ClosingQuestion | None:
        return closing_question(self.context, [page.files for page in self.pages.values()])

    def save_settings(self) -> None:
        super().save_settings()
        for page in self.pages.values():
            page.files.save_settings()
