"""The Verification tab: composes request, progress, maps, waveforms and figures."""

from __future__ import annotations

from functools import partial
from pathlib import Path

from PyQt5.QtCore import Qt, QUrl
from PyQt5.QtGui import QDesktopServices, QDragEnterEvent, QDropEvent
from PyQt5.QtWidgets import QAction, QLabel, QStackedWidget, QVBoxLayout

from gui.files import choose_file, dropped_files
from gui.messages import error_text
from gui.process import Background
from gui.tab import Question, Tab, TabContext
from gui.theme import Theme
from gui.verification.figures_panel import FiguresPanel, WaveformPanel
from gui.verification.maps_panel import MapsPanel
from gui.verification.request import RequestForm
from gui.verification.results import Dropped, Results, dropped_kind, read_results, record_of
from gui.verification.run import RunRow, VerificationRun
from gui.widgets import copy_text, side_by_side, stacked
from rendering.verify.record import REPORT_NAME
from storage.errors import InputError

_HINT = (
    "Choose a scene, a bank, a rig and a folder, and press Verify: the scene is played and scanned, and compared with "
    "what the bank predicts.\n\nOr open the verify.json of an earlier verification, or drop it here."
)
_WAITING = "Prediction, scan and difference are shown here when the scan is done."


class VerificationTab(Tab):
    """Verify a scene, or look at what an earlier verification found."""

    title = "Verification"
    opens = (".json",)

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.results: Results | None = None
        self.background = Background(self)  # reading some hundred megabytes must hold up no other tab
        self._reading, self._reading_share, self._readings = "", (0, 0), 0
        self.run = VerificationRun(context, self.open_record)
        self.form = RequestForm(context)
        self.row = RunRow(self.form.choice, self._start, self.run.cancel, self._choose_record)
        self.maps = MapsPanel()
        self.waveforms = WaveformPanel()
        self.figures = FiguresPanel({"report": self._open_report, "folder": self._open_folder, "copy": self._copy})
        self.setAcceptDrops(True)
        self._lay_out()
        self.maps.picked.connect(self.show_position)
        self.maps.moved.connect(lambda _sample: self.waveforms.show_time(self.maps.time.time_s))
        self.waveforms.time_wanted.connect(self._go_to_time)
        self.form.out.chosen.connect(self._folder_chosen)

    def menu_actions(self) -> list[QAction | None]:
        return [self.row.start, self.row.cancel, None, self.row.open_earlier]

    def accepts(self, path: Path) -> bool:
        """Records, folders with one, and files of the same folder."""
        return record_of(path) is not None

    def open_file(self, path: Path) -> None:
        """Look at the verification that a file or a folder belongs to."""
        record = record_of(path)
        if record is not None:
            self.open_record(record)

    def open_record(self, record: Path) -> None:
        """Read a verification and show it when it is there."""
        self.context.settings.opened(record)
        self._readings += 1
        number = self._readings
        self._reading, self._reading_share = record.parent.name, (0, 0)

        def report(done: int, total: int) -> None:  # called in the thread that reads
            self._reading_share = done, total

        work = partial(read_results, record, report, lambda: number == self._readings)
        self.background.ask("verification", work, self._show, self._fail)

    def show_position(self, index: int) -> None:
        """Show the waveforms of a position, by its place in the record."""
        self.maps.mark(index)
        self.waveforms.show_position(index)
        self.waveforms.show_time(self.maps.time.time_s)

    def poll(self) -> None:
        self.run.poll()

    def draw(self) -> None:
        self.hint.setText(_WAITING if self.run.running else _HINT)
        self.row.show_progress(
            self.run.progress, stopping=self.run.stopping, missing=self.form.missing(), reading=self._reading_text()
        )

    def apply_theme(self, theme: Theme) -> None:
        for part in (self.row, self.maps, self.waveforms, self.figures):
            part.apply_theme(theme)

    def closing_question(self) -> Question | None:
        return self.run.closing_question()

    def instruments_held(self) -> str:
        busy = self.run.running and not self.run.is_virtual
        return f"a verification into {self.run.out} plays and scans" if busy else ""

    def shut_down(self) -> None:
        self._readings += 1
        self.background.end()
        self.run.detach()

    def save_settings(self) -> None:
        super().save_settings()
        self.form.save_settings()

    def dragEnterEvent(self, event: QDragEnterEvent | None) -> None:  # noqa: N802
        if event is not None and any(dropped_kind(path) is not Dropped.OTHER for path in dropped_files(event)):
            event.acceptProposedAction()

    def dropEvent(self, event: QDropEvent | None) -> None:  # noqa: N802
        if event is None:
            return
        event.acceptProposedAction()
        for path in dropped_files(event):
            self.take_dropped(path)

    def take_dropped(self, path: Path) -> None:
        """Put a file that was dropped on this tab where it belongs."""
        match dropped_kind(path):
            case Dropped.RECORD:
                self.open_file(path)
            case Dropped.SCENE:
                self.form.scene.show_path(path)
            case Dropped.RIG:
                self.form.rig.show_path(path)
                self.form.virtual.setChecked(False)
            case Dropped.BANK:
                self.form.take_bank(path)
            case Dropped.FOLDER:
                self.form.out.show_path(path)
            case Dropped.OTHER:
                self.context.messages.warn(
                    f"{path}: drop a scene, a bank, a rig, a folder, or the verify.json of an earlier verification"
                )

    def _lay_out(self) -> None:
        lower = side_by_side((self.waveforms, 515), (self.figures, 745))
        both = stacked((self.maps, 360), (lower, 260), growing=[0])
        self.divide(lower=lower, both=both)
        column = QVBoxLayout(self)
        column.setContentsMargins(4, 6, 4, 4)
        column.addWidget(self.form)
        column.addWidget(self.row)
        self.pages = QStackedWidget()
        self.hint = _hint()
        self.pages.addWidget(self.hint)
        self.pages.addWidget(both)
        column.addWidget(self.pages, stretch=1)

    def _start(self) -> None:
        try:
            request = self.form.request()
        except InputError as wrong:
            self.context.messages.warn(error_text(wrong))
            return
        self.form.out.show_path(request.out)
        self.context.claim_instruments(self, "Verify", lambda: self.run.start(request), virtual=request.is_virtual)

    def _folder_chosen(self, folder: Path) -> None:
        """An earlier verification of that folder is shown; one of another process is followed."""
        self.run.follow(folder)
        record = None if self.run.running else record_of(folder)
        if record is not None:
            self.open_record(record)

    def _choose_record(self) -> None:
        folder = self.form.out.path or self.context.settings.folder(".json")
        choose_file(self, "Open an earlier verification", folder, "Verifications", self.opens, self.open_record)

    def _reading_text(self) -> str:
        done, total = self._reading_share
        share = f": {done} of {total} fields" if total else "…"
        return f"reading {self._reading}{share}" if self._reading else ""

    def _show(self, results: Results) -> None:
        self._reading = ""
        self.results = results
        self.pages.setCurrentIndex(1)
        self.maps.show_results(results)
        self.waveforms.show_results(results)
        self.figures.show_results(results)
        self.show_position(self._first_position(results))

    def _fail(self, failure: Exception) -> None:
        self._reading = ""
        self.context.report_failure(failure)

    @staticmethod
    def _first_position(results: Results) -> int:
        """Where the first focus is looked at, so that something is seen at once; else none."""
        if not len(results.focus_sample):
            return -1
        place = next((source.at_mm(float(results.record.focus_s[0])) for source in results.record.sources), None)
        return -1 if place is None else results.surface.raster.nearest(float(place[0]), float(place[1]))

    def _go_to_time(self, time_s: float) -> None:
        if self.results is not None:
            self.maps.time.go_to(self.results.pair.sample_at(time_s))

    def _open_report(self) -> None:
        if self.results is not None:
            self._open(self.results.folder / REPORT_NAME)

    def _open_folder(self) -> None:
        if self.results is not None:
            self._open(self.results.folder)

    def _open(self, path: Path) -> None:
        if not path.exists():
            self.context.messages.fault(f"{path} is gone; run the verification again")
        elif not QDesktopServices.openUrl(QUrl.fromLocalFile(str(path))):
            self.context.messages.warn(f"this desktop opens nothing with {path.name}; it lies at {path}")

    def _copy(self) -> None:
        copy_text(self.figures.as_text())
        self.context.messages.note("the figures are on the clipboard")


def _hint() -> QLabel:
    """What to do while there is nothing to look at."""
    label = QLabel(_HINT)
    label.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignCenter)
    label.setWordWrap(True)
    label.setProperty("role", "faint")
    label.setMargin(40)
    return label
