"""The Verification tab: the choices of a verification, its progress, and what it found."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path

from PyQt5.QtCore import Qt
from PyQt5.QtGui import QDragEnterEvent, QDropEvent, QShowEvent
from PyQt5.QtWidgets import QAction, QComboBox, QGridLayout, QLabel, QLineEdit, QStackedWidget, QWidget

from wavefocus.gui import widgets as ui
from wavefocus.gui.files import FileKind, PathField, choose_file, dropped_files, names_virtual_rig
from wavefocus.gui.message_bar import error_text
from wavefocus.gui.process import Background
from wavefocus.gui.tab import ClosingQuestion, Drawing, Tab, TabContext
from wavefocus.gui.theme import Themed
from wavefocus.gui.verification.panels import FiguresPanel, MapsPanel, WaveformPanel
from wavefocus.gui.verification.run import (
    Dropped,
    Results,
    VerificationProgress,
    VerificationRequest,
    VerificationRun,
    dropped_kind,
    read_results,
    record_of,
)
from wavefocus.rendering.verify.record import FIELD_NAMES, PICTURE_NAMES, RECORD_NAME, REPORT_NAME
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replacement

_CHOICES = (
    ("all", "all positions", "Every position of the bank"),
    ("every", "one position in", "For a quick look: one position of so many, in the bank's order"),
    ("path", "along the path", "What the scene is rendered from, and all within 15 mm of its paths"),
    ("selected", "selected on the map", "The positions that are selected in the Campaign tab, of this bank"),
    ("rows", "these rows", "Bank rows from 0: single or as ranges, 3,5-9"),
)
_FOLDER = "verify"


class RequestForm(QWidget):
    """Two rows of fields; `choice` holds the positions to scan."""

    def __init__(self, context: TabContext) -> None:
        super().__init__()
        self._context = context
        settings = context.settings
        self.scene = PathField("&Scene", ".toml", "scene file", settings)
        self.bank = PathField("&Bank", ".h5", "bank to verify", settings)
        self.rig = PathField("Ri&g", ".toml", "rig file", settings)
        self.out = PathField("F&older", "", "folder for the report", settings)
        tip = "Play on the virtual rig that comes with wavefocus, without a rig file"
        self.virtual = ui.check("virtual", tip, "Virtual rig")
        tip = "Verify the scene as it is drawn in the Scene tab now, saved or not"
        self.drawn = ui.check("as drawn", tip, "Scene as drawn")
        self._drawing_left = ""
        self._filled: dict[PathField, Path] = {}
        """What was filled in by itself, and follows the bank."""
        self.positions = QComboBox()
        self.positions.setAccessibleName("Positions to scan")
        for key, words, _ in _CHOICES:
            self.positions.addItem(words, key)
        self.step = ui.whole_box("One position in so many", "One position in so many, in the bank's order", 2, 1000)
        self.step.setValue(4)
        self.rows = ui.named(QLineEdit(), "Bank rows from 0: single or as ranges, 3,5-9", "Bank rows to scan")
        self.rows.setPlaceholderText("0-99,120")
        tip = "Allow scenes of over an hour, 8 GiB of drives or a million path points (--allow-large)"
        self.large = ui.check("large", tip, "Allow large scenes")
        self.choice = QWidget()
        ui.row(*ui.labelled("&Positions", self.positions), self.step, self.rows, self.large, owner=self.choice)
        rig = ui.row((self.rig, 1), self.virtual)
        grid = QGridLayout(self)
        grid.setContentsMargins(0, 0, 0, 0)
        grid.addLayout(ui.row((self.scene, 1), self.drawn), 0, 0)
        grid.addWidget(self.bank, 0, 1)
        grid.addLayout(rig, 1, 0)
        grid.addWidget(self.out, 1, 1)
        for place, fields in enumerate(((self.scene, self.rig), (self.bank, self.out))):
            grid.setColumnStretch(place, 1)
            labels = [label for field in fields if (label := field.findChild(QLabel)) is not None]
            for label in labels:
                label.setMinimumWidth(max(one.sizeHint().width() for one in labels))
        files: dict[str, QWidget] = {"scene": self.scene, "bank": self.bank, "rig": self.rig, "out": self.out}
        which = {"virtual": self.virtual, "positions": self.positions, "step": self.step, "rows": self.rows}
        self.choices = files | which
        self.bank.chosen.connect(self.take_bank)
        for field in (self.scene, self.rig):
            field.chosen.connect(settings.opened)
        self.rig.chosen.connect(lambda path: context.share(self, FileKind.RIG, path))
        self.scene.chosen.connect(lambda _path: self._leave_drawing())
        self.drawn.toggled.connect(self.scene.setDisabled)
        self.drawn.clicked.connect(lambda on: None if on else self._leave_drawing())
        self.virtual.toggled.connect(self.rig.setDisabled)
        self.positions.currentIndexChanged.connect(self._show_choice)
        self._show_choice()

    def take_bank(self, bank: Path) -> None:
        """Verify a bank; empty fields are filled with the files next to it."""
        self.bank.show_path(bank)
        self._context.settings.opened(bank)
        self._context.share(self, FileKind.BANK, bank)
        for field, name in ((self.scene, "scene.toml"), (self.rig, "rig.toml"), (self.out, _FOLDER)):
            neighbour = bank.with_name(name)
            if field.path in (None, self._filled.get(field)) and (field is self.out or neighbour.is_file()):
                field.show_path(neighbour)
                self._filled[field] = neighbour

    def use_rig(self, rig: Path) -> None:
        """Play on a rig that was chosen in another tab."""
        self.virtual.setChecked(False)
        self.rig.show_path(rig)

    def missing(self) -> str:
        """What has to be chosen first; empty when a verification can be started."""
        rigs = [] if self.virtual.isChecked() else [(self.rig, "a rig file, or the virtual rig")]
        scenes = [] if self.drawn.isChecked() else [(self.scene, "a scene file")]
        fields = [*scenes, (self.bank, "a bank"), *rigs, (self.out, "a folder")]
        words = [word for field, word in fields if field.path is None]
        return "" if not words else f"choose {', and '.join(words)}"

    def request(self) -> VerificationRequest:
        """The command of the present choices; results in the folder are kept, and a numbered folder is used instead.

        Raises InputError: A choice is missing, or the positions are wrong.
        """
        if missing := self.missing():
            raise InputError(f"{missing} first")
        drawing = self._context.drawing() if self.drawn.isChecked() else None
        if self.drawn.isChecked() and drawing is None:
            raise InputError("the Scene tab has no scene: draw one there, or choose a scene file")
        bank, out = self.bank.path, self.out.path
        assert bank is not None
        assert out is not None
        earlier, out = out / RECORD_NAME, unused_folder(out)
        scene = self.scene.path if drawing is None else drawing.path or _written(drawing, out)
        rig = "virtual" if self.virtual.isChecked() else str(self.rig.path)
        arguments = ["verify", str(scene), "--bank", str(bank), "--rig", rig, "--out", str(out), "--json"]
        if self.large.isChecked() or (drawing is not None and drawing.allow_large):
            arguments.append("--allow-large")
        if out != earlier.parent and earlier.is_file():
            arguments += ["--against", str(earlier)]
        if positions := self._positions(bank):
            arguments += ["--positions", positions]
        return VerificationRequest(tuple(arguments), out, names_virtual_rig(rig))

    def take_drawing(self) -> None:
        """Verify the scene that is drawn in the Scene tab, unless a file was chosen since it was changed."""
        drawing = self._context.drawing()
        self.drawn.setEnabled(drawing is not None)
        if drawing is None:
            self.drawn.setChecked(False)
        elif drawing.toml != self._drawing_left:
            self.drawn.setChecked(True)

    def _leave_drawing(self) -> None:
        """Verify the scene file; the drawing is offered again when it has changed."""
        drawing = self._context.drawing()
        self._drawing_left = "" if drawing is None else drawing.toml
        self.drawn.setChecked(False)

    def _positions(self, bank: Path) -> str:
        match self.positions.currentData():
            case "every":
                return f"every:{self.step.whole()}"
            case "path":
                return "path"
            case "selected":
                return self._selected(bank)
            case "rows":
                text = self.rows.text().strip()
                if not text:
                    raise InputError("name the bank rows to scan, as 3,5-9, or choose other positions")
                return text
        return ""

    def _selected(self, bank: Path) -> str:
        selection = self._context.selection
        if not selection.rows or selection.bank is None:
            raise InputError("nothing is selected on the campaign's map; Ctrl-click or Shift-drag there selects")
        if selection.bank.absolute() != bank.absolute():
            raise InputError(
                f"the campaign's map shows {selection.bank}, and {bank} is to be verified; open that bank in the "
                "Campaign tab and select there"
            )
        return ",".join(str(row) for row in sorted(selection.rows))

    def _show_choice(self) -> None:
        key = self.positions.currentData()
        self.positions.setToolTip(next(tip for one, _, tip in _CHOICES if one == key))
        self.step.setVisible(key == "every")
        self.rows.setVisible(key == "rows")


def _written(drawing: Drawing, out: Path) -> Path:
    """Write a drawing that has no file of its own next to the results, ``NAME-scene.toml``; other files stay.

    Raises InputError: It cannot be written.
    """
    content = drawing.toml.encode()
    names = (out.with_name(f"{out.name}-scene{count or ''}.toml") for count in itertools.count())
    path = next(one for one in names if not os.path.lexists(one) or (one.is_file() and one.read_bytes() == content))
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        with replacement(path) as temporary:
            temporary.write_bytes(content)
    except OSError as failure:
        raise InputError(f"{path} cannot be written: {error_text(failure)}") from None
    return path


def unused_folder(folder: Path) -> Path:
    """Return the folder, or the first of ``NAME-2``, ``NAME-3``, ... where it holds results of a verification."""
    if not _holds_results(folder):
        return folder
    stem, _, number = folder.name.rpartition("-")
    first = folder.with_name(stem) if stem and number.isdecimal() else folder
    if first != folder and not first.is_dir():
        first = folder
    numbered = (first.with_name(f"{first.name}-{count}") for count in itertools.count(2))
    return next(one for one in numbered if not _holds_results(one))


def _holds_results(folder: Path) -> bool:
    names = (RECORD_NAME, REPORT_NAME, *FIELD_NAMES, *PICTURE_NAMES)
    return any(os.path.lexists(folder / name) for name in names) or (os.path.lexists(folder) and not folder.is_dir())


# Steps as the log names them, and as they are shown.
_STEPS = {
    "render": "rendering",
    "predict": "predicting",
    "sentinel": "measuring the sentinel position",
    "scan": "scanning",
    "linearity": "scanning, quieter",
    "compare and report": "comparing",
}


class RunRow(Themed, QWidget):
    """One line: positions to scan (`choice`), buttons, step, progress, remaining time and last message."""

    def __init__(
        self,
        choice: QWidget,
        start: Callable[[], object],
        cancel: Callable[[], object],
        open_earlier: Callable[[], object],
    ) -> None:
        super().__init__()
        tip = "Play the scene on the rig, scan it and compare"
        self.start = ui.action(self, "Verify", start, "Ctrl+Shift+V", tip=tip)
        tip = "Stop: outputs muted, mirror parked; Verify then goes on with the scan"
        self.cancel = ui.action(self, "Cancel", cancel, "Ctrl+Shift+X", tip=tip)
        tip = "Show an earlier verification: choose its verify.json"
        self.open_earlier = ui.action(self, "Open earlier…", open_earlier, "Ctrl+Shift+O", tip=tip)
        self._start_tip = self.start.toolTip()
        self.state = ui.Badge("State of the verification")
        self.bar = ui.progress_bar("Progress of the verification", "%v of %m positions")
        self.bar.setMinimumWidth(120)
        self.figures = ui.label("Remaining time and last message", any_width=True)
        buttons = map(ui.button, (self.start, self.cancel, self.open_earlier))
        ui.row(choice, 8, *buttons, 8, self.state, (self.bar, 2), (self.figures, 3), owner=self)
        self.show_progress(None, stopping=False, missing="")

    def show_progress(
        self, progress: VerificationProgress | None, *, stopping: bool, missing: str, reading: str = ""
    ) -> None:
        """Show the progress, or without one what is `missing` for a verification and what is being read."""
        running = progress is not None
        self.start.setEnabled(not running and not missing)
        self.start.setToolTip(f"First {missing}" if missing else self._start_tip)
        self.cancel.setEnabled(running and not stopping)
        self.open_earlier.setEnabled(not running)
        self.state.setVisible(running)
        self.bar.setVisible(running)
        if progress is None:
            ui.put(self.figures, reading)
            self.figures.setToolTip("")
            return
        word = "stopping" if stopping else _STEPS.get(progress.step, progress.step)
        self.state.show_word(word, self.theme.warning if stopping else self.theme.good)
        self.bar.setFormat("%v of %m positions" if progress.step in ("scan", "predict", "linearity") else "")
        if (self.bar.value(), self.bar.maximum()) != (progress.done, progress.total):
            self.bar.setMaximum(progress.total)  # 0: a busy indicator
            self.bar.setValue(progress.done)
        scanning = progress.step == "scan" and progress.done < progress.total
        left = ui.finish_text(progress.finish_s) if scanning and progress.finish_s is not None else ""
        text = "  ·  ".join(part for part in (left, progress.message) if part)
        ui.put(self.figures, text)
        self.figures.setToolTip(text)


_HINT = (
    "Choose a scene (or draw one in the Scene tab), a bank, a rig and a folder, and press Verify: the scene is played "
    "and scanned, and compared with what the bank predicts.\n\nOr open the verify.json of an earlier verification, or "
    "drop it here."
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
        opens = {"report": partial(self._open, REPORT_NAME), "folder": partial(self._open, "")}
        self.figures = FiguresPanel({**opens, "copy": self._copy})
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

    def use_shared(self, kind: FileKind, path: Path) -> None:
        if self.run.running:
            return
        if kind is FileKind.BANK:
            self.form.take_bank(path)
        elif kind is FileKind.RIG:
            self.form.use_rig(path)

    def showEvent(self, event: QShowEvent | None) -> None:  # noqa: N802
        super().showEvent(event)
        self.form.take_drawing()

    def draw(self) -> None:
        self.hint.setText(_WAITING if self.run.running else _HINT)
        self.row.show_progress(
            self.run.progress, stopping=self.run.stopping, missing=self.form.missing(), reading=self._reading_text()
        )

    def closing_question(self) -> ClosingQuestion | None:
        return self.run.closing_question()

    def instruments_held(self) -> str:
        busy = self.run.running and not self.run.is_virtual
        return f"a verification into {self.run.out} plays and scans" if busy else ""

    def shut_down(self) -> None:
        self._readings += 1
        self.background.end()
        self.run.detach()

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
        lower = ui.side_by_side((self.waveforms, 515), (self.figures, 745))
        both = ui.stacked((self.maps, 360), (lower, 260), growing=[0])
        self.remember(lower=lower, both=both, **self.form.choices)
        self.pages = QStackedWidget()
        self.hint = ui.label(text=_HINT, role="faint", wraps=True)
        self.hint.setAlignment(Qt.Alignment() | Qt.AlignmentFlag.AlignCenter)
        self.hint.setMargin(40)
        self.pages.addWidget(self.hint)
        self.pages.addWidget(both)
        ui.column(self.form, self.row, (self.pages, 1), owner=self, margins=ui.PAGE_MARGINS)

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

    def _open(self, name: str) -> None:
        """Open a file of the folder, or the folder itself where the name is empty."""
        if self.results is not None:
            path = self.results.folder / name
            if path.exists():
                self.context.open_outside(path)
            else:
                self.context.messages.fault(f"{path} is gone; run the verification again")

    def _copy(self) -> None:
        ui.copy_text(self.figures.as_text())
        self.context.messages.note("the figures are on the clipboard")
