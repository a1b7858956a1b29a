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
    from wavefocus.banks import export_bank, import_bank
    from wavefocus.calibration.estimator.raw_estimation import estimate_positions
    from wavefocus.calibration.estimator.raw_estimation import estimator_of as estimator
    from wavefocus.drives import focus_figures, predict, quiet_levels, render
    from wavefocus.estimation import estimate
    from wavefocus.live_session.sources import LiveSources, live
    from wavefocus.rendering.field.foci import FocusResults
    from wavefocus.rendering.greens.source import GreenArray
    from wavefocus.rendering.scene.model import QuietPlace, Scene, Source, load_scene
    from wavefocus.rendering.scene.paths import Circle, Line, Point, Polyline
    from wavefocus.rendering.scene.signals import Impulse, Noise, Sine, SoundFile
    from wavefocus.rendering.scene.trajectory_path import TrajectoryPath
    from wavefocus.storage.bank.notes import add_note
    from wavefocus.storage.bank.reading import Bank, open_bank
    from wavefocus.storage.drive_file import Drive, read_drive, write_drive
    from wavefocus.storage.errors import InputError
    from wavefocus.storage.field_file import Field, read_field, write_field
    from wavefocus.storage.raw.writer import RawFile, open_raw
    from wavefocus.virtual import VirtualBench, virtual_rig

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
    "QuietPlace",
    "RawFile",
    "Scene",
    "Sine",
    "SoundFile",
    "Source",
    "TrajectoryPath",
    "VirtualBench",
    "add_note",
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
    "quiet_levels",
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
