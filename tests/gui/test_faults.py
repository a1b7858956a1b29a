"""What goes wrong is a sentence; the window lives, and a run is not touched."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest
from pytestqt.qtbot import QtBot

from tests.gui.conftest import Opens, campaign_of, wait

LINUX = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="about X servers and fontconfig")
WITHOUT = ("DISPLAY", "WAYLAND_DISPLAY", "QT_QPA_PLATFORM")


def gui(*, code: str = "", **environment: str) -> subprocess.CompletedProcess[str]:
    kept = {key: value for key, value in os.environ.items() if key not in WITHOUT}
    start = f"{code}\nimport sys\nfrom wavefocus.__main__ import run\nsys.exit(run(['gui']))"
    return subprocess.run(
        [sys.executable, "-c", start],
        env={**kept, **environment},
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def refused(done: subprocess.CompletedProcess[str], *words: str) -> None:
    assert done.returncode == 2, done.stderr
    lines = [line for line in done.stderr.splitlines() if line.startswith("wavefocus: ")]
    assert len(lines) == 1
    assert "Traceback" not in done.stderr
    for word in words:
        assert word in lines[0]


@LINUX
@pytest.mark.may_skip("Windows and macOS always have a display")
def test_given_no_display_or_a_dead_one_then_exit_2_and_a_sentence() -> None:
    refused(gui(), "needs a display", "DISPLAY")
    refused(gui(DISPLAY=":4711"), "no X server answers at DISPLAY=:4711")


def test_given_no_pyqt5_then_exit_2_and_the_command_that_installs_it() -> None:
    done = gui(code="import sys\nsys.modules['PyQt5'] = None", QT_QPA_PLATFORM="offscreen")
    refused(done, 'pip install "wavefocus[window]"')


def test_given_a_library_that_qt_misses_then_exit_2_and_the_packages() -> None:
    code = """
import sys
class Broken:
    def find_spec(self, name, path=None, target=None):
        if name == "PyQt5.QtCore":
            raise ImportError("libGL.so.1: cannot open shared object file: No such file or directory")
sys.meta_path.insert(0, Broken())
"""
    refused(gui(code=code, QT_QPA_PLATFORM="offscreen"), "libGL.so.1", "apt-get install", "libgl1")


@LINUX
@pytest.mark.may_skip("Windows and macOS always have fonts")
def test_given_no_font_then_exit_2_and_the_package(tmp_path: Path) -> None:
    none = tmp_path / "fonts.conf"
    none.write_text("<?xml version='1.0'?><fontconfig></fontconfig>", encoding="utf-8")
    done = gui(QT_QPA_PLATFORM="offscreen", FONTCONFIG_FILE=str(none), FONTCONFIG_PATH=str(tmp_path))
    refused(done, "no font", "fonts-dejavu-core")


def test_a_bank_deleted_under_the_window_is_told_and_followed_when_it_is_back(
    qtbot: QtBot, open_window: Opens, finished: Path
) -> None:
    window = open_window(finished)
    tab = campaign_of(window)
    wait(qtbot, lambda: tab.campaign.measured == 12)
    away = finished.rename(finished.with_name("away.h5"))
    wait(qtbot, lambda: "deleted or moved" in window.messages.sentence)
    tab.map_panel.map.show_position(3)
    wait(qtbot, lambda: "plate.h5 does not exist" in window.messages.sentence)
    away.rename(finished)
    wait(qtbot, lambda: tab.campaign.trouble[0] == "")
    tab.map_panel.map.show_position(4)
    wait(qtbot, lambda: tab.position_panel.greens is not None)


def test_given_a_file_that_is_no_bank_then_a_sentence(qtbot: QtBot, open_window: Opens, tmp_path: Path) -> None:
    (tmp_path / "no.h5").write_bytes(b"nothing of the kind" * 100)
    window = open_window(tmp_path / "no.h5")
    wait(qtbot, lambda: "no.h5" in window.messages.sentence)
    assert "Traceback" not in window.messages.sentence
