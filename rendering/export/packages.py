"""Packages that only some exports need."""

from __future__ import annotations

import importlib
from types import ModuleType

from storage.errors import InputError


def needed(package: str, format_name: str) -> ModuleType:
    """Import a package of the extra ``export``.

    Raises
    ------
    InputError
        It is not installed.
    """
    try:
        return importlib.import_module(package)
    except ImportError as error:
        raise InputError(f"--to {format_name} needs the package {package} ({error}): pip install {package}") from None
