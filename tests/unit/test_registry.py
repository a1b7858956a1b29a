"""The registry of drivers: a module that cannot be imported harms nobody else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from wavefocus.drivers.registry import Registry

DRIVER = """
{imported}
from {package} import REGISTRY
@REGISTRY.register
class Driver:
    name = "{name}"
"""


def registry_of(folder: Path, monkeypatch: pytest.MonkeyPatch, package: str, imported: str) -> Registry[Any]:
    """A package of two drivers, one of which imports something first."""
    home = folder / package
    home.mkdir()
    home.joinpath("__init__.py").write_text(
        f'from wavefocus.drivers.registry import Registry\nREGISTRY = Registry("{package}")\n', "utf-8"
    )
    for name, words in (("acme_gs", imported), ("sound", "")):
        text = DRIVER.format(imported=words, package=package, name=name.replace("_", "-"))
        (home / f"{name}.py").write_text(text, "utf-8")
    monkeypatch.syspath_prepend(folder)
    return __import__(package).REGISTRY


def test_driver_whose_makers_package_is_missing_then_it_is_left_out_and_others_work(tmp_path, monkeypatch):
    registry = registry_of(tmp_path, monkeypatch, "drivers_without_a_package", "import package_of_acme")
    assert set(registry.all()) == {"sound"}
    assert set(registry.failures) == {"acme-gs"}
    assert "package_of_acme" in registry.failures["acme-gs"]


def test_given_a_module_of_the_program_that_is_missing_then_that_is_not_hidden(tmp_path, monkeypatch):
    registry = registry_of(tmp_path, monkeypatch, "drivers_with_a_defect", "import wavefocus.missing_module")
    with pytest.raises(ModuleNotFoundError, match=r"wavefocus\.missing_module"):
        registry.all()
