"""Every plate in the window: a campaign is started and followed, and a scene on its bank is calculated."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from pytestqt.qtbot import QtBot

from config.scene import LineTable
from gui.scene.tab import SceneTab
from gui.window import Window
from tests.gui.conftest import campaign_of, tab_of, wait
from tests.gui.scenes import line_scene
from tests.gui.test_whole_night import turn_to

RIG = """
[surface]
kind = "rectangle"
length_mm = {length}
width_mm = {width}

[actuators]
position_mm = [[39.0, 0.0], [10.0, 24.0], [-38.0, 8.0]]
"""
RUN = """
rig = "rig.toml"

[grid]
spacing_mm = {spacing}
margin_mm = 18.0

[sweep]
duration_s = 0.3

[capture]
averages = 1
taps = 2000

[virtual]
{keys}
"""


@pytest.mark.long
@pytest.mark.parametrize(
    ("keys", "size"),
    [
        ('plate = "stadium"', (90.0, 60.0, 8.0)),
        ('plate = "thin"\nquality = 8.0', (300.0, 200.0, 20.0)),
        ('plate = "thin"\nedge = "infinite"', (300.0, 200.0, 20.0)),
        ('plate = "solid"', (90.0, 60.0, 8.0)),
    ],
    ids=["stadium", "thin", "thin, infinite", "solid"],
)
def test_given_a_plate_then_the_window_measures_it_and_calculates_a_scene(
    qtbot: QtBot,
    open_window: Callable[..., Window],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    keys: str,
    size: tuple[float, float, float],
) -> None:
    monkeypatch.setenv("WAVEFOCUS_CACHE", str(tmp_path / "cache"))
    length, width, spacing = size
    (tmp_path / "rig.toml").write_text(RIG.format(length=length, width=width), encoding="utf-8")
    (tmp_path / "run.toml").write_text(RUN.format(keys=keys, spacing=spacing), encoding="utf-8")
    window = open_window(tmp_path / "run.toml")
    tab = campaign_of(window)
    tab.controls.actions_by_name["start"].trigger()
    wait(qtbot, lambda: tab.progress.state.text() == "finished")
    assert tab.campaign.surface is not None
    assert tab.campaign.measured == tab.campaign.surface.positions
    scene = tab_of(window, SceneTab)
    turn_to(qtbot, window, "Scene")
    scene.document.use_bank(tmp_path / "plate.h5")
    draft = line_scene(step_mm=4.0, interpolation="kernel")
    path = LineTable(start_mm=(-15.0, 1.0), end_mm=(16.0, -3.0))
    source = draft.source[0].model_copy(update={"path": path})
    scene.document.edit("draw", draft.model_copy(update={"source": (source,)}))
    wait(qtbot, lambda: scene.results.complete or bool(scene.results.problem.text()))
    assert scene.results.problem.text() == ""
    assert scene.results.complete
