"""Live sources in a real window: mouse, fingers and keys hold them, and the real command on the virtual rig sounds."""

import os
import re
from dataclasses import dataclass
from pathlib import Path

import pytest
from PyQt5.QtCore import QEvent, QPointF, Qt
from PyQt5.QtGui import QTouchEvent
from pytestqt.qtbot import QtBot

from tests.gui.conftest import NO_KEY, edit, line_scene, mouse, pixel, press, shown_tab, wait
from wavefocus.config.messages.live import LiveReady, LiveState
from wavefocus.gui.scene.document import changed
from wavefocus.gui.scene.exports import IDLE, LIVE
from wavefocus.gui.scene.live_panel import KEYS, MOUSE, LiveSurface, figures_of
from wavefocus.gui.scene.tab import DRAW, SceneTab
from wavefocus.gui.scene.tab import LIVE as LIVE_PAGE
from wavefocus.gui.surface import VIRTUAL
from wavefocus.gui.window import Window

SHORT_MM = 0.75


def live_page(qtbot: QtBot, window: Window, bank: Path, rig: str = "") -> SceneTab:
    """The Live page with a bank of the virtual rig, ready to start."""
    tab = shown_tab(window, SceneTab)
    tab._bank_chosen(bank)
    tab.results.rig_field.line.setText(rig or str(bank.with_name("rig.toml")))
    tab.results.rig_field.line.editingFinished.emit()
    tab.modes[LIVE_PAGE].click()
    wait(qtbot, lambda: tab.live.backdrop.surface is not None)
    return tab


def started(qtbot: QtBot, tab: SceneTab) -> None:
    press(qtbot, tab.live_panel.buttons["start"])
    wait(qtbot, lambda: tab.live_run.state in (LIVE, IDLE))
    assert tab.live_run.state == LIVE, tab.context.messages.sentence


def sounds(tab: SceneTab, name: str) -> bool:
    """Whether a source was reported last, perhaps as one that is left out because the machine is busy."""
    state = tab.live_run.latest
    return state is not None and (name in state.dropped or any(one.name == name for one in state.sources))


def sounds_at(tab: SceneTab, name: str, x_mm: float, y_mm: float) -> bool:
    """Whether a source was reported last, and at a place unless it is left out."""
    sources = tab.live_run.latest.sources if tab.live_run.latest else ()
    at_mm = next((one.at_mm for one in sources if one.name == name), (x_mm, y_mm))
    return sounds(tab, name) and at_mm == pytest.approx((x_mm, y_mm), abs=SHORT_MM)


@dataclass(frozen=True)
class Finger:
    """A point of a touch event, as Qt has it; Qt's own can be made in C++ only."""

    number: int
    phase: Qt.TouchPointState
    at: QPointF

    def id(self) -> int:
        return self.number

    def state(self) -> Qt.TouchPointState:
        return self.phase

    def pos(self) -> QPointF:
        return self.at


class Touch(QTouchEvent):
    """A touch event with fingers."""

    def __init__(self, kind: QEvent.Type, *fingers: Finger) -> None:
        super().__init__(kind)
        self.fingers = fingers

    def touchPoints(self) -> list[Finger]:
        return [*self.fingers]


def touch(surface: LiveSurface, kind: QEvent.Type, *fingers: tuple[int, Qt.TouchPointState, float, float]) -> None:
    """Send a touch event: number, state and place (mm) of each finger."""
    points = [Finger(number, state, QPointF(pixel(surface, x_mm, y_mm))) for number, state, x_mm, y_mm in fingers]
    assert surface.viewportEvent(Touch(kind, *points))


def shown(tab: SceneTab) -> str:
    return str(tab.live_panel.figures.text())


def test_mouse_fingers_and_keys_then_sources_sound_follow_and_end_and_stop_mutes(
    qtbot, shared_window, finished, tmp_path
):
    window = shared_window
    tab = live_page(qtbot, window, finished)
    edit(tab.document, line_scene(amplitude=1000.0))
    tab.live_panel.records.setChecked(True)
    tab.live_panel.folder.show_path(tmp_path)
    started(qtbot, tab)
    surface, run = tab.live_surface, tab.live_run

    mouse(surface, QEvent.Type.MouseButtonPress, pixel(surface, 0.0, 1.5), NO_KEY, held=True)
    wait(qtbot, lambda: sounds_at(tab, MOUSE, 0.0, 1.5))
    mouse(surface, QEvent.Type.MouseMove, pixel(surface, 4.5, 1.5), NO_KEY, held=True)
    wait(qtbot, lambda: sounds_at(tab, MOUSE, 4.5, 1.5))
    assert not tab.live_run.latest.sources[0].fading  # at rest it gets positions, too
    assert surface._labels[0].toPlainText() == MOUSE
    wait(qtbot, lambda: "▲ limiter: -" in shown(tab))
    mouse(surface, QEvent.Type.MouseMove, pixel(surface, 40.0, 1.5), NO_KEY, held=True)
    assert run.places[MOUSE] == pytest.approx((6.0, 1.5), abs=SHORT_MM)  # as far as it can be felt
    mouse(surface, QEvent.Type.MouseButtonRelease, pixel(surface, 4.5, 1.5), NO_KEY, held=False)
    wait(qtbot, lambda: not sounds(tab, MOUSE))

    pressed, moved, released = (
        Qt.TouchPointState.TouchPointPressed, Qt.TouchPointState.TouchPointMoved, Qt.TouchPointState.TouchPointReleased,
    )  # fmt: skip
    touch(surface, QEvent.Type.TouchBegin, (7, pressed, 0.0, 0.0))
    touch(surface, QEvent.Type.TouchUpdate, (7, moved, 1.5, 0.0), (9, pressed, 4.5, 3.0))
    wait(qtbot, lambda: sounds_at(tab, "finger 1", 1.5, 0.0) and sounds_at(tab, "finger 2", 4.5, 3.0))
    touch(surface, QEvent.Type.TouchUpdate, (7, released, 1.5, 0.0), (9, moved, 3.0, 3.0))
    wait(qtbot, lambda: not sounds(tab, "finger 1") and sounds_at(tab, "finger 2", 3.0, 3.0))
    touch(surface, QEvent.Type.TouchCancel)
    assert run.places == {}

    qtbot.keyClick(surface, Qt.Key.Key_Space)
    from_mm = run.places[KEYS]
    qtbot.keyPress(surface, Qt.Key.Key_Left)
    wait(qtbot, lambda: run.places[KEYS][0] < from_mm[0] - SHORT_MM)
    qtbot.keyRelease(surface, Qt.Key.Key_Left)
    wait(qtbot, lambda: sounds_at(tab, KEYS, *run.places[KEYS]))
    qtbot.keyClick(surface, Qt.Key.Key_Space)
    wait(qtbot, lambda: not sounds(tab, KEYS))

    assert re.search(r"latency: [\d.]+ ms", shown(tab))
    press(qtbot, tab.live_panel.buttons["stop"])
    wait(qtbot, lambda: run.state == IDLE)
    assert "muted" in window.messages.sentence
    (scene,) = tmp_path.glob("live-*/scene.toml")
    assert scene.read_text(encoding="utf-8").count("[[source]]") >= 4  # late positions begin another


def test_source_that_sounds_then_leaving_page_or_closing_window_ends_session(qtbot, open_window, finished):
    window = open_window()
    tab = live_page(qtbot, window, finished)
    scene = line_scene()
    independent = changed(scene.regularisation, independent=True)
    edit(tab.document, changed(scene, regularisation=independent))
    started(qtbot, tab)
    assert tab.live_run.ready is not None
    assert tab.live_run.ready.independent
    tab.modes[DRAW].click()
    wait(qtbot, lambda: tab.live_run.state == IDLE)
    tab.modes[LIVE_PAGE].click()
    started(qtbot, tab)
    surface, pid = tab.live_surface, tab.live_run.own.pid
    mouse(surface, QEvent.Type.MouseButtonPress, pixel(surface, 1.5, 1.5), NO_KEY, held=True)
    wait(qtbot, lambda: sounds(tab, MOUSE))
    window.close_at_once()
    assert pid is not None
    _, status = os.waitpid(pid, 0)  # the window does not wait for it; it ends by itself, muted
    assert os.waitstatus_to_exitcode(status) == 0


def test_given_a_rig_of_other_actuators_then_one_sentence_says_so_and_nothing_sounds(qtbot, shared_window, finished):
    window = shared_window
    tab = live_page(qtbot, window, finished, VIRTUAL)  # it has 20 actuators, the bank three
    press(qtbot, tab.live_panel.buttons["start"])
    wait(qtbot, lambda: tab.live_run.state == IDLE)
    assert str(finished) in window.messages.sentence
    assert not tab.live_run.busy


def test_figures_then_latency_underruns_limiter_and_what_is_left_out_are_marked():
    ready = LiveReady("player", "bank", 3, 5.0, 50.0, 215.0, 12.0, (0.0, 4.5), (0.0, 3.0))
    good = LiveState(2.0, 6.0, 9.0, 0.4, 0, "none", None, (), 0.0, ())
    late = LiveState(2.0, 30.0, 25.0, 1.3, 2, "sources", None, ("finger 2",), -3.0, ())
    assert not any(wrong for _, wrong in figures_of(ready, good))
    assert [words for words, wrong in figures_of(ready, late) if wrong] == [
        "latency: 25.0 ms", "underruns: 2", "left out: source finger 2", "limiter: -3.0 dB",
    ]  # fmt: skip
    assert ("pointer to sound: 87 ms", False) in figures_of(ready, late)
    assert figures_of(None, None) == []
