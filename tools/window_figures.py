"""Figures of the window with all its tabs: how soon it is up, what it costs a core, what it keeps.

Run it with: make window-figures. Nothing else should be busy on the machine meanwhile; processor times tell something
even then.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from gui.shell.window import Window

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")

POSITIONS, ACTUATORS, TAPS = 1500, 20, 1000
SCENE = """
[[source]]
path = { kind = "circle", centre_mm = [98.0, 58.0], radius_mm = 40.0 }
speed_mm_s = 250.0
step_mm = 2.0
signal = { kind = "sine", frequency_hz = 150.0, duration_s = 1.0 }
"""
_PATIENCE_S = 300.0
UP_CODE = """
import sys, time
from wavefocus.commands.gui import front_door
from gui.shell.application import make_application
from gui.shell.settings import Settings
from gui.shell.window import Window
from PyQt5.QtCore import QSettings
from pathlib import Path
application = make_application()
window = Window(front_door(), Settings(QSettings(sys.argv[2], QSettings.Format.IniFormat)))
window.open_file(Path(sys.argv[1]))
window.show()
application.processEvents()
print(time.time(), time.process_time(), flush=True)
window.close_at_once()
"""

FOLLOW_CODE = (
    UP_CODE.partition("print(")[0]
    + """
from PyQt5.QtCore import QTimer
def live(duration_s):
    QTimer.singleShot(int(1000 * duration_s), application.quit)
    application.exec_()
live(4)
began_s = time.process_time()
live(20)
print((time.process_time() - began_s) / 20)
window.close_at_once()
"""
)


def main() -> None:
    """Measure, and print a table."""
    arguments = argparse.ArgumentParser(description=__doc__)
    arguments.add_argument("--seconds", type=float, default=20.0, help="how long to draw at 20 Hz")
    seconds = arguments.parse_args().seconds
    with tempfile.TemporaryDirectory() as folder:
        bank = make_bank(Path(folder) / "plate.h5")
        rows = [
            *up(bank),
            *drawing(bank, seconds),
            slowed(Path(folder)),
        ]
    for what, figure, allowed in rows:
        print(f"{what:<62} {figure:>10}   allowed: {allowed}")


def make_bank(path: Path) -> Path:
    """A bank of 1500 positions, all measured."""
    from storage.bank.layout import BankHeader
    from storage.bank.ledger import PointRecord
    from storage.bank.writer import BankWriter, create_bank

    x_mm, y_mm = np.meshgrid(4.0 * np.arange(50), 4.0 * np.arange(POSITIONS // 50))
    angle = 2 * np.pi * np.arange(ACTUATORS) / ACTUATORS
    header = BankHeader(
        sample_rate_hz=10_000.0,
        taps=TAPS,
        position_mm=np.stack([x_mm.ravel(), y_mm.ravel()], axis=1),
        actuator_mm=np.stack([98 + 130 * np.cos(angle), 58 + 90 * np.sin(angle)], axis=1),
        band_hz=(20.0, 500.0),
        rig_json="{}",
        run_json="{}",
        plan_sha256="0" * 64,
        software="window figures",
    )
    create_bank(path, header)
    chance = np.random.default_rng(1)
    with BankWriter.open(path) as writer:
        for position in range(POSITIONS):
            figures = (chance.normal(40.0, 5.0, ACTUATORS).astype(np.float32) for _ in range(4))
            green = chance.normal(size=(ACTUATORS, TAPS)).astype(np.float32)
            writer.commit(position, green, PointRecord(1, 1, *figures))
    return path


def up(bank: Path) -> list[tuple[str, str, str]]:
    """From the start of a process to its window: seconds, and seconds of a processor."""
    memory = str(bank.with_name("memory.ini"))
    wall_s, cpu_s = [], []
    for _ in range(3):
        began_s = time.time()
        command = [sys.executable, "-c", UP_CODE, str(bank), memory]
        done = subprocess.run(command, capture_output=True, text=True, check=True)
        up_s, busy_s = (float(word) for word in done.stdout.split()[-2:])
        wall_s.append(up_s - began_s)
        cpu_s.append(busy_s)
    return [
        ("window up with a bank, best of 3", f"{min(wall_s):.2f} s", "1.5 s"),
        ("processor time of that, best of 3", f"{min(cpu_s):.2f} s", "-"),
    ]


def drawing(bank: Path, seconds: float) -> list[tuple[str, str, str]]:
    """Main thread's share of a core in each tab, 20 commits a second; what eight hours of events leave in memory."""
    from PyQt5.QtCore import QSettings, QTimer

    from gui.shell.application import make_application
    from gui.shell.settings import Settings
    from gui.shell.window import Window
    from wavefocus.commands.gui import front_door

    application = make_application()
    window = Window(front_door(), Settings(QSettings(str(bank.with_name("memory.ini")), QSettings.Format.IniFormat)))
    window.resize(1280, 800)
    window.open_file(bank)
    window.show()

    def live(duration_s: float) -> None:
        QTimer.singleShot(int(1000 * duration_s), application.quit)
        application.exec_()

    def share(what: str) -> tuple[str, str, str]:
        live(2.0)
        began_s, began_cpu_s = time.monotonic(), time.thread_time()
        live(seconds)
        used = (time.thread_time() - began_cpu_s) / (time.monotonic() - began_s)
        return f"main thread of a core, 20 commits a second, {what}", f"{100 * used:.1f} %", "15 %"

    live(3.0)
    rows = [("memory of the window with a bank of 1500 positions", f"{_resident_bytes() / 1e6:.0f} MB", "-")]
    night = threading.Event()
    log = bank.with_suffix(".events.jsonl")
    writer = threading.Thread(target=_write_events, args=(log, 0.05, night), daemon=True)
    writer.start()
    rows.append(share("Campaign"))
    began_s, began_all_s = time.monotonic(), time.process_time()
    live(seconds)
    all_share = (time.process_time() - began_all_s) / (time.monotonic() - began_s)
    rows.append(("whole process of a core, the same", f"{100 * all_share:.1f} %", "-"))
    for tab in ("Rig", "Verification"):
        show_tab(window, tab)
        rows.append(share(tab))
    play_field(window, bank.with_name("scene.toml"), live)
    rows.append(share("Scene, field playing"))
    rows.append(("memory of the window with a field as well", f"{_resident_bytes() / 1e6:.0f} MB", "-"))
    show_tab(window, "Campaign")
    night.set()
    writer.join()
    before = _resident_bytes()
    began_lines = len(window.tabs[0].campaign.lines)  # type: ignore[attr-defined]
    with log.open("a", encoding="utf-8") as file:
        for number in range(8 * 3600 // 5):
            file.writelines(_position(number))
    live(12.0)
    after = _resident_bytes()
    lines = len(window.tabs[0].campaign.lines) - began_lines  # type: ignore[attr-defined]
    window.close_at_once()
    added = f"{(after - before) / 1e6:.1f} MB"
    return [*rows, (f"memory that 8 h at 5 s a position add ({lines} lines)", added, "20 MB")]


def show_tab(window: Window, title: str) -> None:
    """Show a tab as its key does."""
    from PyQt5.QtWidgets import QTabWidget

    (tab,) = (tab for tab in window.tabs if tab.title == title)
    pages = window.findChild(QTabWidget)
    assert pages is not None
    pages.setCurrentWidget(tab)


def play_field(window: Window, scene: Path, live: Callable[[float], None]) -> None:
    """Open a scene, wait for its field, and let it play."""
    from gui.scene.tab import SceneTab

    scene.write_text(SCENE, encoding="utf-8")
    window.open_file(scene)
    (tab,) = (tab for tab in window.tabs if isinstance(tab, SceneTab))
    results, began_s = tab.results, time.monotonic()
    while not results.complete:
        live(0.5)
        if time.monotonic() - began_s > _PATIENCE_S:
            raise SystemExit(f"the scene was not calculated: {results.problem.text() or results.stage.text()}")
    results.pages.setCurrentWidget(results.field)
    results.field.slider.play.setChecked(True)


def slowed(folder: Path) -> tuple[str, str, str]:
    """Processor time that a window which follows a run takes of a core at a real night's pace (5 s a position)."""
    bank = folder / "plate.h5"
    code = FOLLOW_CODE
    stop = threading.Event()
    writer = threading.Thread(target=_write_events, args=(bank.with_suffix(".events.jsonl"), 5.0, stop), daemon=True)
    writer.start()
    arguments = [sys.executable, "-c", code, str(bank), str(folder / "memory.ini")]
    done = subprocess.run(arguments, capture_output=True, text=True, check=True)
    stop.set()
    writer.join()
    share = 100 * float(done.stdout.split()[-1])
    cores = os.cpu_count() or 1
    return f"window of a core at a night's pace ({share / cores:.2f} % of {cores} cores)", f"{share:.2f} %", "-"


def _write_events(log: Path, every_s: float, over: threading.Event) -> None:
    number = 0
    with log.open("a", encoding="utf-8") as file:
        while not over.wait(every_s):
            file.writelines(_position(number))
            file.flush()
            number += 1


def _position(number: int) -> list[str]:
    position = number % POSITIONS
    at = datetime.now(UTC).isoformat(timespec="milliseconds")
    status = 4 if number % 37 == 0 else 1
    records = [
        {"event": "position_started", "position": position, "attempt": 1, "x_mm": 1.0, "y_mm": 2.0},
        {"event": "position_committed", "position": position, "status": status, "attempts": 1, "snr_db": 40.0,
         "residual_db": -60.0, "clock_ppm": 30.0, "start_offset_samples": 300.0},
        {"event": "progress", "done": position, "total": POSITIONS, "elapsed_s": 5.0 * number, "remaining_s": 3600.0,
         "wall_remaining_s": 3600.0, "positions_per_hour": 720.0},
    ]  # fmt: skip
    return [json.dumps({"at": at, "time_s": 5.0 * number, **record}) + "\n" for record in records]


def _resident_bytes() -> int:
    import gc

    gc.collect()
    for line in Path("/proc/self/status").read_text(encoding="utf-8").splitlines():
        if line.startswith("VmRSS"):
            return int(line.split()[1]) * 1024
    raise SystemExit("the memory of a process is read from /proc, which this system does not have")


if __name__ == "__main__":
    main()
