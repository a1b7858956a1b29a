"""The editor of the Scene tab: paths drawn, shaped, undone and saved, and read by commands as they were drawn."""

import pytest
from PyQt5.QtCore import Qt
from PyQt5.QtGui import QTextDocument
from PyQt5.QtWidgets import QApplication, QFileDialog

from tests.gui.conftest import LEFT, NO_KEY, answer, click, drag, edit, line_scene, pixel, scene_of, shown_tab, wait
from wavefocus.config.scene import SceneConfig, SceneTable, TextTable
from wavefocus.gui.files import kind_of
from wavefocus.gui.scene.document import NEW_SCENE, NOTHING, changed, new_source
from wavefocus.gui.scene.tab import SceneTab
from wavefocus.rendering.scene import paths
from wavefocus.rendering.scene.model import load_scene
from wavefocus.storage.errors import InputError

SCENE = """
[scene]
name = "two"

[[source]]          # a comment of somebody's own
speed_mm_s = 80.0
step_mm = 4.0
path = { kind = "circle", radius_mm = 30, turns = 0.75 }
signal = { kind = "impulse" }
emission = "per_point"

[[source]]
path = { kind = "point", at_mm = [10, 20] }
signal = { kind = "sine", frequency_hz = 200, duration_s = 0.1 }
"""


@pytest.fixture
def tab(qtbot, shared_window):
    """The Scene tab of the window, shown and empty."""
    shown = shown_tab(shared_window, SceneTab)
    shown.document.clear()
    shown.document.use_bank(None)
    shown.surface.use_tool("")
    shown.surface.canvas.setFocus()
    shared_window.messages.dismiss()
    wait(qtbot, lambda: shown.surface.canvas.isVisible() and shown.live.backdrop.surface is None and shown.live.idle)
    shown.surface.canvas.box.autoRange()
    for _ in range(3):  # the axes make room for their numbers when they are painted
        shown.surface.canvas.grab()
        QApplication.processEvents()
    return shown


def draw(qtbot, tab, kind):
    canvas = tab.surface.canvas
    qtbot.mouseClick(tab.surface.tools[kind], LEFT)
    if kind in ("point", "quiet"):
        click(canvas, pixel(canvas, -20, 10))
    else:
        drag(qtbot, canvas, [pixel(canvas, 5, 5), pixel(canvas, 35, 5)], NO_KEY)
    wait(qtbot, lambda: tab.live.idle)
    return tab.document.draft.source[-1].path


def test_each_tool_adds_its_table_to_the_text_and_the_cursor_chooses_a_source(qtbot, tab):
    canvas, document, text = tab.surface.canvas, tab.document, tab.editor.text
    line = draw(qtbot, tab, "line")
    assert line.start_mm == pytest.approx((5, 5), abs=1.5)
    assert line.end_mm == pytest.approx((35, 5), abs=1.5)
    circle = draw(qtbot, tab, "circle")
    assert circle.radius_mm == pytest.approx(30, abs=1.5)
    point = draw(qtbot, tab, "point")
    assert point.at_mm == pytest.approx((-20, 10), abs=1.5)
    draw(qtbot, tab, "quiet")
    assert document.draft.quiet[0].at_mm == pytest.approx((-20, 10), abs=1.5)
    assert canvas.kind == ""
    assert len(tab.live.traces) == 3
    assert tab.surface.problem == ""
    assert scene_of(tab.document).sources[2].path == paths.Point(point.at_mm)
    tab.bar.actions_by_name["undo"].trigger()
    wait(qtbot, lambda: document.draft.quiet == ())
    click(canvas, pixel(canvas, 20, 5))  # the line
    assert document.chosen == ("source", 0)
    assert text.textCursor().block().text() == "[[source]]"
    text.find("radius_mm")
    assert document.chosen == ("source", 1)
    text.find("[output]", QTextDocument.FindFlag.FindBackward)
    assert document.chosen == NOTHING


COMMENTED = """[[source]]
amplitude = 0.01
signal = { kind = "impulse" }
speed_mm_s = 80.0
step_mm = 4.0
[source.path]   # drawn by hand
kind = "line"
start_mm = [5.0, 5.0]  # keep me
end_mm = [35.0, 5.0]
[[quiet]]
at_mm = [ -20.0, # x
  10.0 ]
"""


def test_dragged_points_change_only_their_numbers_in_the_text_and_are_undone(qtbot, tab):
    canvas, document = tab.surface.canvas, tab.document
    document.begin(COMMENTED, None)
    wait(qtbot, lambda: tab.live.idle)
    click(canvas, pixel(canvas, 20, 5))
    drag(qtbot, canvas, [pixel(canvas, 35, 5), pixel(canvas, 30, 40)], NO_KEY)
    x_mm, y_mm = document.draft.source[0].path.end_mm
    assert (x_mm, y_mm) == pytest.approx((30, 40), abs=1.5)
    assert document.toml() == COMMENTED.replace("35.0, 5.0", f"{x_mm}, {y_mm}")
    wait(qtbot, lambda: tab.live.idle)
    click(canvas, pixel(canvas, -20, 10))
    assert document.chosen == ("quiet", 0)
    assert tab.editor.text.textCursor().block().text() == "[[quiet]]"
    drag(qtbot, canvas, [pixel(canvas, -20, 10), pixel(canvas, -40, 20)], NO_KEY)
    assert document.draft.quiet[0].at_mm == pytest.approx((-40, 20), abs=1.5)
    assert "# x\n" in document.toml()
    for _ in range(2):
        tab.bar.actions_by_name["undo"].trigger()
    assert document.toml() == COMMENTED


def test_the_scene_follows_typing_and_mistakes_are_told_beside_the_last_scene(qtbot, tab):
    document, text = tab.document, tab.editor.text
    draw(qtbot, tab, "line")
    text.find("speed_mm_s = 80.0", QTextDocument.FindFlag.FindBackward)
    qtbot.keyClicks(text, "speed_mm_s = 37.5")
    wait(qtbot, lambda: document.draft.source[0].speed_mm_s == 37.5)
    qtbot.keyClicks(text, "x")
    wait(qtbot, lambda: "not TOML" in tab.surface.problem)
    assert document.draft.source[0].speed_mm_s == 37.5
    qtbot.keyClick(text, Qt.Key.Key_Backspace)
    wait(qtbot, lambda: tab.surface.problem == "")


def test_a_scene_file_then_it_is_opened_saved_and_opened_again_as_the_same_scene(qtbot, tab, tmp_path):
    file = tmp_path / "two.toml"
    file.write_text(SCENE, encoding="utf-8")
    assert kind_of(file) in tab.kinds
    tab.open_file(file)
    document = tab.document
    assert (document.path, document.saved, len(document.draft.source)) == (file, True, 2)
    assert scene_of(document) == load_scene(file)
    cursor = document.text.find("80.0")
    cursor.insertText("81.0")
    assert not document.saved
    tab.bar.actions_by_name["save"].trigger()
    assert document.saved
    assert file.read_text(encoding="utf-8") == SCENE.replace("80.0", "81.0")  # comments, too
    wait(qtbot, lambda: document.draft.source[0].speed_mm_s == 81.0)
    assert load_scene(file) == scene_of(document)
    before = document.draft
    tab.files.new()
    assert document.draft == NEW_SCENE
    tab.open_file(file)
    assert document.draft == before


def test_given_unsaved_changes_then_closing_asks_and_saving_closes(open_window, memory, tmp_path):
    memory.keep("folder/.toml", str(tmp_path))
    window, file = open_window(), tmp_path / "drawn.toml"
    tab = shown_tab(window, SceneTab)
    edit(tab.document, line_scene())
    window.close()
    assert window.isVisible()
    assert "has unsaved changes" in window.messages.sentence
    answer(window, "Save and close")
    dialog = tab.findChild(QFileDialog)
    assert not dialog.isModal()
    dialog.fileSelected.emit(str(file))
    dialog.close()
    assert not window.isVisible()
    assert len(load_scene(file).sources) == 1


def test_a_window_gone_with_unsaved_changes_then_the_next_one_has_them(qtbot, open_window, memory, tmp_path):
    file = tmp_path / "two.toml"
    file.write_text(SCENE, encoding="utf-8")
    gone = shown_tab(open_window(file), SceneTab)
    edit(gone.document, changed(gone.document.draft, scene=SceneTable(name="three")))
    wait(qtbot, lambda: 'name = "three"' in memory.text("scene/unsaved"))
    other = shown_tab(open_window(), SceneTab)
    assert other.document.draft == gone.document.draft
    assert (other.document.path, other.document.saved) == (file, False)
    assert "two.toml" in other.context.messages.sentence
    file.write_text(SCENE + "# of another program, before the next window\n", encoding="utf-8")
    third = shown_tab(open_window(), SceneTab)
    third.bar.actions_by_name["save"].trigger()
    assert "another program" in third.context.messages.sentence
    assert "# of another program" in file.read_text(encoding="utf-8")
    answer(third.window(), "Save over it")
    assert load_scene(file).name == "three"
    assert memory.text("scene/unsaved") == ""


WRONG = {
    "[[source]\n": "not TOML",
    "[scene]\nname = 3\n[[source]]\n": "scene.name = 3: must be text in quotes",
    SCENE.replace("radius_mm", "radius"): "did you mean radius_mm?",
    SCENE.replace('"impulse"', '"noise", band_hz = [300.0, 20.0], duration_s = 0.1'): "with lower below upper",
    SCENE.replace('"two"', '"a\udcff"'): "scene.name",
    "[output]\nlimit_v = -0.5\n": "output.limit_v = -0.5",
}


def test_given_wrong_scenes_then_their_mistakes_are_shown_and_none_is_saved(qtbot, tab, tmp_path):
    document, file, wrong = tab.document, tmp_path / "wrong.toml", tmp_path / "scene.toml"
    with pytest.raises(InputError, match="has no source yet"):
        scene_of(document)
    for text, sentence in WRONG.items():
        document.clear()
        document.replace(text)
        assert any(sentence in mistake.sentence for mistake in document.mistakes), text
        assert f"line {document.mistakes[0].line + 1}" in tab.editor.problem.text()
        assert document.mistakes[0].sentence == tab.surface.problem
        assert document.draft == NEW_SCENE
        with pytest.raises(InputError, match="not saved"):
            document.save(file)
    for text in ("", "[output]\nlimit_v = 0.5\n"):  # not finished, but not wrong
        document.begin(text, None)
        assert (document.mistakes, document.draft.source) == ([], ())
        with pytest.raises(InputError, match="not saved: the scene has no source yet"):
            document.save(file)
    assert document.draft.output.limit_v == 0.5
    assert list(tmp_path.iterdir()) == []
    wrong.write_text("[[source]\n", encoding="utf-8")
    tab.open_file(wrong)
    assert document.toml() == "[[source]\n"
    edit(document, SceneConfig(source=(new_source(TextTable(string="\U00013000", height_mm=20.0)),)), chosen=0)
    wait(qtbot, lambda: "DejaVu Sans cannot draw" in tab.surface.problem)


FAR = '[[source]]\npath = { kind = "point", at_mm = [1e300, 1e300] }\nsignal = { kind = "impulse" }\n'
LATE = """[[source]]
speed_mm_s = 1e-300
step_mm = 1e10
path = { kind = "circle", radius_mm = 1e12 }
signal = { kind = "sine", frequency_hz = 1e300, duration_s = 0.1 }
"""
DENSE = """[[source]]
speed_mm_s = 1.0
step_mm = 1e-12
path = { kind = "line", start_mm = [0, 0], end_mm = [1e308, -1e308] }
signal = { kind = "noise", band_hz = [0, 1], duration_s = 1e7 }
"""


def test_numbers_beyond_all_measure_then_sentences_say_so_and_nothing_else_happens(qtbot, tab, finished):
    tab.document.use_bank(finished)
    tab.document.replace(FAR + DENSE)
    wait(qtbot, lambda: "at most 1000000 are allowed" in tab.surface.problem)
    tab.document.replace(FAR)
    wait(qtbot, lambda: "source 0" in tab.results.problem.text() and tab.surface.problem == "")
    (trace,) = tab.live.traces
    tab.document.replace(FAR + LATE)
    wait(qtbot, lambda: tab.surface.problem.startswith("source 1: its last focus is later than numbers reach"))
    assert tab.live.traces == [trace]  # what was drawn last stays
