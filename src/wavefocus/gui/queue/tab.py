"""The Queue tab: the runs of a queue file in a table, ordered by drag and drop, with their finish times."""

from __future__ import annotations

import os
import signal
import socket
import time
from collections.abc import Callable, Mapping, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

from PyQt5.QtCore import QPoint, Qt, pyqtSignal
from PyQt5.QtGui import QDragEnterEvent, QDragMoveEvent, QDropEvent
from PyQt5.QtWidgets import QAbstractItemView, QAction, QFileDialog, QTableWidget

from wavefocus.acquisition.run_queue import (
    QUEUE_ENDING,
    EntryState,
    QueueEntry,
    changed_files,
    finish_times,
    move_entry,
    queue_holder,
    read_queue,
    remove_entries,
)
from wavefocus.acquisition.wording import hours
from wavefocus.campaign.control import command_line, expected_finish
from wavefocus.gui import widgets as ui
from wavefocus.gui.files import (
    FileKind,
    FileState,
    PathField,
    TomlKind,
    dropped_files,
    file_state,
    make_dialog,
    toml_kind,
)
from wavefocus.gui.message_bar import error_text
from wavefocus.gui.process import NOT_GOOD_ENOUGH, STOPPED_BY_USER, CommandProcess
from wavefocus.gui.tab import ClosingQuestion, Tab, TabContext
from wavefocus.gui.theme import Themed
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.owner import Owner

_HEADINGS = ("", "run", "command", "duration", "finish", "remark")
_MARKS = {
    EntryState.WAITING: "○ waiting",
    EntryState.RUNNING: "● running",
    EntryState.DONE: "✔ done",
    EntryState.FAILED: "✖ failed",
    EntryState.STOPPED: "– stopped",
}
_LOOKS_EVERY_S = 1.0


class RunTable(QTableWidget):
    """A table whose rows are ordered by dragging, and that takes files."""

    #: Row that was dragged, and the row before which it was dropped; as many as there are rows: at the end.
    dragged = pyqtSignal(int, int)
    #: Files that were dropped.
    received = pyqtSignal(list)

    def __init__(self) -> None:
        super().__init__(0, len(_HEADINGS))
        ui.dress_table(self, _HEADINGS, "Runs of the queue", stretched=(2, 5))
        self.setSelectionMode(QAbstractItemView.SelectionMode.ExtendedSelection)
        self.setDragDropMode(QAbstractItemView.DragDropMode.DragDrop)
        self.setDefaultDropAction(Qt.DropAction.MoveAction)
        self.setDragDropOverwriteMode(False)
        self.setDropIndicatorShown(True)

    def selected_rows(self) -> list[int]:
        """Rows that are selected, from the top."""
        model = self.selectionModel()
        return [] if model is None else sorted({index.row() for index in model.selectedRows()})

    def dragEnterEvent(self, event: QDragEnterEvent | None) -> None:  # noqa: N802
        if event is not None and (event.source() is self or dropped_files(event)):
            event.acceptProposedAction()

    def dragMoveEvent(self, event: QDragMoveEvent | None) -> None:  # noqa: N802
        if event is not None and event.source() is self:
            super().dragMoveEvent(event)  # draws where it would be dropped
        elif event is not None:
            event.acceptProposedAction()

    def dropEvent(self, event: QDropEvent | None) -> None:  # noqa: N802
        if event is None:
            return
        if event.source() is not self:
            event.acceptProposedAction()
            self.received.emit(dropped_files(event))
            return
        rows = self.selected_rows()
        event.setDropAction(Qt.DropAction.IgnoreAction)  # the file is the model: its rows are not moved here
        event.accept()
        if rows:
            self.dragged.emit(rows[0], self.row_before(event.pos()))

    def row_before(self, at: QPoint) -> int:
        """The row before which something is put that is dropped at a place; as many as there are rows: at the end."""
        index = self.indexAt(at)
        if not index.isValid():
            return self.rowCount()
        return index.row() + (at.y() > self.visualRect(index).center().y())


class QueueTab(Themed, Tab):
    """One queue file; it is carried out by a process of its own, which outlives the window."""

    title = "Queue"
    opens = (QUEUE_ENDING,)

    def __init__(self, context: TabContext) -> None:
        super().__init__(context)
        self.entries: tuple[QueueEntry, ...] = ()
        self._finish: dict[int, datetime | None] = {}
        self._changed: dict[int, tuple[str, ...]] = {}
        self._states: dict[int, tuple[Mapping[str, str], list[FileState | None]]] = {}
        self._holder: Owner | None = None
        self._process: CommandProcess | None = None
        self._looked_s = -_LOOKS_EVERY_S
        self._trouble = ""
        self.file = PathField("&Queue", QUEUE_ENDING, "queue file", context.settings, saves=True)
        self._actions = {
            name: ui.action(self, text, act, *keys, tip=tip)
            for name, text, act, keys, tip in (
                (
                    "run",
                    "Run the queue",
                    self.start,
                    "Ctrl+Shift+R",
                    "Carry out the runs that wait, one after the other",
                ),
                ("stop", "Stop the queue", self.stop, [], "Stop the run that is under way; it waits again"),
                ("campaign", "Add campaign", self.add_campaign, [], "Add the run file and bank of the Campaign tab"),
                ("files", "Add files…", self.choose_files, [], "Add run files, scenes to verify, banks to resume"),
                ("remove", "Remove", self.remove, [], "Remove the selected runs from the queue"),
            )
        }
        self.state = ui.Badge("State of the queue")
        self.summary = ui.label("Summary of the queue", any_width=True)
        self.table = RunTable()
        buttons = [ui.button(action) for action in self._actions.values()]
        ui.column(
            ui.row((self.file, 1)),
            ui.row(*buttons[:2], 10, *buttons[2:], None),
            ui.row(self.state, (self.summary, 1), spacing=10),
            (self.table, 1),
            owner=self,
            margins=ui.PAGE_MARGINS,
        )
        self.remember(queue=self.file)
        self.file.chosen.connect(self.open_file)
        self.table.dragged.connect(self.move_row)
        self.table.received.connect(self.add_files)
        self.draw()

    @property
    def running(self) -> bool:
        """Whether a process carries it out, this window's or another."""
        return self._holder is not None or (self._process is not None and self._process.running)

    def menu_actions(self) -> list[QAction | None]:
        actions: list[QAction | None] = list(self._actions.values())
        return [*actions[:2], None, *actions[2:]]

    def open_file(self, path: Path) -> None:
        self.file.show_path(path)
        self.context.settle("queue")
        self.entries, self._trouble = (), ""
        self._look()

    def instruments_held(self) -> str:
        return "The queue is carried out" if self._process is not None and self._process.running else ""

    def closing_question(self) -> ClosingQuestion | None:
        if self._process is None or not self._process.running or self.file.path is None:
            return None

        def stop(close: Callable[[], object]) -> None:
            self.stop()
            close()

        return ClosingQuestion(
            f"The queue {self.file.path.name} is carried out. Stop it when the window closes?",
            (("Continue in the background", lambda close: close()), ("Stop, mute and park", stop)),
        )

    def shut_down(self) -> None:
        if self._process is not None:
            self._process.detach()

    def poll(self) -> None:
        if time.monotonic() - self._looked_s >= _LOOKS_EVERY_S:
            self._look()

    def draw(self) -> None:
        waiting = sum(entry.to_do for entry in self.entries)
        selected = self.table.selected_rows()
        has_file = self.file.path is not None
        shared = self.context.shared
        possible = {
            "run": has_file and waiting > 0 and not self.running,
            "stop": self.running,
            "campaign": has_file and FileKind.RUN in shared and FileKind.BANK in shared,
            "files": has_file,
            "remove": bool(selected),
        }
        for name, enabled in possible.items():
            self._actions[name].setEnabled(enabled)
        word, colour = ("running", self.theme.good) if self.running else ("idle", self.theme.faint)
        self.state.show_word(word, colour)
        ui.put(self.summary, self._summary(waiting))

    def redraw(self) -> None:
        self._fill()

    def start(self) -> None:
        """Carry out the runs that wait."""
        queue = self.file.path
        if queue is not None and not self.running:
            self.context.claim_instruments(self, "Run", partial(self._start, queue), virtual=False)

    def stop(self) -> None:
        """Stop the run that is under way, and the queue; outputs are muted and the mirror is parked."""
        holder = self._holder
        if self._process is not None and self._process.running:
            self._process.interrupt()
        elif holder is not None and holder.host == socket.gethostname() and os.name == "posix":
            os.kill(holder.pid, signal.SIGINT)
        elif holder is not None:
            self.context.messages.warn(
                f"the queue is carried out by process {holder.pid} on {holder.host}: stop it there"
            )

    def add_campaign(self) -> None:
        """Add the run file and the bank of the other tabs."""
        shared = self.context.shared
        if FileKind.RUN not in shared or FileKind.BANK not in shared:
            self.context.report("queue", "open a run file and a bank in the Campaign tab first")
            return
        self._add(["capture", str(shared[FileKind.RUN]), "--bank", str(shared[FileKind.BANK])])

    def choose_files(self) -> None:
        """Add files that are chosen in a dialog."""
        dialog = make_dialog(self, "Add runs", self.context.settings.folder(".toml"), "Runs", [".toml", ".h5"])
        dialog.setFileMode(QFileDialog.FileMode.ExistingFiles)
        dialog.filesSelected.connect(lambda names: self.add_files([Path(name) for name in names]))
        dialog.show()

    def add_files(self, paths: Sequence[Path]) -> None:
        """Add a run for each file: a campaign for a run file, a verification for a scene, a resume for a bank."""
        for path in paths:
            words = self._words_for(path.absolute())
            if words:
                self._add(words)

    def remove(self) -> None:
        """Remove the selected runs."""
        numbers = [self.entries[row].number for row in self.table.selected_rows()]
        self._edit(lambda queue: remove_entries(queue, numbers))

    def move_row(self, row: int, target: int) -> None:
        """Move the entry of a row to the place before another row."""
        others = [entry for entry in self.entries[:target] if entry.number != self.entries[row].number]
        place = 1 + sum(entry.state is EntryState.WAITING for entry in others)
        self._edit(lambda queue: move_entry(queue, self.entries[row].number, place))

    def _words_for(self, path: Path) -> list[str]:
        shared = self.context.shared
        if path.suffix.lower() == ".h5":
            return ["resume", str(path)]
        kind = toml_kind(path) if path.suffix.lower() == ".toml" else None
        if kind is TomlKind.RUN:
            bank = shared[FileKind.BANK] if shared.get(FileKind.RUN) == path and FileKind.BANK in shared else None
            return ["capture", str(path), "--bank", str(bank or path.with_suffix(".h5"))]
        if kind is TomlKind.SCENE and FileKind.BANK in shared and FileKind.RIG in shared:
            bank, rig = shared[FileKind.BANK], shared[FileKind.RIG]
            out = bank.with_name(f"verify-{path.stem}")
            return ["verify", str(path), "--bank", str(bank), "--rig", str(rig), "--out", str(out)]
        needs = "; open a bank and a rig file first" if kind is TomlKind.SCENE else ": run files, scenes and banks can"
        self.context.report("queue", f"{path} cannot be added to the queue{needs}")
        return []

    def _add(self, words: Sequence[str]) -> None:
        queue = self.file.path
        if queue is None:
            self.context.report("queue", "name a queue file first")
            return

        def added(process: CommandProcess) -> None:
            if process.exit_code != 0:
                self.context.report("queue", process.failure)
            self._look()

        self.context.settle("queue")
        self.context.run(["queue", "add", str(queue), *words], added)

    def _start(self, queue: Path) -> None:
        self._process = self.context.run(
            ["queue", "run", str(queue)],
            self._ended,
            log_file=queue.with_name(f"{queue.name}.said"),
            name="the queue",
            advice="Run carries on with it",
        )

    def _ended(self, process: CommandProcess) -> None:
        self._process = None
        self._look()
        messages = self.context.messages
        if process.exit_code == 0:
            messages.note("Every run of the queue is done")
        elif process.exit_code == NOT_GOOD_ENOUGH:
            messages.fault("The queue is through; some runs did not end well")
        elif process.exit_code == STOPPED_BY_USER:
            messages.note("the queue was stopped; its run waits again")
        else:
            messages.fault(process.failure)

    def _edit(self, change: Callable[[Path], object]) -> None:
        queue = self.file.path
        if queue is None:
            return
        try:
            change(queue)
            self.context.settle("queue")
        except (InputError, OSError) as failure:
            self.context.report_failure(failure, "queue")
        self._look()

    def _look(self) -> None:
        """Read the file again."""
        self._looked_s = time.monotonic()
        queue = self.file.path
        entries: tuple[QueueEntry, ...] = ()
        trouble = ""
        was_running, self._holder = self.running, None
        if queue is not None and queue.exists():
            try:
                entries, self._holder = read_queue(queue), queue_holder(queue)
            except (InputError, OSError) as failure:
                trouble = error_text(failure)
        if trouble and trouble != self._trouble:
            self.context.report("queue", trouble)
        self._trouble = trouble
        finish = finish_times(entries, datetime.now(UTC), expected_finish)
        # Input files are read again only where one is not as it was at the last look.
        states = {
            entry.number: (entry.files, [file_state(Path(name)) for name in entry.files])
            for entry in entries if entry.to_do
        }  # fmt: skip
        changed = {
            entry.number: self._changed[entry.number]
            if self._states.get(entry.number) == states[entry.number]
            else changed_files(entry)
            for entry in entries if entry.to_do
        }  # fmt: skip
        self._states = states
        shown = (self.entries, self._finish, self._changed, was_running)
        if (entries, finish, changed, self.running) != shown:
            self.entries, self._finish, self._changed = entries, finish, changed
            self._fill()

    def _fill(self) -> None:
        theme = self.theme
        colours = {
            EntryState.DONE: theme.good, EntryState.FAILED: theme.fault, EntryState.RUNNING: theme.good,
            EntryState.STOPPED: theme.warning,
        }  # fmt: skip
        if self.table.rowCount() != len(self.entries):
            self.table.setRowCount(len(self.entries))
        for row, entry in enumerate(self.entries):
            mark = colours.get(entry.state, theme.faint)
            ui.fill_row(self.table, row, self._texts(entry), {0: mark, 5: theme.warning}, right=(1,))

    def _texts(self, entry: QueueEntry) -> tuple[str, ...]:
        duration = "" if entry.expected_s is None else hours(entry.expected_s)
        if entry.started_at is not None and entry.ended_at is not None:
            duration = hours((entry.ended_at - entry.started_at).total_seconds())
        finish = self._finish.get(entry.number)
        remark = f"exit code {entry.code}: {entry.said}" if entry.code else ""
        if changed := self._changed.get(entry.number):
            remark = f"changed since it was added: {', '.join(Path(name).name for name in changed)}"
        when = "" if finish is None else finish.strftime("%a %d %b %H:%M")
        cut_off = entry.state is EntryState.RUNNING and not self.running
        return (
            "◑ cut off" if cut_off else _MARKS[entry.state],
            str(entry.number),
            command_line(*entry.words),
            duration,
            when,
            remark,
        )

    def _summary(self, waiting: int) -> str:
        if self.file.path is None:
            return "Name a queue file, new or old; then add runs, or drop files on the table"
        if not self.entries:
            return "No runs: add the campaign of the Campaign tab, or drop run files, scenes and banks on the table"
        last = self._finish.get(self.entries[-1].number) if waiting else None
        ends = "" if last is None else f", finishes {last:%a %d %b %H:%M}"
        return f"{len(self.entries)} runs, {waiting} to do{ends}; drag rows to order them"
