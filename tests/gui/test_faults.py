"""What goes wrong is a sentence; the window lives, and a run is not touched."""

import os
import subprocess
import sys

import pytest

from tests.gui.conftest import campaign_of, wait
from wavefocus.campaign.control import read_heartbeat
from wavefocus.gui.campaign.follower import Follower

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
@pytest.mark.may_skip("Windows and macOS always have a display and fonts")
def test_given_no_display_a_dead_one_or_no_font_then_exit_2_and_what_to_do(tmp_path):
    refused(gui(), "needs a display", "DISPLAY")
    refused(gui(DISPLAY=":4711"), "no X server answers at DISPLAY=:4711")
    none = tmp_path / "fonts.conf"
    none.write_text("<?xml version='1.0'?><fontconfig></fontconfig>", encoding="utf-8")
    done = gui(QT_QPA_PLATFORM="offscreen", FONTCONFIG_FILE=str(none), FONTCONFIG_PATH=str(tmp_path))
    refused(done, "no font", "fonts-dejavu-core")


BROKEN_QT = """
import sys
class Broken:
    def find_spec(self, name, path=None, target=None):
        if name == "PyQt5.QtCore":
            raise ImportError("libGL.so.1: cannot open shared object file: No such file or directory")
sys.meta_path.insert(0, Broken())
"""


@pytest.mark.parametrize(
    ("code", "words"),
    [
        ("import sys\nsys.modules['PyQt5'] = None", ['pip install "wavefocus[window]"']),
        (BROKEN_QT, ["libGL.so.1", "apt-get install", "libgl1"]),
    ],
)
def test_given_no_pyqt5_or_a_library_that_it_misses_then_exit_2_and_what_to_install(code, words):
    refused(gui(code=code, QT_QPA_PLATFORM="offscreen"), *words)


def test_a_bank_deleted_under_the_window_is_told_and_followed_when_it_is_back(qtbot, open_window, finished):
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


def test_given_a_file_that_is_no_bank_then_a_sentence(qtbot, open_window, tmp_path):
    (tmp_path / "no.h5").write_bytes(b"nothing of the kind" * 100)
    window = open_window(tmp_path / "no.h5")
    wait(qtbot, lambda: "no.h5" in window.messages.sentence)
    assert "Traceback" not in window.messages.sentence


def test_defect_while_bank_is_followed_then_window_says_so_and_goes_on_following(qtbot, open_window, finished):
    broken = [True]
    window = open_window()
    tab = campaign_of(window)
    tab.bank_field.show_path(finished)
    tab.follower = Follower(finished, lambda bank: 1 / 0 if broken else read_heartbeat(bank))
    wait(qtbot, lambda: "is not followed" in window.messages.sentence)
    assert [button.text() for button in window.messages.buttons] == ["Copy details"]
    broken.clear()
    wait(qtbot, lambda: tab.campaign.trouble[0] == "")
    assert window.messages.sentence == ""
