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
    from wavefocus.rendering.scene.trajectory_path import TrajectoryPath as TrajectoryPath
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

_MODULES = {
    "Bank": "wavefocus.storage.bank.reading",
    "Circle": "wavefocus.rendering.scene.paths",
    "Drive": "wavefocus.storage.drive_file",
    "Field": "wavefocus.storage.field_file",
    "FocusResults": "wavefocus.rendering.field.foci",
    "GreenArray": "wavefocus.rendering.greens.source",
    "Impulse": "wavefocus.rendering.scene.signals",
    "InputError": "wavefocus.storage.errors",
    "Line": "wavefocus.rendering.scene.paths",
    "Noise": "wavefocus.rendering.scene.signals",
    "Point": "wavefocus.rendering.scene.paths",
    "Polyline": "wavefocus.rendering.scene.paths",
    "LiveSources": "wavefocus.live_session.sources",
    "QuietPlace": "wavefocus.rendering.scene.model",
    "RawFile": "wavefocus.storage.raw.writer",
    "Scene": "wavefocus.rendering.scene.model",
    "Sine": "wavefocus.rendering.scene.signals",
    "SoundFile": "wavefocus.rendering.scene.signals",
    "Source": "wavefocus.rendering.scene.model",
    "TrajectoryPath": "wavefocus.rendering.scene.trajectory_path",
    "VirtualBench": "wavefocus.virtual",
    "add_note": "wavefocus.storage.bank.notes",
    "estimate": "wavefocus.estimation",
    "estimate_positions": "wavefocus.calibration.estimator.raw_estimation",
    "estimator": "wavefocus.calibration.estimator.raw_estimation:estimator_of",
    "export_bank": "wavefocus.banks",
    "focus_figures": "wavefocus.drives",
    "import_bank": "wavefocus.banks",
    "interpolate": "wavefocus.drives",
    "live": "wavefocus.live_session.sources",
    "load_scene": "wavefocus.rendering.scene.model",
    "open_bank": "wavefocus.storage.bank.reading",
    "open_raw": "wavefocus.storage.raw.writer",
    "predict": "wavefocus.drives",
    "quiet_levels": "wavefocus.drives",
    "read_drive": "wavefocus.storage.drive_file",
    "read_field": "wavefocus.storage.field_file",
    "render": "wavefocus.drives",
    "virtual_rig": "wavefocus.virtual",
    "write_drive": "wavefocus.storage.drive_file",
    "write_field": "wavefocus.storage.field_file",
}

__all__ = list(_MODULES)


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, own_name = _MODULES[name].partition(":")
    return getattr(import_module(module), own_name or name)


def __dir__() -> list[str]:
    return __all__
