"""The editor of the Scene tab: paths drawn, shaped, undone and saved, and read by commands as they were drawn."""

from __future__ import annotations

import math
from collections.abc import Generator
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QApplication, QFileDialog
from pytestqt.qtbot import QtBot

from tests.gui.conftest import LEFT, NO_KEY, Opens, choose, click, double_click, drag, pixel, shown_tab, wait
from wavefocus.config.scene import (
    CircleTable,
    FileTable,
    ImpulseTable,
    LineTable,
    NoiseTable,
    Output,
    PathTable,
    PointTable,
    PolylineTable,
    Regularisation,
    SceneConfig,
    SceneTable,
    SineTable,
    SourceTable,
    SvgTable,
    TextTable,
    TrajectoryTable,
)
from wavefocus.gui.files import Settings
from wavefocus.gui.scene.canvas import SceneCanvas
from wavefocus.gui.scene.document import SceneDocument
from wavefocus.gui.scene.draft import NEW_PATHS, NEW_SCENE, changed, new_source, read_draft, scene_toml, with_source
from wavefocus.gui.scene.tab import SceneTab
from wavefocus.gui.scene.tools import handles_of, shifted, with_handle_at
from wavefocus.gui.window import Window
from wavefocus.rendering.scene import paths
from wavefocus.rendering.scene.model import build_scene, load_scene
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

DRAWING = """<svg xmlns="http://www.w3.org/2000/svg"><path id="first" d="M 0 0 L 20 0 L 20 10"/>
<path id="second" d="M 0 0 L 400 300"/></svg>"""
FINGER = "time_s,x_mm,y_mm\n0,-10,0\n0.5,10,0\n"


@pytest.fixture
def tab(qtbot: QtBot, shared_window: Window) -> Generator[SceneTab]:
    """The Scene tab of the window, shown and empty."""
    shown = shown_tab(shared_window, SceneTab)
    shown.document.clear()
    shown.document.use_bank(None)
    shown.surface.canvas.use_tool("")
    shown.surface.snaps.setChecked(False)
    shown.surface.canvas.setFocus()
    shared_window.messages.dismiss()
    wait(qtbot, lambda: shown.surface.canvas.isVisible() and shown.live.backdrop.surface is None and shown.live.idle)
    shown.surface.canvas.box.autoRange()
    laid_out(shown.surface.canvas)
    yield shown
    assert shared_window.tracebacks == []


@pytest.fixture
def own_tab(qtbot: QtBot, open_window: Opens, memory: Settings, tmp_path: Path) -> SceneTab:
    """The Scene tab of a window that may be closed."""
    memory.keep("folder/.toml", str(tmp_path))
    shown = shown_tab(open_window(), SceneTab)
    wait(qtbot, lambda: shown.surface.canvas.isVisible() and shown.live.idle)
    laid_out(shown.surface.canvas)
    return shown


def laid_out(canvas: SceneCanvas) -> None:
    """Let the surface find its place: the axes make room for their numbers when they are painted."""
    for _ in range(3):
        canvas.grab()
        QApplication.processEvents()


def settled(qtbot: QtBot, tab: SceneTab) -> None:
    wait(qtbot, lambda: tab.live.idle)


def near(at: tuple[float, float], x_mm: float, y_mm: float, reach_mm: float = 1.5) -> bool:
    return math.dist(at, (x_mm, y_mm)) < reach_mm


def draw(qtbot: QtBot, tab: SceneTab, kind: str) -> PathTable:
    """Draw a path of each kind with the mouse."""
    canvas = tab.surface.canvas
    qtbot.mouseClick(tab.surface.tools[kind], LEFT)
    match kind:
        case "line":
            drag(qtbot, canvas, [pixel(canvas, -40, 0), pixel(canvas, 40, 20)], NO_KEY)
        case "circle":
            click(canvas, pixel(canvas, 5, 5))
            click(canvas, pixel(canvas, 35, 5))
        case "polyline":
            click(canvas, pixel(canvas, -30, -30))
            click(canvas, pixel(canvas, 0, 30))
            double_click(canvas, pixel(canvas, 30, -30))
        case _:
            click(canvas, pixel(canvas, -20, 10))
    settled(qtbot, tab)
    return tab.document.source.path


def test_given_each_tool_then_its_path_is_drawn_chosen_and_sampled_and_the_tool_is_put_away(
    qtbot: QtBot, tab: SceneTab
) -> None:
    canvas = tab.surface.canvas
    line = draw(qtbot, tab, "line")
    assert near(line.start_mm, -40, 0)
    assert near(line.end_mm, 40, 20)
    circle = draw(qtbot, tab, "circle")
    assert near(circle.centre_mm, 5, 5)
    assert circle.radius_mm == pytest.approx(30, abs=1.5)
    polyline = draw(qtbot, tab, "polyline")
    assert len(polyline.points_mm) == 3
    assert near(polyline.points_mm[2], 30, -30)
    assert not polyline.closed
    point = draw(qtbot, tab, "point")
    assert near(point.at_mm, -20, 10)
    draw(qtbot, tab, "text")
    assert QApplication.focusWidget() is tab.source_form.paths["text"].fields["string"]
    assert canvas.kind == ""
    assert tab.sources.list.count() == 5
    assert tab.document.chosen == 4
    traces = tab.live.preview.traces
    assert [trace.problem for trace in traces] == [""] * 5
    assert traces[0].points == math.floor(math.dist(line.start_mm, line.end_mm) / 4.0) + 1
    assert traces[4].length_mm > 50
    assert tab.document.scene().sources[3].path == paths.Point(point.at_mm)


def test_given_a_polyline_then_the_first_corner_closes_it_and_backspace_takes_one_back(
    qtbot: QtBot, tab: SceneTab
) -> None:
    canvas = tab.surface.canvas
    qtbot.keyClick(canvas, Qt.Key.Key_P)
    assert tab.surface.tools["polyline"].isChecked()
    for x_mm, y_mm in ((-30, -30), (80, 0), (0, 30), (30, -30)):
        click(canvas, pixel(canvas, x_mm, y_mm))
        if x_mm == 80:
            qtbot.keyClick(canvas, Qt.Key.Key_Backspace)
    click(canvas, pixel(canvas, -30, -30))
    path = tab.document.source.path
    assert path.closed
    assert len(path.points_mm) == 3
    qtbot.keyClick(canvas, Qt.Key.Key_L)
    click(canvas, pixel(canvas, 0, 0))
    qtbot.keyClick(canvas, Qt.Key.Key_Escape)
    assert (canvas.kind, len(tab.document.draft.source)) == ("", 1)


def test_given_a_drag_of_a_handle_then_it_is_one_step_that_is_undone_and_done_again(
    qtbot: QtBot, tab: SceneTab
) -> None:
    canvas, document = tab.surface.canvas, tab.document
    drawn = draw(qtbot, tab, "line")
    drag(qtbot, canvas, [pixel(canvas, *drawn.end_mm), pixel(canvas, 20, -30), pixel(canvas, 10, -40)], NO_KEY)
    shaped = document.source.path
    assert near(shaped.end_mm, 10, -40)
    assert shaped.start_mm == drawn.start_mm
    assert document.steps.count() == 2
    canvas.setFocus()
    qtbot.keyClick(canvas, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier)
    assert document.draft.source[0].path == drawn
    qtbot.keyClick(canvas, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier | Qt.KeyboardModifier.ShiftModifier)
    assert document.draft.source[0].path == shaped
    qtbot.keyClick(canvas, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier)
    qtbot.keyClick(canvas, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier)
    assert (document.draft.source, document.chosen) == ((), -1)


def test_given_a_drag_of_a_path_or_arrow_keys_then_all_of_it_moves_and_a_drag_elsewhere_moves_the_view(
    qtbot: QtBot, tab: SceneTab
) -> None:
    canvas, document = tab.surface.canvas, tab.document
    drawn = draw(qtbot, tab, "circle")
    slope = math.radians(225)
    rim = drawn.centre_mm[0] + drawn.radius_mm * math.cos(slope), drawn.centre_mm[1] + drawn.radius_mm * math.sin(slope)
    drag(qtbot, canvas, [pixel(canvas, *rim), pixel(canvas, rim[0] - 20, rim[1] + 10)], NO_KEY)
    source = document.source
    assert near(source.path.centre_mm, drawn.centre_mm[0] - 20, drawn.centre_mm[1] + 10)
    assert source.path.radius_mm == drawn.radius_mm
    canvas.setFocus()
    for _ in range(3):
        qtbot.keyClick(canvas, Qt.Key.Key_Right)
    qtbot.keyClick(canvas, Qt.Key.Key_Up, Qt.KeyboardModifier.ShiftModifier)
    assert document.source == changed(source, path=shifted(source.path, (3.0, 10.0)))
    assert document.steps.count() == 3
    settled(qtbot, tab)
    before = canvas.box.viewRange()
    drag(qtbot, canvas, [pixel(canvas, 100, -90), pixel(canvas, 80, -80)], NO_KEY)
    assert document.steps.count() == 3
    assert canvas.box.viewRange() != before


def test_given_a_polyline_then_a_double_click_adds_a_vertex_and_del_deletes_the_one_held(
    qtbot: QtBot, tab: SceneTab
) -> None:
    canvas, document = tab.surface.canvas, tab.document
    drawn = draw(qtbot, tab, "polyline")
    (x0, y0), (x1, y1) = drawn.points_mm[:2]
    double_click(canvas, pixel(canvas, (x0 + x1) / 2, (y0 + y1) / 2))
    path = document.draft.source[0].path
    assert len(path.points_mm) == 4
    assert near(path.points_mm[1], (x0 + x1) / 2, (y0 + y1) / 2)
    click(canvas, pixel(canvas, *path.points_mm[1]))
    canvas.setFocus()
    qtbot.keyClick(canvas, Qt.Key.Key_Delete)
    assert document.draft.source[0].path == drawn
    assert tab.source_form.vertices.table.rowCount() == 3
    qtbot.keyClick(canvas, Qt.Key.Key_Delete)
    assert document.draft.source == ()


def test_given_a_bank_then_points_are_snapped_coloured_and_those_off_its_grid_are_told(
    qtbot: QtBot, tab: SceneTab, finished: Path
) -> None:
    tab._bank_chosen(finished)
    wait(qtbot, lambda: tab.live.backdrop.surface is not None)
    laid_out(tab.surface.canvas)
    source = changed(new_source(LineTable(start_mm=(0.0, 0.0), end_mm=(4.5, 0.0))), step_mm=1.5)
    tab.document.edit("draw", SceneConfig(source=(source,)))
    settled(qtbot, tab)
    trace = tab.live.preview.traces[0]
    surface = tab.live.backdrop.surface
    assert surface.position_mm[trace.rows].tolist() == trace.points_mm.tolist()
    assert not trace.off.any()
    assert tab.surface.problem == ""
    source = changed(source, path=LineTable(start_mm=(0.0, 0.0), end_mm=(9.0, 0.0)))
    tab.document.edit("draw", with_source(tab.document.draft, 0, source))
    wait(qtbot, lambda: "2 of 7 points" in tab.surface.problem)
    assert tab.live.preview.traces[0].off.tolist() == [False] * 5 + [True] * 2
    canvas = tab.surface.canvas
    tab.surface.snaps.setChecked(True)
    qtbot.keyClick(canvas, Qt.Key.Key_D)
    click(canvas, pixel(canvas, 1.4, 3.1))  # a pixel is up to 1.2 mm
    assert tab.document.draft.source[1].path == PointTable(at_mm=(1.5, 3.0))


def test_given_the_form_then_every_number_reaches_the_scene_and_undo_brings_it_back(
    qtbot: QtBot, tab: SceneTab
) -> None:
    document, form = tab.document, tab.source_form
    draw(qtbot, tab, "line")
    speed = form.motion.fields["speed_mm_s"]
    speed.selectAll()
    qtbot.keyClicks(speed, "37.5")
    qtbot.keyClick(speed, Qt.Key.Key_Return)
    assert document.draft.source[0].speed_mm_s == 37.5
    qtbot.keyClick(speed, Qt.Key.Key_Z, Qt.KeyboardModifier.ControlModifier)
    assert document.draft.source[0].speed_mm_s == 80.0
    assert speed.text() == "80 mm/s"
    choose(form.signal_kind, "sine")
    assert isinstance(document.draft.source[0].signal, SineTable)
    wait(qtbot, lambda: isinstance(tab.live.preview.draft.source[0].signal, SineTable))
    choose(form.path_kind, "point")
    assert isinstance(document.draft.source[0].path, PointTable)
    assert not speed.isVisible()
    limit = tab.scene_form.tables["output"].fields["limit_v"]
    assert document.draft.output.limit_v == 1.0  # a new scene can be played
    limit.switch.click()  # type: ignore[union-attr]
    assert document.draft.output.limit_v is None
    choose(tab.scene_form.saturates, "saturation")
    assert document.draft.regularisation == Regularisation(saturation=0.5)


def test_given_quiet_places_then_they_are_drawn_edited_moved_deleted_undone_and_saved(
    qtbot: QtBot, tab: SceneTab, tmp_path: Path
) -> None:
    document, canvas, panel = tab.document, tab.surface.canvas, tab.quiet
    draw(qtbot, tab, "line")
    canvas.use_tool("quiet")
    click(canvas, pixel(canvas, 30.0, 20.0))
    (place,) = document.draft.quiet
    assert place.at_mm is not None
    assert near(place.at_mm, 30.0, 20.0)
    assert (canvas.kind, document.chosen, document.chosen_quiet) == ("", -1, 0)
    drag(qtbot, canvas, [pixel(canvas, 30.0, 20.0), pixel(canvas, 40.0, -10.0)], NO_KEY)
    moved = document.draft.quiet[0]
    assert moved.at_mm is not None
    assert near(moved.at_mm, 40.0, -10.0, 2.5)
    panel.table.item(0, 3).setText("6")
    panel.table.item(0, 4).setText("-25")
    assert (document.draft.quiet[0].radius_mm, document.draft.quiet[0].level_db) == (6.0, -25.0)
    panel.table.item(0, 4).setText("loud")
    assert panel.table.item(0, 4).text() == "-25"
    document.save(tmp_path / "scene.toml")
    assert load_scene(tmp_path / "scene.toml").quiet[0].level_db == -25.0
    for _ in range(2):
        tab.actions_by_name["undo"].trigger()
    assert document.draft.quiet[0] == moved
    tab.actions_by_name["undo"].trigger()
    assert document.draft.quiet[0] == place
    click(canvas, pixel(canvas, 30.0, 20.0))
    qtbot.keyClick(canvas, Qt.Key.Key_Delete)
    assert document.draft.quiet == ()
    assert len(document.draft.source) == 1
    tab.actions_by_name["undo"].trigger()
    assert document.draft.quiet == (place,)


def test_given_a_chosen_quiet_place_then_undoing_a_step_of_a_source_chooses_only_the_source(
    qtbot: QtBot, tab: SceneTab
) -> None:
    document = tab.document
    draw(qtbot, tab, "line")
    document.add_quiet((30.0, 20.0))
    document.choose(0)
    document.edit_source("louder", amplitude=2.0)
    document.choose_quiet(0)
    tab.actions_by_name["undo"].trigger()
    assert (document.chosen, document.chosen_quiet) == (0, -1)
    assert len(document.draft.quiet) == 1


def test_given_sources_then_they_are_copied_as_text_pasted_duplicated_reordered_and_deleted(
    qtbot: QtBot, tab: SceneTab
) -> None:
    document, named = tab.document, tab.actions_by_name
    document.edit("draw", SceneConfig(source=(new_source(NEW_PATHS["point"]), new_source(NEW_PATHS["line"]))), chosen=1)
    named["copy"].trigger()
    clipboard = QApplication.clipboard()
    assert clipboard.text().startswith("[[source]]\n")
    named["paste"].trigger()
    assert document.draft.source[2] == document.draft.source[1]
    named["up"].trigger()
    named["up"].trigger()
    assert [source.path.kind for source in document.draft.source] == ["line", "point", "line"]
    assert document.chosen == 0
    named["duplicate"].trigger()
    assert document.draft.source[1].path == shifted(NEW_PATHS["line"], (5.0, -5.0))
    named["delete"].trigger()
    assert [source.path.kind for source in document.draft.source] == ["line", "point", "line"]
    clipboard.setText("[[source]]\npath = 3\n")
    named["paste"].trigger()
    assert "nothing is pasted: source[0].path" in tab.context.messages.sentence
    clipboard.setText("a shopping list")
    named["paste"].trigger()
    assert "no [[source]]" in tab.context.messages.sentence


def test_given_a_scene_file_then_it_is_opened_saved_and_opened_again_as_the_same_scene(
    qtbot: QtBot, tab: SceneTab, tmp_path: Path
) -> None:
    file = tmp_path / "two.toml"
    file.write_text(SCENE, encoding="utf-8")
    assert tab.accepts(file)
    tab.open_file(file)
    document = tab.document
    assert (document.path, document.saved, len(document.draft.source)) == (file, True, 2)
    assert document.scene() == load_scene(file)
    document.choose(0)
    document.edit_source("edit", amplitude=0.25)
    assert not document.saved
    tab.actions_by_name["save"].trigger()
    assert document.saved
    assert "two.toml~" in tab.context.messages.sentence
    assert file.with_name("two.toml~").read_text(encoding="utf-8") == SCENE
    assert load_scene(file) == document.scene()
    assert load_scene(file).sources[0].amplitude == 0.25
    before = document.draft
    tab.files.new()
    assert document.draft == NEW_SCENE
    tab.open_file(file)
    assert document.draft == before


def test_given_unsaved_changes_then_closing_asks_and_saving_closes(
    qtbot: QtBot, own_tab: SceneTab, tmp_path: Path
) -> None:
    window = own_tab.window()
    draw(qtbot, own_tab, "line")
    window.close()
    assert window.isVisible()
    answers = {button.text(): button for button in window.messages.buttons()}
    assert "has unsaved changes" in window.messages.sentence
    qtbot.mouseClick(answers["Save and close"], LEFT)
    dialog = own_tab.findChild(QFileDialog)
    assert not dialog.isModal()
    file = tmp_path / "drawn.toml"
    dialog.fileSelected.emit(str(file))
    dialog.close()
    assert not window.isVisible()
    assert len(load_scene(file).sources) == 1


def test_given_a_window_that_is_gone_with_unsaved_changes_then_the_next_one_has_them(
    qtbot: QtBot, open_window: Opens, own_tab: SceneTab, memory: Settings, tmp_path: Path
) -> None:
    file = tmp_path / "two.toml"
    file.write_text(SCENE, encoding="utf-8")
    own_tab.open_file(file)
    own_tab.document.edit("edit", changed(own_tab.document.draft, scene=SceneTable(name="three")))
    wait(qtbot, lambda: 'name = "three"' in memory.text("scene/unsaved"))
    other = shown_tab(open_window(), SceneTab)
    assert other.document.draft == own_tab.document.draft
    assert (other.document.path, other.document.saved) == (file, False)
    assert "two.toml" in other.context.messages.sentence
    other.actions_by_name["save"].trigger()
    assert load_scene(file).name == "three"
    assert memory.text("scene/unsaved") == ""


def test_given_a_file_that_another_program_changed_then_saving_asks(
    qtbot: QtBot, tab: SceneTab, tmp_path: Path
) -> None:
    file = tmp_path / "two.toml"
    file.write_text(SCENE, encoding="utf-8")
    tab.open_file(file)
    file.write_text(SCENE.replace("80.0", "81.0"), encoding="utf-8")
    tab.document.edit("edit", changed(tab.document.draft, scene=SceneTable(name="three")))
    tab.actions_by_name["save"].trigger()
    assert "another program" in tab.context.messages.sentence
    assert load_scene(file).sources[0].speed_mm_s == 81.0
    over = next(button for button in tab.context.messages.buttons() if button.text() == "Save over it")
    qtbot.mouseClick(over, LEFT)
    assert load_scene(file).name == "three"


def test_given_a_drawing_then_it_comes_in_at_a_size_that_fits_and_its_paths_can_be_chosen(
    qtbot: QtBot, tab: SceneTab, tmp_path: Path
) -> None:
    file = tmp_path / "drawing.svg"
    file.write_text(DRAWING, encoding="utf-8")
    window = tab.window()
    window.open_file(file)
    wait(qtbot, lambda: len(tab.document.draft.source) == 1)
    assert tab.document.draft.source[0].path == SvgTable(file=str(file), origin_mm=(-10.0, 5.0))
    form = tab.source_form
    wait(qtbot, lambda: form.path_ids.findData("second") >= 0)
    choose(form.path_ids, "second")
    settled(qtbot, tab)
    assert tab.live.preview.traces[0].length_mm == pytest.approx(500.0)
    canvas = tab.surface.canvas
    scale = next(handle for handle in canvas.handles if handle.name == "scale")
    assert near(scale.at_mm, 390, -295)
    file.unlink()
    tab.document.edit("edit", changed(tab.document.draft, scene=SceneTable(name="gone")))
    wait(qtbot, lambda: "source[0].path.file" in tab.surface.problem)
    assert "must be a file" in tab.surface.problem
    window.open_file(file)
    wait(qtbot, lambda: "cannot be read" in tab.context.messages.sentence)


def test_given_a_trajectory_then_its_file_alone_says_where_the_source_is(
    qtbot: QtBot, tab: SceneTab, tmp_path: Path
) -> None:
    file = tmp_path / "finger.csv"
    file.write_text(FINGER, encoding="utf-8")
    tab.document.edit("edit", changed(tab.document.draft, source=(new_source(PointTable(at_mm=(5.0, 5.0))),)), chosen=0)
    tab.window().open_file(file)
    wait(qtbot, lambda: len(tab.document.draft.source) == 2)
    tab.document.choose(1)
    settled(qtbot, tab)
    trace = tab.live.preview.traces[1]
    assert (trace.length_mm, trace.lasts_s, trace.points) == (20.0, 0.5, 1)
    assert tab.document.scene().sources[1].path.time_s == (0.0, 0.5)
    form = tab.source_form
    shown = {key for key, field in form.motion.fields.items() if not field.isHidden()}
    assert shown == {"start_s", "amplitude", "repeat"}
    assert tab.surface.canvas.handles == []
    assert shifted(TrajectoryTable(file=str(file)), (3.0, 3.0)) == tab.document.draft.source[1].path
    choose(form.path_kind, "line")
    settled(qtbot, tab)
    assert tab.document.scene().sources[1].speed_mm_s > 0


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[scene]\nname = 3\n[[source]]\n", "scene.name = 3: must be text in quotes"),
        ("[[source]\n", "not TOML"),
        (SCENE.replace("radius_mm", "radius"), "did you mean radius_mm?"),
    ],
)
def test_given_a_wrong_scene_file_then_a_sentence_says_where_and_the_scene_stays(
    qtbot: QtBot, tab: SceneTab, tmp_path: Path, text: str, sentence: str
) -> None:
    draw(qtbot, tab, "point")
    before = tab.document.draft
    tab.document.steps.setClean()
    file = tmp_path / "wrong.toml"
    file.write_text(text, encoding="utf-8")
    tab.open_file(file)
    assert str(file) in tab.context.messages.sentence
    assert sentence in tab.context.messages.sentence
    assert tab.document.draft == before


def test_given_a_scene_that_commands_would_refuse_then_the_window_says_so_and_does_not_write_it(
    qtbot: QtBot, tab: SceneTab, tmp_path: Path
) -> None:
    document = tab.document
    with pytest.raises(InputError, match="has no source yet"):
        document.scene()
    with pytest.raises(InputError, match="not saved: the scene has no source yet"):
        document.save(tmp_path / "empty.toml")
    noise = NoiseTable.model_construct(band_hz=(300.0, 20.0), duration_s=0.1)
    wrong = changed(new_source(NEW_PATHS["line"]), signal=noise)
    document.edit("draw", changed(NEW_SCENE, source=(wrong,)), chosen=0)
    wait(qtbot, lambda: "band_hz = [300.0, 20.0]" in tab.surface.problem)
    assert tab.surface.problem == (
        "source[0].signal.band_hz = [300.0, 20.0]: must be [lower, upper] with lower below upper"
    )
    with pytest.raises(InputError, match="band_hz"):
        document.save(tmp_path / "wrong.toml")
    assert list(tmp_path.glob("*.toml")) == []
    letters = new_source(TextTable(string="\U00013000", height_mm=20.0))
    document.edit("draw", SceneConfig(source=(letters,)), chosen=0)
    wait(qtbot, lambda: "DejaVu Sans cannot draw" in tab.surface.problem)
    scene = SceneTable.model_construct(name="a\udcff")
    document.edit("draw", changed(NEW_SCENE, scene=scene, source=(new_source(NEW_PATHS["point"]),)), chosen=0)
    with pytest.raises(InputError, match="which a text file cannot hold"):
        document.save(tmp_path / "name.toml")


WILD = """
[[source]]
path = { kind = "point", at_mm = [1e300, 1e300] }
signal = { kind = "impulse" }
[[source]]
speed_mm_s = 1e-300
step_mm = 1e10
path = { kind = "circle", radius_mm = 1e12 }
signal = { kind = "sine", frequency_hz = 1e300, duration_s = 0.1 }
[[source]]
speed_mm_s = 1.0
step_mm = 1e-12
path = { kind = "line", start_mm = [0, 0], end_mm = [1e308, -1e308] }
signal = { kind = "noise", band_hz = [0, 1], duration_s = 1e7 }
"""


def test_given_numbers_beyond_all_measure_then_sentences_say_so_and_nothing_else_happens(
    qtbot: QtBot, tab: SceneTab, finished: Path, tmp_path: Path
) -> None:
    file = tmp_path / "wild.toml"
    file.write_text(WILD, encoding="utf-8")
    tab.open_file(file)
    tab.document.use_bank(finished)
    wait(qtbot, lambda: tab.live.preview.backdrop.surface is not None and tab.live.idle)
    point, circle, line = tab.live.preview.traces
    assert (point.points, point.far) == (1, 1)
    assert "later than numbers reach" in circle.problem
    assert tab.surface.problem == circle.problem
    assert circle.problem.startswith("source 1: ")
    assert "at most 100000000 are allowed" in line.problem
    told = []
    for index in range(3):
        tab.document.choose(index)
        settled(qtbot, tab)
        told.append(tab.live.preview.signal)
    assert "frequency_hz is 1e+300" in str(told[1])
    assert "too long to be drawn" in str(told[2])


FINITE = st.floats(-1e6, 1e6, allow_nan=False)
ABOVE = st.floats(1e-6, 1e6)
NONNEGATIVE = st.floats(0.0, 1e6)
PLACE = st.tuples(FINITE, FINITE)
NEAR = st.floats(-99.0, 99.0)
WORDS = st.text(st.characters(codec="utf-8"), min_size=1, max_size=20)
LETTERS = st.text("abcXYZ089 \"\\'é☺#{}", min_size=1, max_size=6).filter(lambda text: bool(text.strip()))
BAND = st.tuples(NONNEGATIVE, ABOVE).map(lambda one: (min(one), max(one) + 1.0))
PATHS = st.one_of(
    st.builds(PointTable, at_mm=PLACE),
    st.builds(LineTable, start_mm=PLACE, end_mm=PLACE),
    st.builds(CircleTable, centre_mm=PLACE, radius_mm=NONNEGATIVE, turns=st.floats(-100.0, 100.0), start_deg=FINITE),
    st.builds(PolylineTable, points_mm=st.lists(PLACE, min_size=1, max_size=8).map(tuple), closed=st.booleans()),
    st.builds(TextTable, string=LETTERS, height_mm=ABOVE, centre_mm=PLACE),
    st.builds(
        SvgTable,
        file=st.just("drawing.svg"),
        path_id=st.sampled_from(["", "first", "second"]),
        scale=ABOVE,
        origin_mm=PLACE,
    ),
    st.builds(TrajectoryTable, file=st.just("finger.csv")),
)
SIGNALS = st.one_of(
    st.builds(ImpulseTable),
    st.builds(SineTable, frequency_hz=ABOVE, duration_s=ABOVE),
    st.builds(NoiseTable, band_hz=BAND, duration_s=ABOVE, seed=st.integers(0, 2**63 - 1)),
    st.builds(FileTable, path=st.just("a folder/sound.wav")),
)
SOURCES = st.builds(
    SourceTable,
    path=PATHS,
    signal=SIGNALS,
    start_s=NONNEGATIVE,
    speed_mm_s=ABOVE,
    step_mm=ABOVE,
    amplitude=FINITE,
    emission=st.sampled_from(["continuous", "per_point"]),
).map(lambda one: changed(one, emission="continuous", repeat=True) if one.path.kind == "trajectory" else one)
SATURATIONS = st.one_of(st.tuples(NONNEGATIVE, st.just(0.0)), st.tuples(st.just(0.0), NONNEGATIVE))
DRAFTS = st.builds(
    SceneConfig,
    scene=st.builds(SceneTable, name=WORDS),
    source=st.lists(SOURCES, min_size=1, max_size=4).map(tuple),
    regularisation=st.builds(
        lambda both, normalise: Regularisation(saturation=both[0], saturation_absolute=both[1], normalise=normalise),
        SATURATIONS,
        st.booleans(),
    ),
    output=st.builds(
        Output,
        interpolation=st.sampled_from(["nearest", "bilinear", "kernel"]),
        limit_v=st.one_of(st.none(), ABOVE),
        limit_rms_v=st.one_of(st.none(), ABOVE),
    ),
)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with what the drafts name."""
    made = tmp_path_factory.mktemp("scenes")
    (made / "drawing.svg").write_text(DRAWING, encoding="utf-8")
    (made / "finger.csv").write_text(FINGER, encoding="utf-8")
    (made / "a folder").mkdir()
    (made / "a folder" / "sound.wav").write_bytes(b"")
    return made


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(draft=DRAFTS)
def test_given_any_draft_then_what_is_written_is_the_same_scene_to_the_command_line_and_the_same_draft_again(
    draft: SceneConfig, folder: Path
) -> None:
    file = folder / "scene.toml"
    text = scene_toml(draft, folder)
    file.write_bytes(text.encode("utf-8"))
    assert load_scene(file) == build_scene(draft, file)
    again = read_draft(text, file)
    assert scene_toml(again, folder) == text
    assert again.regularisation == draft.regularisation
    document = SceneDocument()
    document.load(file)
    assert document.scene() == load_scene(file)
    assert document.toml() == text


@settings(max_examples=60, deadline=None)
@given(path=PATHS, by=st.tuples(NEAR, NEAR), to=st.tuples(NEAR, NEAR))
def test_given_any_handle_then_moving_it_moves_it_there_and_a_shift_moves_them_all(
    path: PathTable, by: tuple[float, float], to: tuple[float, float]
) -> None:
    before = handles_of(path)
    after = handles_of(shifted(path, by))
    for one, other in zip(before, after, strict=True):
        moved = one.at_mm[0] + by[0], one.at_mm[1] + by[1]
        assert math.dist(other.at_mm, moved) < 0.02 + 1e-9 * math.dist(moved, (0, 0))
    if isinstance(path, LineTable | PolylineTable | PointTable):
        for one in before:
            there = {handle.name: handle.at_mm for handle in handles_of(with_handle_at(path, one.name, to))}
            assert math.dist(there[one.name], to) < 0.01
