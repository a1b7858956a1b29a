"""Surface haptics by wave focusing: banks of Green's functions, scenes, drives, fields.

>>> import wavefocus as wf
>>> bank = wf.open_bank("plate.h5")
>>> drive = wf.render("scene.toml", bank)
>>> field = wf.predict(drive, bank, [3, 4])

Every name is imported when it is used first; docs/reference/python.md lists all.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from wavefocus.banks import export_bank as export_bank
    from wavefocus.banks import import_bank as import_bank
    from wavefocus.calibration.estimator.raw_estimation import estimate_positions as estimate_positions
    from wavefocus.calibration.estimator.raw_estimation import estimator_of
    from wavefocus.drives import focus_figures as focus_figures
    from wavefocus.drives import interpolate as interpolate
    from wavefocus.drives import predict as predict
    from wavefocus.drives import quiet_levels as quiet_levels
    from wavefocus.drives import render as render
    from wavefocus.estimation import estimate as estimate
    from wavefocus.live_session.sources import LiveSources as LiveSources
    from wavefocus.live_session.sources import live as live
    from wavefocus.rendering.field.foci import FocusResults as FocusResults
    from wavefocus.rendering.greens.source import GreenArray as GreenArray
    from wavefocus.rendering.scene.model import QuietPlace as QuietPlace
    from wavefocus.rendering.scene.model import Scene as Scene
    from wavefocus.rendering.scene.model import Source as Source
    from wavefocus.rendering.scene.model import load_scene as load_scene
    from wavefocus.rendering.scene.paths import Circle as Circle
    from wavefocus.rendering.scene.paths import Line as Line
    from wavefocus.rendering.scene.paths import Point as Point
    from wavefocus.rendering.scene.paths import Polyline as Polyline
    from wavefocus.rendering.scene.signals import Impulse as Impulse
    from wavefocus.rendering.scene.signals import Noise as Noise
    from wavefocus.rendering.scene.signals import Sine as Sine
    from wavefocus.rendering.scene.signals import SoundFile as SoundFile
    from wavefocus.rendering.scene.trajectory import TrajectoryPath as TrajectoryPath
    from wavefocus.storage.bank.notes import add_note as add_note
    from wavefocus.storage.bank.reading import Bank as Bank
    from wavefocus.storage.bank.reading import open_bank as open_bank
    from wavefocus.storage.drive_file import Drive as Drive
    from wavefocus.storage.drive_file import read_drive as read_drive
    from wavefocus.storage.drive_file import write_drive as write_drive
    from wavefocus.storage.errors import InputError as InputError
    from wavefocus.storage.field_file import Field as Field
    from wavefocus.storage.field_file import read_field as read_field
    from wavefocus.storage.field_file import write_field as write_field
    from wavefocus.storage.raw.writer import RawFile as RawFile
    from wavefocus.storage.raw.writer import open_raw as open_raw
    from wavefocus.virtual import VirtualBench as VirtualBench
    from wavefocus.virtual import virtual_rig as virtual_rig

    estimator = estimator_of

_NAMES = {
    "banks": "export_bank import_bank",
    "calibration.estimator.raw_estimation": "estimate_positions estimator",
    "drives": "focus_figures interpolate predict quiet_levels render",
    "estimation": "estimate",
    "live_session.sources": "LiveSources live",
    "rendering.field.foci": "FocusResults",
    "rendering.greens.source": "GreenArray",
    "rendering.scene.model": "QuietPlace Scene Source load_scene",
    "rendering.scene.paths": "Circle Line Point Polyline",
    "rendering.scene.signals": "Impulse Noise Sine SoundFile",
    "rendering.scene.trajectory": "TrajectoryPath",
    "storage.bank.notes": "add_note",
    "storage.bank.reading": "Bank open_bank",
    "storage.drive_file": "Drive read_drive write_drive",
    "storage.errors": "InputError",
    "storage.field_file": "Field read_field write_field",
    "storage.raw.writer": "RawFile open_raw",
    "virtual": "VirtualBench virtual_rig",
}
_MODULE_OF = {name: f"wavefocus.{module}" for module, names in _NAMES.items() for name in names.split()}

__all__ = list(_MODULE_OF)


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    # The one whose own name says less here.
    return getattr(import_module(_MODULE_OF[name]), "estimator_of" if name == "estimator" else name)


def __dir__() -> list[str]:
    return __all__
