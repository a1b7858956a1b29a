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
    from calibration.estimator.raw_estimation import estimate_positions
    from calibration.estimator.raw_estimation import estimator_of as estimator
    from rendering.field.foci import FocusResults
    from rendering.greens.source import GreenArray
    from rendering.scene.model import Scene, Source, load_scene
    from rendering.scene.paths import Circle, Line, Point, Polyline
    from rendering.scene.signals import Impulse, Noise, Sine, SoundFile
    from rendering.scene.trajectory_path import TrajectoryPath
    from storage.bank.reading import Bank, open_bank
    from storage.drive_file import Drive, read_drive, write_drive
    from storage.errors import InputError
    from storage.field_file import Field, read_field, write_field
    from storage.raw.writer import RawFile, open_raw
    from wavefocus.banks import estimate, export_bank, import_bank
    from wavefocus.drives import focus_figures, predict, render
    from wavefocus.live_session.sources import LiveSources, live
    from wavefocus.virtual import VirtualBench, virtual_rig

_MODULES = {
    "Bank": "storage.bank.reading",
    "Circle": "rendering.scene.paths",
    "Drive": "storage.drive_file",
    "Field": "storage.field_file",
    "FocusResults": "rendering.field.foci",
    "GreenArray": "rendering.greens.source",
    "Impulse": "rendering.scene.signals",
    "InputError": "storage.errors",
    "Line": "rendering.scene.paths",
    "Noise": "rendering.scene.signals",
    "Point": "rendering.scene.paths",
    "Polyline": "rendering.scene.paths",
    "LiveSources": "wavefocus.live_session.sources",
    "RawFile": "storage.raw.writer",
    "Scene": "rendering.scene.model",
    "Sine": "rendering.scene.signals",
    "SoundFile": "rendering.scene.signals",
    "Source": "rendering.scene.model",
    "TrajectoryPath": "rendering.scene.trajectory_path",
    "VirtualBench": "wavefocus.virtual",
    "estimate": "wavefocus.banks",
    "estimate_positions": "calibration.estimator.raw_estimation",
    "estimator": "calibration.estimator.raw_estimation:estimator_of",
    "export_bank": "wavefocus.banks",
    "focus_figures": "wavefocus.drives",
    "import_bank": "wavefocus.banks",
    "live": "wavefocus.live_session.sources",
    "load_scene": "rendering.scene.model",
    "open_bank": "storage.bank.reading",
    "open_raw": "storage.raw.writer",
    "predict": "wavefocus.drives",
    "read_drive": "storage.drive_file",
    "read_field": "storage.field_file",
    "render": "wavefocus.drives",
    "virtual_rig": "wavefocus.virtual",
    "write_drive": "storage.drive_file",
    "write_field": "storage.field_file",
}

__all__ = [
    "Bank",
    "Circle",
    "Drive",
    "Field",
    "FocusResults",
    "GreenArray",
    "Impulse",
    "InputError",
    "Line",
    "LiveSources",
    "Noise",
    "Point",
    "Polyline",
    "RawFile",
    "Scene",
    "Sine",
    "SoundFile",
    "Source",
    "TrajectoryPath",
    "VirtualBench",
    "estimate",
    "estimate_positions",
    "estimator",
    "export_bank",
    "focus_figures",
    "import_bank",
    "live",
    "load_scene",
    "open_bank",
    "open_raw",
    "predict",
    "read_drive",
    "read_field",
    "render",
    "virtual_rig",
    "write_drive",
    "write_field",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, own_name = _MODULES[name].partition(":")
    return getattr(import_module(module), own_name or name)


def __dir__() -> list[str]:
    return __all__
