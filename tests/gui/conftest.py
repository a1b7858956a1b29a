"""Windows that are real but for the screen, and campaigns on the virtual rig in processes of their own."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable, Generator
from pathlib import Path
from typing import TypeVar

import pytest

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
# One pixel is one unit, whatever the platform thinks of its screen.
os.environ.setdefault("QT_FONT_DPI", "96")

from PyQt5.QtCore import QSettings
from PyQt5.QtWidgets import QApplication
from pytestqt.exceptions import TimeoutError
from pytestqt.qtbot import QtBot

from gui.campaign.tab import CampaignTab
from gui.files import Settings
from gui.front_door import FrontDoor
from gui.tab import Tab
from gui.window import Window, require_fonts
from wavefocus.__main__ import run
from wavefocus.commands.gui import front_door

RIG = """
[rig]
name = "three coils"

[actuators]
position_mm = [[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0]]
"""

RUN = """
rig = "rig.toml"

[grid]
positions_file = "positions.csv"

[sweep]
duration_s = 0.3

[capture]
averages = 2
decay_s = 0.1
taps = 1000
keep_raw = {raw}

[quality]
second_look = "never"

[virtual]
seed = 3
noise_v = 1e-4
"""

AnyTab = TypeVar("AnyTab", bound=Tab)
# What a busy machine may take; nothing is judged by it.
SOON_MS = 30_000


def write_lab(folder: Path, columns: int, rows: int, *, raw: bool = False) -> Path:
    """Write the files of a campaign on a grid of 1.5 mm; return the run file."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    (folder / "run.toml").write_text(RUN.format(raw=str(raw).lower()), encoding="utf-8")
    lines = "".join(f"{1.5 * column},{1.5 * row}\n" for row in range(rows) for column in range(columns))
    (folder / "positions.csv").write_text("x_mm,y_mm\n" + lines, encoding="utf-8")
    return folder / "run.toml"


@pytest.fixture(scope="session")
def measured(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a finished campaign of 4 x 3 positions whose recordings were kept; to be copied."""
    run_file = write_lab(tmp_path_factory.mktemp("measured"), 4, 3, raw=True)
    assert run(["capture", str(run_file), "--bank", str(run_file.with_name("plate.h5"))]) == 0
    return run_file.parent


@pytest.fixture
def finished(measured: Path, tmp_path: Path) -> Path:
    """The bank of a finished campaign, with all that lies beside it."""
    shutil.copytree(measured, tmp_path / "lab")
    return tmp_path / "lab" / "plate.h5"


@pytest.fixture
def long_run(tmp_path: Path) -> Path:
    """The run file of a campaign that takes longer than any order on a busy machine; no test waits for its end."""
    return write_lab(tmp_path / "lab", 50, 40)


@pytest.fixture
def memory(tmp_path: Path) -> Settings:
    """What the windows of a test remember."""
    return Settings(QSettings(str(tmp_path / "memory.ini"), QSettings.Format.IniFormat))


@pytest.fixture
def open_window(qtbot: QtBot, memory: Settings) -> Generator[Callable[..., Window]]:
    """Opens windows, and fails when anything went wrong in them that the test did not ask for."""
    opened: list[Window] = []
    require_fonts()

    def make(*files: Path, front: FrontDoor | None = None) -> Window:
        window = Window(front or front_door(), memory)
        opened.append(window)
        for path in files:
            window.open_file(path)
        window.resize(1280, 800)  # whatever the platform thinks of its screen
        window.show()
        return window

    yield make
    for window in opened:
        own = campaign_of(window).run.own
        if own is not None and own.running:  # a test that failed leaves nothing running
            own.interrupt()
        window.close_at_once()
        assert window.mishaps == []
        window.deleteLater()


def tab_of(window: Window, kind: type[AnyTab]) -> AnyTab:
    """The tab of a kind in a window."""
    (tab,) = (one for one in window.tabs if isinstance(one, kind))
    return tab


def campaign_of(window: Window) -> CampaignTab:
    return tab_of(window, CampaignTab)


def wait(qtbot: QtBot, true: Callable[[], bool], within_ms: int = SOON_MS) -> None:
    """Let the window live until something is so; else say what it showed."""
    try:
        qtbot.waitUntil(true, timeout=within_ms)
    except TimeoutError:
        windows = [widget for widget in QApplication.topLevelWidgets() if isinstance(widget, Window)]
        shown = [(campaign_of(window).progress.state.text(), window.messages.sentence) for window in windows]
        pytest.fail(f"it did not come about; the windows show {shown}")
