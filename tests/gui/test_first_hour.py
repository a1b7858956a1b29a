"""The window from nothing: a new lab, files shared across tabs, files of a wrong kind, messages that no longer hold."""

from pathlib import Path

import numpy as np
import pytest
from PyQt5.QtCore import QSettings
from PyQt5.QtWidgets import QFileDialog, QGraphicsTextItem

from tests.gui.conftest import (
    answer,
    campaign_of,
    edit,
    kept_window,
    line_scene,
    menus,
    pages_of,
    shown_tab,
    tab_of,
    wait,
    write_lab,
)
from tests.lab_files import change_text
from wavefocus.gui.field_map import ColourBar
from wavefocus.gui.files import FileKind, Settings, misplaced
from wavefocus.gui.rig.tab import RigTab
from wavefocus.gui.scene.tab import SceneTab
from wavefocus.gui.verification.tab import VerificationTab


def type_path(field, path):
    field.line.setText(str(path))
    field.line.editingFinished.emit()


def test_given_a_new_lab_then_its_files_are_written_and_open_in_all_tabs(qtbot, open_window, tmp_path):
    window, names = open_window(), {"rig.toml", "run.toml", "scene.toml", "trials.toml", "fingers.toml"}
    for word, table in (("Own instruments", "[mirror]"), ("Virtual rig", "[virtual]")):
        make_lab(window, lab := tmp_path / word, word)
        wait(qtbot, lambda lab=lab: tab_of(window, RigTab).rig_field.path == lab / "rig.toml")
        wait(qtbot, lambda lab=lab: campaign_of(window).run_field.path == lab / "run.toml")
        assert tab_of(window, SceneTab).document.path == lab / "scene.toml"
        files = {path.name: path.read_text(encoding="utf-8") for path in lab.iterdir()}
        assert set(files) == names
        assert table in files["rig.toml"] + files["run.toml"]
    wait(qtbot, lambda: campaign_of(window).map_panel.planned is not None)
    make_lab(window, lab, word)  # nothing in it is touched
    wait(qtbot, lambda: str(lab) in window.messages.sentence and "the lab is in" not in window.messages.sentence)
    assert {path.name: path.read_text(encoding="utf-8") for path in lab.iterdir()} == files


def test_run_then_outline_actuators_grid_and_hours_are_shown_before_there_is_bank(qtbot, open_window, tmp_path):
    run = write_lab(tmp_path / "lab", 4, 3)
    window = open_window()
    tab = campaign_of(window)
    window.refresh()
    assert not tab.progress.bar.isTextVisible()  # nothing to count yet
    window.open_file(run)
    wait(qtbot, lambda: tab.map_panel.map.surface is not None)
    surface = tab.map_panel.map.surface
    assert (surface.positions, len(surface.actuator_mm)) == (12, 3)
    assert np.ptp(surface.outline_mm, axis=0) == pytest.approx([250.0, 150.0])
    wait(qtbot, lambda: "12 positions" in tab.progress.figures.text())
    assert (tab.progress.bar.value(), tab.progress.bar.maximum()) == (0, 12)
    change_text(run, "averages = 2", "averages = 0")
    shown_tab(window, RigTab)
    shown_tab(window, type(tab))  # it was edited: read again
    wait(qtbot, lambda: "averages" in window.messages.sentence)
    assert tab.map_panel.map.surface is None
    change_text(run, "averages = 0", "averages = 2")
    shown_tab(window, RigTab)
    shown_tab(window, type(tab))
    wait(qtbot, lambda: tab.map_panel.map.surface is not None)
    assert "averages" not in window.messages.sentence  # the error holds no longer


def test_given_a_run_rig_bank_or_scene_in_one_tab_then_all_tabs_have_it(qtbot, open_window, finished, tmp_path):
    window, lab, disc = open_window(), finished.parent, tmp_path / "disc.toml"
    campaign, rig = campaign_of(window), tab_of(window, RigTab)
    scene, verification = tab_of(window, SceneTab), tab_of(window, VerificationTab)
    disc.write_text('[rig]\nname = "disc"\n[surface]\nlength_mm = 180.0\nwidth_mm = 120.0\n', encoding="utf-8")
    window.open_file(disc)
    # Without a bank, scenes are drawn on the rig's surface.
    assert np.ptp(scene.live.backdrop.outline_mm, axis=0) == pytest.approx([180.0, 120.0], abs=0.1)
    type_path(campaign.run_field, lab / "run.toml")
    assert rig.rig_field.path == lab / "rig.toml"
    assert scene.rig_field.path == verification.form.rig.path == lab / "rig.toml"
    assert campaign.bank_field.path == scene.document.bank == verification.form.bank.path == finished
    other = write_lab(lab / "other", 2, 2).with_name("rig.toml")
    for field in (rig.rig_field, scene.rig_field, verification.form.rig):
        for chosen in (other, lab / "rig.toml"):
            type_path(field, chosen)
            shown = {rig.rig_field.path, scene.rig_field.path, verification.form.rig.path}
            assert shown == {chosen}
    copy = lab / "copy.h5"
    copy.write_bytes(finished.read_bytes())
    for field in (scene.bank_field, verification.form.bank, campaign.bank_field):
        for chosen in (copy, finished):
            type_path(field, chosen)
            assert {scene.document.bank, verification.form.bank.path, campaign.bank_field.path} == {chosen}
    edit(scene.document, line_scene())
    assert verification.form.missing() == "choose a scene file"  # what is not in a file cannot be verified
    scene.document.save(saved := lab / "mine.toml")
    assert (verification.form.scene.path, verification.form.missing()) == (saved, "")
    for text, named in (("virtual", "virtual"), ("rig.toml", str(Path("rig.toml").absolute())), ("virtual", "virtual")):
        type_path(scene.rig_field, text)
        assert scene.document.rig == named
    assert scene.rig_field.line.text() == "virtual"  # a word, no path


def make_lab(window, lab, word):
    """Choose a folder for a new lab, and its kind of rig."""
    next(action for action in menus(window)["File"].actions() if "lab" in action.text()).trigger()
    (dialog,) = (one for one in window.findChildren(QFileDialog) if one.isVisible())
    dialog.fileSelected.emit(str(lab))
    dialog.reject()
    answer(window, word)


WRONG = (
    ("rig.toml", FileKind.RUN), ("plate.h5", FileKind.RUN), ("run.toml", FileKind.RIG), ("run.toml", FileKind.BANK),
    ("plate.raw.h5", FileKind.BANK), ("trials.toml", FileKind.RUN), ("plate.h5", FileKind.SCENE),
    ("run.toml", FileKind.SCENE),
)  # fmt: skip


def test_given_a_file_of_another_kind_then_it_is_refused_at_once_and_the_field_stays(qtbot, open_window, finished):
    finished.with_name("trials.toml").write_text('[trials]\nname = "direction"\n', encoding="utf-8")
    window = open_window()
    fields = {
        FileKind.RUN: campaign_of(window).run_field,
        FileKind.RIG: tab_of(window, RigTab).rig_field,
        FileKind.BANK: campaign_of(window).bank_field,
        FileKind.SCENE: tab_of(window, VerificationTab).form.scene,
    }
    for name, wanted in WRONG:
        path = finished.with_name(name)
        type_path(fields[wanted], path)
        assert (fields[wanted].path, window.messages.sentence) == (None, misplaced(path, wanted))
        assert str(path) in window.messages.sentence
        assert str(wanted) in window.messages.sentence
        pages_of(window).setCurrentIndex((pages_of(window).currentIndex() + 1) % 4)
        assert window.messages.sentence == ""  # the field is out of sight, and has its former file
    right = {FileKind.BANK: "plate.h5", FileKind.RIG: "rig.toml", FileKind.RUN: "run.toml"}
    for wanted, name in right.items():
        type_path(fields[wanted], finished.with_name(next(name for name, kind in WRONG if kind is wanted)))
        assert window.messages.sentence
        type_path(fields[wanted], finished.with_name(name))
        assert window.messages.sentence == ""  # it holds no longer


def test_given_settings_that_cannot_be_saved_then_closing_says_so_and_loses_no_scene(tmp_path):
    (blocked := tmp_path / "file").write_text("", encoding="utf-8")
    place = str(blocked / "memory.ini")
    with kept_window(Settings(QSettings(place, QSettings.Format.IniFormat))) as window:
        edit(tab_of(window, SceneTab).document, line_scene())
        window.close()
        words = [button.text() for button in window.messages.buttons]
        assert words == ["Save and close", "Close without saving", "Do not close"]
        assert str(blocked) in window.messages.sentence
        assert window.isVisible()
        blocked.unlink()
        answer(window, "Do not close")
        window.close()
        answer(window, "Close and keep for next time")
        assert not window.isVisible()
    assert "[[source]]" in QSettings(place, QSettings.Format.IniFormat).value("scene/unsaved")


def test_given_a_colour_bar_then_its_caption_is_inside_it(qtbot, shared_window):
    bars = shown_tab(shared_window, SceneTab).window().findChildren(ColourBar)
    assert len(bars) >= 3
    for bar in bars:
        bar.show_range("Focus instant", "s", (0.0, 1.5))
        bar.resize(bar.sizeHint())
        bar.show()
        qtbot.wait(20)
        texts = (item for item in bar.items() if isinstance(item, QGraphicsTextItem))
        label = next(one for one in texts if "Focus instant" in one.toPlainText())
        inside = label.mapRectToScene(label.boundingRect()).bottom() - label.document().documentMargin()
        assert inside <= bar.height()


def test_given_another_run_file_then_the_bank_of_the_former_one_is_let_go(qtbot, open_window, finished, tmp_path):
    run_file, other = finished.with_name("run.toml"), write_lab(tmp_path / "other", 2, 2)
    window = open_window(run_file)
    tab = campaign_of(window)
    wait(qtbot, lambda: tab.campaign.measured == 12)
    window.messages.warn("something about the first run")
    window.open_file(other)
    assert tab.bank_field.path == other.with_name("plate.h5")
    assert window.messages.sentence == ""
    wait(qtbot, lambda: tab.campaign.surface is None)
    window.open_file(finished)
    window.open_file(other)  # the same run again: the bank that was chosen stays
    assert tab.bank_field.path == finished
