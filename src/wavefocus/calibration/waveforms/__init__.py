"""Waveforms of an excitation: each module has a function `waveform`, and its name is the value of `sweep.waveform`.

A new waveform is a new module here and its name in `config.run.Waveform`.
"""

from __future__ import annotations

import pkgutil
from importlib import import_module
from typing import Protocol

from wavefocus.calibration import Float64Array
from wavefocus.storage.errors import InputError

WAVEFORMS = tuple(sorted(module.name for module in pkgutil.iter_modules(__path__)))


class Waveform(Protocol):
    """One base signal, any scale, without fades and silence."""

    def __call__(self, time_s: Float64Array, band_hz: tuple[float, float], duration_s: float) -> Float64Array:
        """Values at `time_s`, (samples,), from 0 on and before `duration_s`, whose energy fills `band_hz`."""


def waveform_of(name: str) -> Waveform:
    """The waveform of a name; raises InputError where there is none."""
    if name not in WAVEFORMS:
        raise InputError(f"sweep waveform is {name!r}; allowed is one of {', '.join(WAVEFORMS)}")
    found: Waveform = import_module(f"{__name__}.{name}").waveform
    return found
