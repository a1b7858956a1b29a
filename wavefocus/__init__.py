"""Surface haptics by wave focusing: banks of Green's functions, scenes, drives, fields.

>>> import wavefocus
>>> bank = wavefocus.open_bank("plate.h5")
>>> drive = wavefocus.render(wavefocus.load_scene("scene.toml"), bank)
>>> field = wavefocus.predict(drive, bank, [700, 701])

Every name is imported when it is used first.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from calibration.estimator.raw_estimation import estimate_positions as estimate
    from calibration.estimator.raw_estimation import estimator_of as estimator
    from rendering.drive.rendering import render
    from rendering.field.prediction import predict
    from rendering.scene.model import load_scene
    from storage.bank.reading import open_bank
    from storage.drive_file import read_drive, write_drive
    from storage.errors import InputError
    from storage.field_file import read_field, write_field
    from storage.raw.writer import open_raw

_MODULES = {
    "InputError": "storage.errors",
    "estimate": "calibration.estimator.raw_estimation:estimate_positions",
    "estimator": "calibration.estimator.raw_estimation:estimator_of",
    "load_scene": "rendering.scene.model",
    "open_bank": "storage.bank.reading",
    "open_raw": "storage.raw.writer",
    "predict": "rendering.field.prediction",
    "read_drive": "storage.drive_file",
    "read_field": "storage.field_file",
    "render": "rendering.drive.rendering",
    "write_drive": "storage.drive_file",
    "write_field": "storage.field_file",
}

__all__ = [
    "InputError",
    "estimate",
    "estimator",
    "load_scene",
    "open_bank",
    "open_raw",
    "predict",
    "read_drive",
    "read_field",
    "render",
    "write_drive",
    "write_field",
]


def __getattr__(name: str) -> Any:
    if name not in _MODULES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module, _, function = _MODULES[name].partition(":")
    return getattr(import_module(module), function or name)
