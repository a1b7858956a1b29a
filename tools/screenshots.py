"""Pictures of the window for the documentation: light and dark, at 1280 x 800 and at 200 %.

Run it with: make screenshots. A campaign on the virtual rig, with faults on order, is measured first; the pictures are
of that campaign while it runs and when it is over.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from gui.shell.window import Window

RUN = """
rig = "rig.toml"

[grid]
spacing_mm = 8.0

[sweep]
duration_s = 0.3

[capture]
averages = 2
decay_s = 0.15
taps = 1000
keep_raw = true

[drift]
every_positions = 25

[virtual]
seed = 3
"""
FAULTS = (
    'role = "recorder"\noperation = "read"\nkind = "dropout"\nposition = 60\ncount = 9',
    'role = "recorder"\noperation = "read"\nkind = "dropout"\nposition = 71\ncount = 9',
    'role = "recorder"\noperation = "read"\nkind = "over_range"\nposition = 130\ncount = 9',
    'role = "recorder"\noperation = "read"\nkind = "unplugged"\nposition = 90\ntries = 2',
    'role = "player"\noperation = "wait"\nkind = "underflow"\nposition = 20',
)
SCENE = """
[scene]
name = "arc"

[[source]]
speed_mm_s = 300.0
step_mm = 8.0
path = { kind = "circle", centre_mm = [0, 0], radius_mm = 32, turns = 0.75, start_deg = 0 }
signal = { kind = "noise", band_hz = [50, 300], duration_s = 0.015, seed = 1 }
emission = "per_point"

[regularisation]
saturation = 0.5

[output]
limit_v = 1.0
"""
SIZE = (1280, 800)
# Name of the picture, theme, what the map is coloured by, page of the details, how Green's functions are shown.
OVER = (
    ("campaign-light", "light", 0, 0, 0),
    ("campaign-dark", "dark", 1, 0, 1),
    ("spectrum", "light", 2, 1, 0),
    ("quality", "light", 4, 2, 0),
    ("recordings", "dark", 0, 3, 0),
    ("drift", "light", 5, 4, 0),
)
Look = tuple[str, str]


def main() -> None:
    """Take the pictures; the scaling of a process is fixed at its start, so each has one of its own."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path("docs/pictures")
    if len(sys.argv) > 3:
        take(out, Path(sys.argv[2]), sys.argv[3])
        return
    with tempfile.TemporaryDirectory() as folder:
        run_file = _lab(Path(folder) / "lab")
        out.mkdir(parents=True, exist_ok=True)
        for what, scale in (("running", "1"), ("over", "1"), ("scaled", "2")):
            environment = {
                **os.environ, "QT_QPA_PLATFORM": "offscreen", "QT_FONT_DPI": "96", "QT_SCALE_FACTOR": scale,
                "QT_SCALE_FACTOR_ROUNDING_POLICY": "Round", "XDG_RUNTIME_DIR": folder,
                "HOME": folder,  # whose machine it is, is nobody's business
            }  # fmt: skip
            command = [sys.executable, __file__, str(out), str(run_file), what]
            subprocess.run(command, env=environment, check=True, stderr=subprocess.DEVNULL)


def take(out: Path, run_file: Path, what: str) -> None:
    """Take the pictures of one scaling."""
    from PyQt5.QtCore import QSettings

    from gui.campaign.tab import CampaignTab
    from gui.shell.application import make_application
    from gui.shell.settings import Settings
    from gui.shell.window import Window
    from wavefocus.commands.gui import front_door

    application = make_application()
    settings = QSettings(str(run_file.with_name("memory.ini")), QSettings.Format.IniFormat)
    window = Window(front_door(), Settings(settings))
    tab = window.tabs[0]
    assert isinstance(tab, CampaignTab)
    bank = run_file.with_name("plate.h5")
    window.open_file(run_file)
    window.choose_theme("light")
    window.resize(*SIZE)
    window.show()

    def until(true: object, longest_s: float = 600.0) -> None:
        ends_s = time.monotonic() + longest_s
        while time.monotonic() < ends_s and not (callable(true) and true()):
            application.processEvents()
            time.sleep(0.01)

    def keep(name: str) -> None:
        until(None, 0.6)
        if not window.grab().save(str(out / f"window-{name}.png")):
            raise SystemExit(f"{out} cannot be written")

    if what == "running":
        until(tab.controls.buttons["start"].isEnabled)
        tab.controls.buttons["start"].click()
        until(lambda: tab.campaign.measured > 120)
        tab.map_panel.map.show_position(100)
        until(lambda: tab.position_panel.greens is not None)
        keep("running")
        tab.run.closing_question()
        window.close()
        keep("closing")
        window.messages.dismiss()
        until(lambda: tab.run.own is None)
    until(lambda: tab.campaign.state().word == "finished")
    window.messages.dismiss()
    tab.map_panel.map.show_position(71 if what == "over" else 100)
    tab.map_panel.map.select([60, 71])
    tab.events.weight.setCurrentIndex(2)
    pictures = OVER if what == "over" else [("scaled-200", "dark", 1, 0, 0)] if what == "scaled" else []
    for name, theme, colour, page, view in pictures:
        window.choose_theme(theme)
        tab.map_panel.colour_by.setCurrentIndex(colour)
        tab.position_panel.setCurrentIndex(page)
        tab.position_panel.view.setCurrentIndex(view)
        keep(name)
    # Theme, and the end of the name.
    looks = {"over": (("light", "light"), ("dark", "dark")), "scaled": (("light", "scaled-200"),)}.get(what, ())
    if looks:
        verify(window, run_file, until, keep, looks)
        draw(window, run_file, until, keep, looks)
    window.close_at_once()
    print(f"{what}: {bank.name}, pictures in {out}")


def verify(
    window: Window, run_file: Path, until: Callable[..., None], keep: Callable[[str], None], looks: Sequence[Look]
) -> None:
    """Verify a scene with the campaign's bank, and keep pictures of what was found."""
    from gui.verification.tab import VerificationTab

    tab = next(one for one in window.tabs if isinstance(one, VerificationTab))
    window._pages.setCurrentWidget(tab)
    tab.form.take_bank(run_file.with_name("plate.h5"))
    until(tab.row.start.isEnabled)
    tab.row.start.trigger()
    until(lambda: tab.results is not None)
    window.messages.dismiss()
    for shown, (theme, name) in enumerate(looks):
        window.choose_theme(theme)
        tab.maps.third.setCurrentIndex(shown)
        tab.maps.time.to_mark(1)
        keep(f"verification-{name}")


def draw(
    window: Window, run_file: Path, until: Callable[..., None], keep: Callable[[str], None], looks: Sequence[Look]
) -> None:
    """Open a scene over the campaign's bank, and keep pictures of it."""
    from gui.scene.tab import SceneTab

    tab = next(one for one in window.tabs if isinstance(one, SceneTab))
    window.open_file(run_file.with_name("scene.toml"))
    tab.document.use_bank(run_file.with_name("plate.h5"))
    until(lambda: tab.live.idle and tab.results.complete)
    window.messages.dismiss()
    for theme, name in looks:
        window.choose_theme(theme)
        keep(f"scene-{name}")


def _lab(folder: Path) -> Path:
    folder.mkdir()
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    (folder / "rig.toml").write_text('[rig]\nname = "plate"\n', encoding="utf-8")
    faults = "".join(f"\n[[virtual.fault_plan]]\n{fault}\n" for fault in FAULTS)
    (folder / "run.toml").write_text(RUN + faults, encoding="utf-8")
    return folder / "run.toml"


if __name__ == "__main__":
    main()
