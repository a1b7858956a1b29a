"""The editor of run, rig and scene files: completion, insertion, meaning, files that change outside."""

import pytest
from PyQt5.QtCore import Qt
from PyQt5.QtTest import QTest
from PyQt5.QtWidgets import QApplication

import wavefocus as wf
from tests.gui.conftest import answer, line_scene, shown_tab, wait, write_lab
from wavefocus.config.scene import PathTable, SignalTable, tables_by_kind
from wavefocus.gui.editor.document import TextDocument
from wavefocus.gui.editor.tab import FilesTab, insert_menu, source_on_path, source_with_signal
from wavefocus.gui.files import FileKind
from wavefocus.gui.scene.document import SceneDocument, scene_toml
from wavefocus.gui.scene.tab import SceneTab


@pytest.fixture
def tab(shared_window):
    """The Files tab, with empty texts."""
    shown = shown_tab(shared_window, FilesTab)
    for page in shown.pages.values():
        page.document.clear()
    shown.show_page(FileKind.RUN)
    shared_window.messages.dismiss()
    return shown


def test_given_letters_then_keys_are_completed_and_with_ctrl_f_the_text_is_searched(qtbot, tab):
    page = tab.pages[FileKind.RUN]
    text = page.editor.text
    text.setFocus()
    qtbot.keyClicks(text, "[gri")
    assert text.popup.isVisible()
    qtbot.keyClick(text.popup, Qt.Key.Key_Return)
    assert page.document.toml() == "[grid]"
    page.document.replace("[grid]\n")
    text.moveCursor(text.textCursor().MoveOperation.End)
    qtbot.keyClicks(text, "spac")
    qtbot.keyClick(text.popup, Qt.Key.Key_Return)
    assert page.document.toml() == "[grid]\nspacing_mm = "
    qtbot.keyClicks(text, "-1")
    wait(qtbot, lambda: [one.line for one in page.document.mistakes] == [1])
    assert "must be above 0" in page.editor.problem.text()
    page.document.replace("[grid]\nspacing_mm = 4.0\n")
    with qtbot.waitActive(tab.window()):
        tab.window().activateWindow()
    page.editor.text.setFocus()
    QTest.keyClick(page.editor.text, Qt.Key.Key_F, Qt.KeyboardModifier.ControlModifier)
    assert QApplication.focusWidget() is page.editor.search
    QTest.keyClicks(page.editor.search, "spac")
    QTest.keyClick(page.editor.search, Qt.Key.Key_Return)
    assert page.editor.text.textCursor().selectedText() == "spac"


def test_an_unsaved_run_then_its_grid_and_hours_are_shown_with_the_rig_that_it_names(qtbot, tab, tmp_path):
    run = write_lab(tmp_path / "lab", 4, 3)
    page = tab.pages[FileKind.RUN]
    page.files.open(run)
    wait(qtbot, lambda: "12 positions" in page.lines.text())
    assert page.surface.surface.positions == 12
    text = page.document.toml()
    page.document.replace(text.replace('rig = "rig.toml"', 'rig = "other.toml"'))
    wait(qtbot, lambda: "other.toml" in page.lines.text())
    page.document.replace(text)
    wait(qtbot, lambda: "12 positions" in page.lines.text())
    tab.show_page(FileKind.RIG)
    rig = tab.pages[FileKind.RIG]
    rig.files.open(run.with_name("rig.toml"))
    wait(qtbot, lambda: rig.table.rowCount() == 4)  # three actuators and the loopback
    assert rig.table.item(0, 2).text() == "0"


def test_a_file_that_another_program_writes_or_deletes_then_no_text_is_lost(tab, tmp_path):
    page, file = tab.pages[FileKind.RUN], tmp_path / "run.toml"
    file.write_text("[grid]\nspacing_mm = 4.0\n", encoding="utf-8")
    page.files.open(file)
    file.write_text("[grid]\nspacing_mm = 5.25\n", encoding="utf-8", newline="\r\n")
    page.files.look()
    assert page.document.toml() == "[grid]\nspacing_mm = 5.25\n"
    assert "read again" in tab.context.messages.sentence
    page.document.append("[sweep]\n")
    file.write_text("[grid]\nspacing_mm = 6.125\n", encoding="utf-8", newline="\r\n")
    page.files.look()
    assert "[sweep]" in page.document.toml()
    assert "changed on disk" in page.bar.name.text()
    page.files.save()
    assert "another program" in tab.context.messages.sentence
    answer(tab.window(), "Save over it")
    assert file.read_bytes().decode() == page.document.toml().replace("\n", "\r\n")
    assert "changed on disk" not in page.bar.name.text()
    file.unlink()
    for _ in range(2):
        page.files.look()
    assert page.bar.name.text() == "run.toml • (deleted on disk)"
    page.bar.actions_by_name["save"].trigger()
    assert file.read_text(encoding="utf-8") == page.document.toml()


def test_both_texts_unsaved_then_closing_asks_once_and_keeps_both_for_next_window(open_window, memory):
    window = open_window()
    tab = shown_tab(window, FilesTab)
    run, rig = (tab.pages[kind].document for kind in (FileKind.RUN, FileKind.RIG))
    run.append("[sweep]\n")
    rig.append('[mirror]\ndriver = "virt\u00a0ual"\n')  # neither mistakes nor no-break spaces are lost
    window.close()
    assert window.isVisible()
    assert window.messages.sentence.startswith("a new run and a new rig have unsaved changes")
    answer(window, "Close and keep for next time")
    assert not window.isVisible()
    again = shown_tab(open_window(), FilesTab)
    texts = [again.pages[kind].document.toml() for kind in (FileKind.RUN, FileKind.RIG)]
    assert texts == ["[sweep]\n", '[mirror]\ndriver = "virt\u00a0ual"\n']


def test_each_kind_of_path_signal_and_section_is_inserted_in_a_step_that_is_undone():
    kinds = [source_on_path(kind) for kind in tables_by_kind(PathTable)]
    for text in kinds + [source_with_signal(kind) for kind in tables_by_kind(SignalTable)]:
        document = SceneDocument()
        document.begin('[scene]\nname = "abc \\"XYZ\\" \\\\ é☺#{}"\n', None)
        document.append(text)
        assert [one.sentence for one in document.mistakes if '= ""' not in one.sentence] == []
        assert text.count("  # ") > 5
        named = text.replace('= ""', '= "a folder/file.wav"')
        document.begin(document.toml().replace(text, named), None)
        assert document.mistakes == []
        draft = document.draft
        document.begin(scene_toml(draft), None)
        assert document.draft == draft
        assert draft.scene.name == 'abc "XYZ" \\ é☺#{}'
    document = TextDocument("rig")
    menu = insert_menu(document)
    actions = menu.actions()
    assert {"[mirror]", "[player]", "[usb]", "[watch]"} <= {action.text() for action in actions}
    next(action for action in actions if action.text() == "[mirror]").trigger()
    assert document.toml().startswith("[mirror]\ndriver = ")
    document.text.undo()
    assert document.toml() == ""


def test_given_a_field_file_then_it_is_played_on_its_bank_until_it_is_closed(qtbot, open_window, finished, tmp_path):
    scene, file = tmp_path / "scene.toml", tmp_path / "field.h5"
    scene.write_text(scene_toml(line_scene()), encoding="utf-8")
    field = wf.predict(wf.render(scene, finished), finished, [1, 5, 6])
    wf.write_field(file, field)
    window = open_window(finished)
    window.open_file(file)
    tab = next(one for one in window.tabs if isinstance(one, SceneTab))
    view = tab.results.field
    wait(qtbot, lambda: view.file == file)
    assert view.isVisible()
    assert view.map.surface.positions == 3
    view.slider.go_to(40)
    shown = view.map.values / view.map.values.max() * field.field[:, 40].max()
    assert shown == pytest.approx(field.field[:, 40], rel=1e-5)
    view.close_file.click()
    assert view.file is None
