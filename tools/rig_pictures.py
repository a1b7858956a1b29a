"""Pictures of the Rig tab for the documentation; `make screenshots` runs it after those of the other tabs."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gui.rig.tab import RigTab

MAP = ((1.02e-3, 3e-5, 0.01), (-2e-5, 0.97e-3, -0.005), (1e-4, -5e-5, 1.0))
RIG = f"""
[rig]
name = "plate"

[player]
limit_v = 4.0

[emulation]
dead_actuators = [7]
output_gain_spread_db = 2.0
mirror_map = {[list(row) for row in MAP]}
"""
SIZE = (1280, 800)
# By how much the person who brings the beam onto the marks errs, rms in x and in y.
ERRS_MM = 0.15
SOON_S = 120.0


def main() -> None:
    """Take the pictures in a process whose home is a folder of its own: whose machine it is, is nobody's business."""
    out = (Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs/pictures")).absolute()
    if len(sys.argv) > 2:
        take(out, Path(sys.argv[2]))
        return
    with tempfile.TemporaryDirectory() as folder:
        lab = Path(folder) / "lab"
        lab.mkdir()
        (lab / "rig.toml").write_text(RIG, encoding="utf-8")
        environment = {
            **os.environ, "QT_QPA_PLATFORM": "offscreen", "QT_FONT_DPI": "96", "XDG_RUNTIME_DIR": folder,
            "HOME": folder,
        }  # fmt: skip
        command = [sys.executable, __file__, str(out), str(lab / "rig.toml")]
        subprocess.run(command, env=environment, check=True, stderr=subprocess.DEVNULL)


def take(out: Path, rig: Path) -> None:
    """Examine, operate and calibrate, and keep a picture of each."""
    from PyQt5.QtCore import QSettings

    from gui.rig.tab import RigTab
    from gui.shell.application import make_application
    from gui.shell.settings import Settings
    from gui.shell.window import Window
    from wavefocus.commands.gui import front_door

    application = make_application()
    memory = Settings(QSettings(str(rig.with_name("memory.ini")), QSettings.Format.IniFormat))
    window = Window(front_door(), memory)
    window.resize(*SIZE)
    window.open_file(rig)
    window.show()
    tab = next(one for one in window.tabs if isinstance(one, RigTab))

    def until(true: Callable[[], object]) -> None:
        ends_s = time.monotonic() + SOON_S
        while not true():
            if time.monotonic() > ends_s:
                raise SystemExit(f"the window does not get there; it says {window.messages.sentence!r}")
            application.processEvents()
            time.sleep(0.01)

    def keep(name: str, theme: str) -> None:
        window.choose_theme(theme)
        shown_s = time.monotonic() + 0.6
        until(lambda: time.monotonic() > shown_s)
        if not window.grab().save(str(out / f"window-rig-{name}.png")):
            raise SystemExit(f"{out} cannot be written")

    window.choose_theme("light")
    page, hand = tab.examination, tab.manual_page
    until(page.examine.isEnabled)
    page.examine.click()
    until(lambda: page.findings and not tab.examination.running)
    page.table.setRowHidden(page.table.rowCount() - 1, True)  # the disk: it names the folder of this machine
    keep("examination", "light")
    tab.pages.setCurrentWidget(hand)
    until(hand.take.isEnabled)
    hand.take.click()
    until(lambda: tab.session.state == "ready" and hand.sound.sweep.isEnabled())
    tab.session.jog_to(40.0, 25.0)
    until(lambda: tab.session.spot.place_mm is not None)
    hand.sound.sounds.click()
    hand.sound.listen.click()
    until(lambda: tab.session.levels is not None)
    hand.sound.sweep.click()
    until(lambda: tab.session.sweep is not None)
    keep("hand", "dark")
    tab.pages.setCurrentWidget(tab.calibration_page)
    window.choose_theme("light")
    _meet_marks(tab, until)
    keep("calibration", "light")
    window.close_at_once()
    print(f"rig: pictures in {out}")


def _meet_marks(tab: RigTab, until: Callable[[Callable[[], object]], None]) -> None:
    """Bring the beam onto every mark, as a person does who sees nearly where it is."""
    import numpy as np

    from calibration.rig.mirror_map import MirrorMap

    true, rng, calibration = MirrorMap(MAP), np.random.default_rng(1), tab.calibration
    until(tab.calibration_page.options.start.isEnabled)
    tab.calibration_page.options.start.click()
    while True:
        until(lambda: calibration.question is not None)
        ask = calibration.question
        place, at = (None, None) if ask is None else (ask.pair("place_mm"), ask.pair("at_mrad"))
        if ask is None or ask.kind != "jog" or place is None or at is None:
            return
        x_mrad, y_mrad = true.angles_mrad(*(np.array(place) + rng.normal(0.0, ERRS_MM, 2)))
        calibration.step(float(x_mrad) - at[0], float(y_mrad) - at[1])
        until(lambda ask=ask: calibration.question is not ask)
        calibration.answer("here")


if __name__ == "__main__":
    main()
