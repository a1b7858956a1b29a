"""Figures of the window with all its tabs: time to start, processor time, memory.

Run it with: make window-figures, on an idle machine; processor times mean something on a busy one, too.
"""

from __future__ import annotations

import argparse
import gc
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.benchmarks.harness import Entry, Mark, table
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.ledger import PointRecord
from wavefocus.storage.bank.writer import BankWriter, create_bank

if TYPE_CHECKING:
    from wavefocus.gui.window import Window

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

POSITIONS, ACTUATORS, TAPS = 1500, 20, 1000
WORK = f"the window with a bank of {POSITIONS} positions"
SCENE = """
[[source]]
path = { kind = "circle", centre_mm = [98.0, 58.0], radius_mm = 40.0 }
speed_mm_s = 250.0
step_mm = 2.0
signal = { kind = "sine", frequency_hz = 150.0, duration_s = 1.0 }
"""
PATIENCE_S = 300.0
NIGHT_PACE_S = 5.0


def main() -> None:
    """Measure, and print a table."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seconds", type=float, default=20.0, help="how long to draw at 20 Hz")
    arguments.add_argument("--child", nargs=2, metavar=("BANK", "SECONDS"), help=argparse.SUPPRESS)
    asked = arguments.parse_args()
    if asked.child:
        start_and_follow(Path(asked.child[0]), float(asked.child[1]))
        return
    with tempfile.TemporaryDirectory() as folder:
        bank = make_bank(Path(folder) / "plate.h5")
        points = [*up(bank), *drawing(bank, asked.seconds), followed(bank, asked.seconds)]
    print("\n".join(table(points)))


def make_bank(path: Path) -> Path:
    """A bank of 1500 positions, all measured."""
    x_mm, y_mm = np.meshgrid(4.0 * np.arange(50), 4.0 * np.arange(POSITIONS // 50))
    angle = 2 * np.pi * np.arange(ACTUATORS) / ACTUATORS
    position_mm = np.stack([x_mm.ravel(), y_mm.ravel()], axis=1)
    actuator_mm = np.stack([98 + 130 * np.cos(angle), 58 + 90 * np.sin(angle)], axis=1)
    create_bank(
        path, BankHeader(1e4, TAPS, (20.0, 500.0), position_mm, actuator_mm, "{}", "{}", "0" * 64, "window figures")
    )
    rng = np.random.default_rng(1)
    with BankWriter.open(path) as writer:
        for position in range(POSITIONS):
            figures = (rng.normal(40.0, 5.0, ACTUATORS).astype(np.float32) for _ in range(4))
            green = rng.normal(size=(ACTUATORS, TAPS)).astype(np.float32)
            writer.commit(position, green, PointRecord(1, 1, *figures))
    return path


class OpenWindow:
    """A window with a bank, and the event loop that it lives in."""

    def __init__(self, bank: Path) -> None:
        from PyQt5.QtCore import QSettings

        from wavefocus.gui.files import Settings
        from wavefocus.gui.window import Window, make_application

        self.application = make_application()
        settings = QSettings(str(bank.with_name("memory.ini")), QSettings.Format.IniFormat)
        self.window: Window = Window(Settings(settings))
        self.window.resize(1280, 800)
        self.window.open_file(bank)
        self.window.show()
        self.application.processEvents()

    def live(self, duration_s: float) -> None:
        """Run the event loop."""
        from PyQt5.QtCore import QTimer

        QTimer.singleShot(int(1000 * duration_s), self.application.quit)
        self.application.exec_()

    def share(self, seconds: float, *, main_thread: bool = True) -> float:
        """Share of a core that the main thread, or the whole process, uses, in percent."""
        clock = time.thread_time if main_thread else time.process_time
        self.live(2.0)
        began_s, began_cpu_s = time.monotonic(), clock()
        self.live(seconds)
        return 100 * (clock() - began_cpu_s) / (time.monotonic() - began_s)

    def show_tab(self, title: str) -> None:
        """Show a tab as its key does."""
        from PyQt5.QtWidgets import QTabWidget

        (tab,) = (tab for tab in self.window.tabs if tab.title == title)
        pages = self.window.findChild(QTabWidget)
        assert pages is not None
        pages.setCurrentWidget(tab)

    def play_field(self, scene: Path) -> None:
        """Open a scene, wait for its field, and let it play."""
        from wavefocus.gui.scene.tab import SceneTab

        scene.write_text(SCENE, encoding="utf-8")
        self.window.open_file(scene)
        (tab,) = (tab for tab in self.window.tabs if isinstance(tab, SceneTab))
        results, began_s = tab.results, time.monotonic()
        while not results.complete:
            self.live(0.5)
            if time.monotonic() - began_s > PATIENCE_S:
                raise SystemExit(f"the scene was not calculated: {results.problem.text() or results.stage.text()}")
        results.pages.setCurrentWidget(results.field)
        results.field.slider.play.setChecked(True)


def start_and_follow(bank: Path, seconds: float) -> None:
    """Print the time when the window is up, its processor seconds, and its share of a core from then on."""
    opened = OpenWindow(bank)
    print(time.time(), time.process_time(), opened.share(seconds, main_thread=False) if seconds else 0.0)
    opened.window.close_at_once()


def child(bank: Path, seconds: float) -> list[float]:
    """What such a window prints in a process of its own."""
    command = [sys.executable, "-m", "tools.window_figures", "--child", str(bank), str(seconds)]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    return [float(word) for word in done.stdout.split()]


def up(bank: Path) -> list[Entry]:
    """From the start of a process to its window."""
    wall_s, cpu_s = [], []
    for _ in range(3):
        began_s = time.time()
        up_s, busy_s, _ = child(bank, 0.0)
        wall_s.append(up_s - began_s)
        cpu_s.append(busy_s)
    figures = {"start_s": min(wall_s), "processor_s": min(cpu_s)}
    return [
        Entry(work=WORK, method="window up, best of 3", figures=figures, marks=(Mark("start_s", 1.5, at_most=True),))
    ]


def followed(bank: Path, seconds: float) -> Entry:
    """A window that follows a run at a real campaign's pace."""
    with events(bank, NIGHT_PACE_S):
        share = child(bank, seconds)[2]
    return Entry(
        work=WORK, method=f"follows a run, {NIGHT_PACE_S:g} s a position", figures={"process_%_of_core": share}
    )


def drawing(bank: Path, seconds: float) -> list[Entry]:
    """Shares of a core in each tab, 20 commits a second; memory before and after eight hours of events."""

    def busy(method: str, share: float) -> Entry:
        mark = Mark("main_thread_%_of_core", 15.0, at_most=True)
        return Entry(work=WORK, method=method, figures={mark.figure: share}, peak_mb=resident_mb(), marks=(mark,))

    opened = OpenWindow(bank)
    opened.live(3.0)
    points = [Entry(work=WORK, method="at rest", peak_mb=resident_mb())]
    with events(bank, 0.05):
        points.append(busy("20 commits a second, Campaign", opened.share(seconds)))
        whole = {"process_%_of_core": opened.share(seconds, main_thread=False)}
        points.append(Entry(work=WORK, method="the same, whole process", figures=whole))
        for title in ("Rig", "Verification"):
            opened.show_tab(title)
            points.append(busy(f"20 commits a second, {title}", opened.share(seconds)))
        opened.play_field(bank.with_name("scene.toml"))
        points.append(busy("20 commits a second, Scene, field playing", opened.share(seconds)))
        opened.show_tab("Campaign")
    campaign = opened.window.tabs[0].campaign  # type: ignore[attr-defined]
    before_mb, before_lines = resident_mb(), len(campaign.lines)
    with bank.with_suffix(".events.jsonl").open("a", encoding="utf-8") as file:
        for number in range(round(8 * 3600 / NIGHT_PACE_S)):
            file.writelines(event_lines(number))
    opened.live(12.0)
    figures = {"lines": len(campaign.lines) - before_lines, "added_mb": resident_mb() - before_mb}
    opened.window.close_at_once()
    mark = Mark("added_mb", 20.0, at_most=True)
    return [*points, Entry(work=WORK, method="eight hours of events", figures=figures, marks=(mark,))]


@contextmanager
def events(bank: Path, every_s: float) -> Iterator[None]:
    """Append the events of a position to the bank's log every so many seconds."""
    over = threading.Event()

    def write() -> None:
        with bank.with_suffix(".events.jsonl").open("a", encoding="utf-8") as file:
            for number in range(10**9):
                if over.wait(every_s):
                    return
                file.writelines(event_lines(number))
                file.flush()

    thread = threading.Thread(target=write, daemon=True)
    thread.start()
    yield
    over.set()
    thread.join()


def event_lines(number: int) -> list[str]:
    """Events of one position, as in the log of a run."""
    position = number % POSITIONS
    at = datetime.now(UTC).isoformat(timespec="milliseconds")
    records = [
        {"event": "position_started", "position": position, "attempt": 1, "x_mm": 1.0, "y_mm": 2.0},
        {"event": "position_committed", "position": position, "status": 4 if number % 37 == 0 else 1, "attempts": 1,
         "snr_db": 40.0, "residual_db": -60.0, "clock_ppm": 30.0, "start_offset_samples": 300.0},
        {"event": "progress", "done": position, "total": POSITIONS, "elapsed_s": 5.0 * number, "remaining_s": 3600.0,
         "wall_remaining_s": 3600.0, "positions_per_hour": 720.0},
    ]  # fmt: skip
    return [json.dumps({"at": at, "time_s": 5.0 * number, **record}) + "\n" for record in records]


def resident_mb() -> float:
    """Memory of this process."""
    gc.collect()
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) * 1024 / 1e6
    raise SystemExit("the memory of a process is read from /proc, which this system does not have")


if __name__ == "__main__":
    main()
