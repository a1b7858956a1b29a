"""The window on a real X server, by the command that people type."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import time
from collections.abc import Generator
from pathlib import Path

import pytest

pytestmark = pytest.mark.long

LOOK = """
import sys
from pathlib import Path
from PyQt5.QtCore import QSettings, QTimer
from PyQt5.QtWidgets import QApplication
from gui.window import make_application
from gui.files import Settings
from gui.window import Window
from wavefocus.commands.gui import front_door
application = make_application()
assert QApplication.platformName() == "xcb", QApplication.platformName()
window = Window(front_door(), Settings(QSettings(sys.argv[2], QSettings.Format.IniFormat)))
window.open_file(Path(sys.argv[1]))
window.resize(1200, 760)
window.show()
def look():
    tab = window.tabs[0]
    if tab.campaign.measured != 12:
        return
    seen = application.primaryScreen().grabWindow(0).toImage()
    assert len({seen.pixel(x, y) for x in range(0, 1200, 7) for y in range(0, 760, 7)}) > 20
    print("seen", flush=True)
    window.close()
timer = QTimer()
timer.timeout.connect(look)
timer.start(300)
sys.exit(application.exec_())
"""


@pytest.fixture
def display() -> Generator[str]:
    """An X server of the test's own."""
    reads, writes = os.pipe()
    command = ["Xvfb", "-displayfd", str(writes), "-screen", "0", "1280x800x24", "-nolisten", "tcp"]
    with subprocess.Popen(command, pass_fds=[writes], stderr=subprocess.DEVNULL) as server:
        os.close(writes)
        ready, _, _ = select.select([reads], [], [], 60)
        assert ready, "Xvfb does not start"
        number = os.read(reads, 16).decode().strip()
        yield f":{number}"
        server.terminate()
    os.close(reads)


def _environment(display: str) -> dict[str, str]:
    kept = {key: value for key, value in os.environ.items() if key not in ("QT_QPA_PLATFORM", "WAYLAND_DISPLAY")}
    return {**kept, "DISPLAY": display}


def _catches(process_id: int, number: signal.Signals) -> bool:
    """Whether a process has a handler for a signal: the window has one as soon as it is shown."""
    (mask,) = [
        line.split()[1] for line in Path(f"/proc/{process_id}/status").read_text().splitlines() if "SigCgt" in line
    ]
    return bool(int(mask, 16) >> (number - 1) & 1)


def test_given_a_real_x_server_then_the_window_is_seen_on_its_screen(
    display: str, finished: Path, tmp_path: Path
) -> None:
    command = [sys.executable, "-c", LOOK, str(finished), str(tmp_path / "memory.ini")]
    done = subprocess.run(command, env=_environment(display), capture_output=True, text=True, timeout=90, check=False)
    assert done.returncode == 0, done.stderr
    assert "seen" in done.stdout


def test_given_the_command_then_it_lives_until_it_is_ended_and_says_nothing(
    display: str, finished: Path, tmp_path: Path
) -> None:
    environment = {**_environment(display), "HOME": str(tmp_path), "XDG_CONFIG_HOME": str(tmp_path)}
    command = [sys.executable, "-m", "wavefocus", "gui", str(finished)]
    with subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True) as window:
        latest_s = time.monotonic() + 60
        while window.poll() is None and not _catches(window.pid, signal.SIGTERM):
            assert time.monotonic() < latest_s, "it is not shown"
            time.sleep(0.05)
        time.sleep(3.0)
        assert window.poll() is None
        window.send_signal(signal.SIGTERM)
        _, told = window.communicate(timeout=30)
    assert window.returncode == 0
    assert "wavefocus:" not in told
    assert "Traceback" not in told
