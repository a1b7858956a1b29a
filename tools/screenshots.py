"""Pictures of the window for the documentation, under an X server, at 1280 x 800.

Run it with: make screenshots; with ARGS=rig,trials only of some parts. A campaign on the virtual rig, with planned
faults, is measured; the pictures are of it, of a scene and a verification over its bank, of an emulated rig and of a
participant's trials.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from wavefocus.commands.init import write_templates

if TYPE_CHECKING:
    from wavefocus.gui.rig.tab import RigTab

Tab = TypeVar("Tab")
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
amplitude = 0.01
emission = "per_point"

[regularisation]
saturation = 0.5

[output]
limit_v = 1.0
"""
MIRROR_MAP = ((1.02e-3, 3e-5, 0.01), (-2e-5, 0.97e-3, -0.005), (1e-4, -5e-5, 1.0))
EMULATED_RIG = f"""
[rig]
name = "plate"

[player]
limit_v = 4.0

[emulation]
dead_actuators = [7]
output_gain_spread_db = 2.0
mirror_map = {[list(row) for row in MIRROR_MAP]}
"""
LIVE_S = 15.0
"""For how long a live source is moved before the picture of it, s."""
MARK_ERROR_MM = 0.15
"""Rms error in x and in y of the person who brings the beam onto the marks."""
_SCREEN = "-screen 0 1600x1000x24"
"""The X server's screen: pictures are taken where a person would see the faults of a real window, not offscreen."""
PARTS = ("campaign", "rig", "trials")


def main() -> None:
    """Make the files and take the pictures of each part, in processes whose home is a folder of their own."""
    out = Path(sys.argv[1] if len(sys.argv) > 1 else "docs/pictures").absolute()
    if len(sys.argv) > 3 and sys.argv[3] == "trials":
        take_trials(out, Path(sys.argv[2]))
        return
    if len(sys.argv) > 3:
        pictures = Pictures(out, Path(sys.argv[2]))
        pictures.take_rig() if sys.argv[3] == "rig" else pictures.take_campaign()
        print(f"{sys.argv[3]}: pictures in {out}")
        return
    out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as folder:
        lab, bench = Path(folder) / "lab", Path(folder) / "bench"
        write_templates(lab, "virtual")  # of these the paper's trials are taken as they are
        bench.mkdir()
        faults = "".join(f"\n[[virtual.fault_plan]]\n{fault}\n" for fault in FAULTS)
        for file, content in {
            lab / "scene.toml": SCENE, lab / "rig.toml": '[rig]\nname = "plate"\n', lab / "run.toml": RUN + faults,
            bench / "rig.toml": EMULATED_RIG,
        }.items():  # fmt: skip
            file.write_text(content, encoding="utf-8")
        for part in PARTS:
            environment = {
                **os.environ, "QT_QPA_PLATFORM": "xcb", "QT_FONT_DPI": "96", "XDG_RUNTIME_DIR": folder, "HOME": folder,
            }  # fmt: skip
            file = {"rig": bench / "rig.toml", "trials": lab / "trials.toml"}.get(part, lab / "run.toml")
            command = ["xvfb-run", "-a", "-s", _SCREEN, sys.executable, __file__, str(out), str(file), part]
            if len(sys.argv) <= 2 or part in sys.argv[2].split(","):
                subprocess.run(command, env=environment, check=True, stderr=subprocess.DEVNULL)


class Pictures:
    """A window with an open file, and the pictures that are taken of it."""

    def __init__(self, out: Path, file: Path) -> None:
        from PyQt5.QtCore import QSettings

        from wavefocus.gui.files import Settings
        from wavefocus.gui.window import Window, make_application

        self.out, self.file = out, file
        self.application = make_application()
        settings = QSettings(str(file.with_name("memory.ini")), QSettings.Format.IniFormat)
        self.window = Window(Settings(settings))
        self.window.open_file(file)
        self.window.resize(1280, 800)
        self.window.show()

    def tab(self, kind: type[Tab]) -> Tab:
        return next(tab for tab in self.window.tabs if isinstance(tab, kind))

    def until(self, true: Callable[[], object], longest_s: float = 600.0) -> None:
        """Run the window until something is true."""
        ends_s = time.monotonic() + longest_s
        while not true():
            if time.monotonic() > ends_s:
                raise SystemExit(f"the window did not get there; it shows {self.window.messages.sentence!r}")
            self.application.processEvents()
            time.sleep(0.01)

    def keep(self, name: str) -> None:
        """Save the picture ``window-NAME.png``."""
        drawn_s = time.monotonic() + 0.6
        self.until(lambda: time.monotonic() > drawn_s)
        if not self.window.grab().save(str(self.out / f"window-{name}.png")):
            raise SystemExit(f"{self.out} cannot be written")

    def take_campaign(self) -> None:
        """A campaign while it runs and when it is over, then verification and scene."""
        from wavefocus.gui.campaign.tab import CampaignTab

        tab, window = self.tab(CampaignTab), self.window
        self.until(tab.controls.actions_by_name["start"].isEnabled)
        tab.controls.actions_by_name["start"].trigger()
        self.until(lambda: tab.campaign.measured > 120)
        tab.map_panel.map.show_position(100)
        self.until(lambda: tab.position_panel.greens is not None)
        window.close()
        self.keep("closing")
        window.messages.dismiss()
        self.until(lambda: tab.run.own is None)
        self.until(lambda: tab.campaign.state().word == "finished")
        window.messages.dismiss()
        tab.map_panel.map.show_position(71)
        tab.map_panel.map.select([60, 71])
        tab.events.weight.setCurrentIndex(2)
        self.keep("campaign-light")
        tab.position_panel.setCurrentWidget(tab.position_panel.drift_plot)
        tab.map_panel.colour_by.setCurrentIndex(1)
        self.keep("drift")
        self.take_verification()
        self.take_scene()
        self.take_live()
        window.close_at_once()

    def take_verification(self) -> None:
        """A scene verified with the campaign's bank."""
        from wavefocus.gui.verification.tab import VerificationTab

        tab = self.tab(VerificationTab)
        self.window._pages.setCurrentWidget(tab)
        tab.form.take_bank(self.file.with_name("plate.h5"))
        self.until(tab.row.start.isEnabled)
        tab.row.start.trigger()
        self.until(lambda: tab.results is not None)
        self.window.messages.dismiss()
        tab.maps.time.to_mark(1)
        self.keep("verification-light")

    def take_scene(self) -> None:
        """A scene over the campaign's bank."""
        from wavefocus.gui.scene.tab import SceneTab

        tab = self.tab(SceneTab)
        self.window.open_file(self.file.with_name("scene.toml"))
        tab.document.use_bank(self.file.with_name("plate.h5"))
        self.until(lambda: tab.live.idle and tab.results.calculation.complete)
        self.window.messages.dismiss()
        self.keep("scene-light")

    def take_live(self) -> None:
        """A source that follows the mouse round a circle, over the campaign's bank."""
        from PyQt5.QtCore import QEvent, QPointF, Qt
        from PyQt5.QtGui import QMouseEvent

        from wavefocus.gui.scene.live_panel import LIVE
        from wavefocus.gui.scene.tab import LIVE as PAGE
        from wavefocus.gui.scene.tab import SceneTab

        tab, left, none = self.tab(SceneTab), Qt.MouseButton.LeftButton, Qt.MouseButton.NoButton
        surface, rig = tab.live_surface, tab.rig_field
        rig.show_path(self.file.with_name("rig.toml"))
        rig.chosen.emit(rig.path)
        tab.use_mode(PAGE)
        self.until(tab.live_panel.start.isEnabled)
        tab.live_panel.start.trigger()
        self.until(lambda: tab.live_run.state == LIVE)

        def _mouse(kind: QEvent.Type, angle: float) -> None:
            x_mm, y_mm = 55.0 * math.cos(angle), 40.0 * math.sin(angle)
            at = QPointF(surface.mapFromScene(surface.box.mapViewToScene(QPointF(x_mm, y_mm))))
            button = none if kind == QEvent.Type.MouseMove else left
            self.application.sendEvent(
                surface.viewport(), QMouseEvent(kind, at, button, left, Qt.KeyboardModifier.NoModifier)
            )

        def _round_it() -> bool:
            _mouse(QEvent.Type.MouseMove, 2.0 * (time.monotonic() - begun_s))
            return time.monotonic() > begun_s + LIVE_S

        begun_s = time.monotonic()
        _mouse(QEvent.Type.MouseButtonPress, 0.0)
        self.until(_round_it)
        if not self.window.grab().save(str(self.out / "window-live-light.png")):
            raise SystemExit(f"{self.out} cannot be written")
        _mouse(QEvent.Type.MouseButtonRelease, 0.0)
        tab.live_panel.stop.trigger()
        self.until(lambda: not tab.live_run.running)

    def take_rig(self) -> None:
        """A rig examined, operated and calibrated."""
        from wavefocus.gui.rig.tab import RigTab

        tab = self.tab(RigTab)
        page, hand = tab.examination, tab.manual_page
        self.until(page.examine.isEnabled)
        page.examine.trigger()
        self.until(lambda: page.findings and not tab.examination.command.running)
        for row, finding in enumerate(page.findings):
            page.table.setRowHidden(row, finding.instrument == "disk")  # it names the folder of this machine
        self.keep("rig-examination")
        tab.pages.setCurrentWidget(hand)
        self.until(hand.take.isEnabled)
        hand.take.trigger()
        self.until(lambda: tab.session.state == "ready" and hand.sound.sweep.isEnabled())
        tab.session.jog_to(40.0, 25.0)
        self.until(lambda: tab.session.place_mm is not None)
        hand.sound.sounds.click()
        hand.sound.listen.click()
        self.until(lambda: tab.session.levels is not None)
        hand.sound.sweep.trigger()
        self.until(lambda: tab.session.sweep is not None)
        self.keep("rig-hand")
        tab.pages.setCurrentWidget(tab.calibration_page)
        self.meet_marks(tab)
        self.keep("rig-calibration")
        self.window.close_at_once()

    def meet_marks(self, tab: RigTab) -> None:
        """Bring the beam onto every mark, as a person does who sees nearly where it is."""
        import numpy as np

        from wavefocus.calibration.mirror_map import MirrorMap
        from wavefocus.config.messages.rig_checks import AskJog

        true, rng, calibration = MirrorMap(MIRROR_MAP), np.random.default_rng(1), tab.calibration
        self.until(tab.calibration_page.start.isEnabled)
        tab.calibration_page.start.click()
        while True:
            self.until(lambda: calibration.question is not None)
            ask = calibration.question
            if not isinstance(ask, AskJog):
                return
            x_mrad, y_mrad = true.angles_mrad(*(np.array(ask.place_mm) + rng.normal(0.0, MARK_ERROR_MM, 2)))
            calibration.step(float(x_mrad) - ask.at_mrad[0], float(y_mrad) - ask.at_mrad[1])
            self.until(lambda ask=ask: calibration.question is not ask)
            calibration.answer("here")


def take_trials(out: Path, trials_file: Path) -> None:
    """The pages of a participant's trials, over the campaign's bank."""
    from PyQt5.QtCore import Qt
    from PyQt5.QtTest import QTest

    from wavefocus.gui.trials.window import TrialsWindow
    from wavefocus.gui.window import make_application

    application = make_application()
    files = ["--bank", "plate.h5", "--rig", "rig.toml", "--participant", "P01", "--out", "trials"]
    os.chdir(trials_file.parent)
    window = TrialsWindow([trials_file.name, *files, "--fast"])
    window.resize(1000, 700)

    def _until(*waited: str) -> None:
        ends_s = time.monotonic() + 600.0
        while window.waiting not in waited:
            if time.monotonic() > ends_s or not window.process.running:
                raise SystemExit(f"the trials did not get there: {window.process.failure}")
            application.processEvents()
            time.sleep(0.01)

    def _keep(name: str) -> None:
        drawn_s = time.monotonic() + 0.3
        while time.monotonic() < drawn_s:
            application.processEvents()
        window.grab().save(str(out / f"trials-{name}.png"))

    _until("go_on")
    _keep("welcome")
    asked = 0
    while asked == 0 or window.waiting != "go_on":
        QTest.keyClick(window, Qt.Key_Space if window.waiting == "go_on" else Qt.Key_Left)
        _until("go_on", "answer")
        asked += window.waiting == "answer"
        if asked == 1:
            _keep("question")
    _keep("break")
    window.close()
    while window.process.running:
        application.processEvents()
    print(f"trials: pictures in {out}")


if __name__ == "__main__":
    main()
