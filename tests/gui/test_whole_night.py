"""A whole campaign with the mouse only: measured, interrupted, resumed, corrected, drawn, rendered, verified."""

import os
import signal

import pytest
from PyQt5.QtCore import Qt
from PyQt5.QtWidgets import QAbstractButton, QDialogButtonBox, QFileDialog, QListView, QTabBar

from tests.gui.conftest import LEFT, NO_KEY, campaign_of, click, drag, pixel, press, tab_of, wait, write_lab
from wavefocus.gui.scene.tab import SceneTab
from wavefocus.gui.verification.tab import VerificationTab
from wavefocus.storage.bank.ledger import not_valid
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.ledger.owner import bank_owner

DARK = 5
FAULT = f'{{ role = "recorder", operation = "read", kind = "dropout", position = {DARK}, count = 99 }}'


def turn_to(qtbot, window, title):
    bar = window.findChild(QTabBar)
    qtbot.mouseClick(bar, LEFT, pos=bar.tabRect([one.title for one in window.tabs].index(title)).center())


def take(qtbot, name, window):
    """In the dialog that is open, click on a file where it is there, and on what accepts."""
    wait(qtbot, lambda: any(one.isVisible() for one in window.findChildren(QFileDialog)))
    dialog = next(one for one in window.findChildren(QFileDialog) if one.isVisible())
    if name:
        files = dialog.findChild(QListView, "listView")
        model = files.model()

        def found():
            rows = (model.index(row, 0, files.rootIndex()) for row in range(model.rowCount(files.rootIndex())))
            return [one for one in rows if one.data() == name]

        wait(qtbot, lambda: len(found()) == 1)
        files.scrollTo(found()[0])
        qtbot.mouseClick(files.viewport(), LEFT, pos=files.visualRect(found()[0]).center())
    box = dialog.findChild(QDialogButtonBox)
    press(qtbot, next(one for one in box.buttons() if box.buttonRole(one) == QDialogButtonBox.ButtonRole.AcceptRole))


def choose(qtbot, window, field, name):
    """Choose a file through the button behind its field."""
    press(qtbot, field.browse)
    take(qtbot, name, window)
    wait(qtbot, lambda: field.path is not None and field.path.name == name)


@pytest.mark.timeout(600)
@pytest.mark.long
def test_a_night_is_run_interrupted_resumed_rendered_and_verified_by_mouse_alone(qtbot, open_window, memory, tmp_path):
    run_file = write_lab(tmp_path / "lab", 10, 6)
    lab = run_file.parent
    run_file.write_text(run_file.read_text(encoding="utf-8") + f"fault_plan = [{FAULT}]\n", encoding="utf-8")
    for ending in (".toml", ".h5"):
        memory.keep(f"folder/{ending}", str(lab))  # where files were chosen last time
    window = open_window()
    tab, bank = campaign_of(window), lab / "plate.h5"

    choose(qtbot, window, tab.run_field, "run.toml")
    assert tab.bank_field.path == bank
    buttons = tab.controls.actions_by_name
    press(qtbot, buttons["start"])
    wait(qtbot, lambda: tab.campaign.measured > 5)
    press(qtbot, buttons["pause"])
    wait(qtbot, lambda: tab.progress.state.text() == "paused" and "paused by the user" in window.messages.sentence)
    assert tab.controls.actions_by_name["pause"].text() == "Continue"
    os.kill(bank_owner(bank).pid, signal.SIGTERM if os.name == "nt" else signal.SIGKILL)  # the power is cut
    wait(qtbot, lambda: tab.progress.state.text() == "gone")
    assert "ended unexpectedly" in window.messages.sentence
    press(qtbot, buttons["resume"])
    wait(qtbot, lambda: tab.progress.state.text() == "finished")
    assert tab.campaign.measured == 60
    assert _not_valid(bank) == [DARK]
    press(qtbot, buttons["poor"])
    wait(qtbot, lambda: tab.run.own is None and DARK in tab.campaign.session.kept)  # no better: the bank's row stays
    assert _not_valid(bank) == [DARK]  # it is still dark there, and never called valid
    shown = tab.map_panel.map
    at = [pixel(shown, *tab.campaign.surface.position_mm[row]) for row in (7, 8)]
    click(shown, at[0])
    for one in at:
        click(shown, one, Qt.KeyboardModifier.ControlModifier)
    press(qtbot, buttons["selected"])
    wait(qtbot, lambda: tab.run.own is None and all(tab.campaign.commits[row] > 1 for row in (7, 8)))
    assert _not_valid(bank) == [DARK]

    turn_to(qtbot, window, "Scene")
    scene = tab_of(window, SceneTab)
    assert scene.document.bank == bank
    canvas = scene.surface.canvas
    press(qtbot, scene.surface.tools["line"])
    drag(qtbot, canvas, [pixel(canvas, 0.5, 1.5), pixel(canvas, 10.0, 3.0)], NO_KEY)
    wait(qtbot, lambda: len(scene.document.draft.source) == 1)
    press(qtbot, _named(scene, "Undo"))
    wait(qtbot, lambda: scene.document.draft.source == ())
    press(qtbot, _named(scene, "Redo"))
    wait(qtbot, lambda: scene.results.calculation.complete)
    press(qtbot, _named(scene, "Save"))
    take(qtbot, "", window)
    wait(qtbot, (lab / "scene.toml").exists)
    press(qtbot, scene.results.buttons["drive"])
    take(qtbot, "", window)
    wait(qtbot, (lab / "scene-drive.h5").exists)

    turn_to(qtbot, window, "Verification")
    verification = tab_of(window, VerificationTab)
    choose(qtbot, window, verification.form.bank, "plate.h5")
    assert verification.form.missing() == ""  # scene and rig lie beside the bank
    verification.form.positions.setText("path")
    press(qtbot, _named(verification, "Verify"))
    wait(qtbot, lambda: verification.results is not None)
    (_, loudest), _, (_, difference) = verification.results.film.scales
    assert 0.0 < difference < 1e-2 * loudest
    assert (lab / "verify" / "verify.json").exists()
    for _ in range(2):
        press(qtbot, verification.maps.time.play)


def _not_valid(bank):
    with open_bank(bank) as view:
        return not_valid(view.status)


def _named(tab, words):
    return next(one for one in tab.findChildren(QAbstractButton) if one.text().replace("&", "") == words)
