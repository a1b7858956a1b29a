"""The Queue tab: a table of runs that is ordered by dragging, filled by dropping files, and carried out."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from PyQt5.QtCore import QMimeData, QPoint, QPointF, Qt, QUrl
from PyQt5.QtGui import QDropEvent
from pytestqt.qtbot import QtBot

from tests.gui.conftest import LEFT, NO_KEY, Opens, press, shown_tab, wait
from wavefocus.acquisition.run_queue import EntryState, add_entry, read_queue
from wavefocus.gui import widgets as ui
from wavefocus.gui.queue.tab import QueueTab
from wavefocus.storage.claims import claimed


@pytest.fixture
def queue(measured: Path, tmp_path: Path) -> Path:
    """A queue of three runs: one that fails, and two checks; in a lab."""
    shutil.copytree(measured, tmp_path / "lab")
    queue = tmp_path / "lab" / "night.queue.json"
    for words in (["resume", "none.h5"], ["check", "plate.h5"], ["check", "plate.raw.h5"]):
        add_entry(queue, words, queue.parent, expected_s=60.0)
    return queue


def opened(open_window: Opens, *files: Path) -> QueueTab:
    return shown_tab(open_window(*files), QueueTab)


def numbers(queue: Path) -> list[int]:
    return [entry.number for entry in read_queue(queue)]


def test_given_a_row_is_moved_then_the_file_has_the_new_order(qtbot: QtBot, open_window: Opens, queue: Path) -> None:
    tab = opened(open_window, queue)
    table = tab.table
    wait(qtbot, lambda: table.rowCount() == 3)
    first, last = (table.visualRect(table.model().index(row, 2)) for row in (0, 2))
    tab.move_row(0, table.row_before(last.bottomLeft() + QPoint(20, 60)))
    assert numbers(queue) == [2, 3, 1]
    tab.move_row(1, table.row_before(first.topLeft() + QPoint(20, 2)))
    assert numbers(queue) == [3, 2, 1]
    tab.move_row(0, table.row_before(first.bottomLeft() + QPoint(20, -2)))
    assert numbers(queue) == [3, 2, 1]
    assert all(table.item(row, 4).text() for row in range(3))
    assert [table.item(row, 1).text() for row in range(3)] == ["3", "2", "1"]


def test_given_files_are_dropped_then_runs_are_added_and_others_are_refused(
    qtbot: QtBot, open_window: Opens, queue: Path
) -> None:
    lab = queue.parent
    tab = opened(open_window, lab / "run.toml", queue)
    content = QMimeData()
    content.setUrls([QUrl.fromLocalFile(str(lab / name)) for name in ("run.toml", "plate.h5", "positions.csv")])
    drop = QDropEvent(QPointF(5, 5), Qt.DropActions(Qt.DropAction.CopyAction), content, Qt.MouseButtons(LEFT), NO_KEY)
    tab.table.dropEvent(drop)
    wait(qtbot, lambda: len(read_queue(queue)) == 5, 20_000)
    added = {entry.words[:2] for entry in read_queue(queue)[3:]}
    assert added == {("capture", str(lab / "run.toml")), ("resume", str(lab / "plate.h5"))}
    assert "positions.csv" in tab.context.troubles["queue"]
    tab.context.settle("queue")


def test_given_the_queue_is_run_then_it_is_carried_out_and_shown(qtbot: QtBot, open_window: Opens, queue: Path) -> None:
    tab = opened(open_window, queue)
    run = next(button for button in tab.findChildren(ui.QToolButton) if button.text() == "Run the queue")
    press(qtbot, run)
    wait(qtbot, lambda: not any(entry.to_do for entry in read_queue(queue)) and not tab.running)
    states = [entry.state for entry in read_queue(queue)]
    assert states == [EntryState.FAILED, EntryState.DONE, EntryState.DONE]
    wait(qtbot, lambda: "none.h5" in tab.table.item(0, 5).text())
    assert not run.isEnabled()
    tab.context.messages.dismiss_old()


def test_given_another_process_carries_it_out_then_it_cannot_be_run_twice(
    qtbot: QtBot, open_window: Opens, queue: Path
) -> None:
    with claimed(f"queue {queue.resolve()}"):
        tab = opened(open_window, queue)
        wait(qtbot, lambda: tab.running)
        tab.draw()
        assert not tab.menu_actions()[0].isEnabled()
