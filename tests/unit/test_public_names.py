"""The package's public names."""

import re
import subprocess
import sys
from graphlib import TopologicalSorter
from importlib import import_module
from importlib.resources import files
from pathlib import Path

import grimp
import h5py
import numpy as np
import pytest

import wavefocus
from tools import python_reference

ROOT = Path(__file__).parents[2]
SCENE = """
[[source]]
path = { kind = "point", at_mm = [4, 4] }
signal = { kind = "impulse" }
"""


@pytest.mark.parametrize(
    "package", ["acquisition", "calibration", "config", "drivers", "mocks", "rendering", "storage"]
)
def test_every_name_that_a_package_s_first_page_gives_is_there(package):
    rows = re.findall(r"^`([\w.]+)` +(.*)$", str(import_module(f"wavefocus.{package}").__doc__), re.MULTILINE)
    assert rows
    for module, words in rows:
        own = import_module(f"wavefocus.{package}.{module}")
        names = [name for name in re.findall(r"`(\w+)`", words.partition(";")[0]) if name[0].isupper()]
        assert all(hasattr(own, name) for name in names), (module, names)


def test_the_package_says_that_it_is_typed():
    assert (files("wavefocus") / "py.typed").is_file()


def test_the_reference_has_every_public_name():
    entries = python_reference.entries()
    assert not [name for name in wavefocus.__all__ if f"### `{name}`" not in entries]


def test_no_module_imports_itself_round_a_circle():
    graph = grimp.build_graph("wavefocus", cache_dir=None)  # lazy and type-only imports count, too
    TopologicalSorter({module: graph.find_modules_directly_imported_by(module) for module in graph.modules}).prepare()


def test_importing_the_package_loads_nothing_but_the_standard_library():
    code = "import sys; before = set(sys.modules); import wavefocus; print(*(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name for name in done.stdout.split() if name.partition(".")[0] not in sys.stdlib_module_names}
    assert loaded == {"wavefocus"}


def test_given_a_bank_and_a_scene_then_the_field_at_the_focus_has_its_amplitude(tmp_path):
    x_mm, y_mm = np.meshgrid(np.arange(3) * 4.0, np.arange(3) * 4.0)
    with h5py.File(tmp_path / "bank.h5", "w") as file:
        file["green"] = np.random.default_rng(1).standard_normal((9, 3, 40)) * np.exp(-np.arange(40) / 8)
        file["position_mm"] = np.column_stack([x_mm.ravel(), y_mm.ravel()])
        file.attrs["sample_rate_hz"] = 2000.0
    (tmp_path / "scene.toml").write_text(SCENE, encoding="utf-8")
    with wavefocus.open_bank(tmp_path / "bank.h5") as bank:
        drive = wavefocus.render(wavefocus.load_scene(str(tmp_path / "scene.toml")), bank)
        field = wavefocus.predict(drive, bank, [4])
        wavefocus.write_drive(tmp_path / "drive.h5", drive)
    assert field.field[0, round(-field.start_s * 2000)] == pytest.approx(1.0)
    assert wavefocus.read_drive(tmp_path / "drive.h5").drive_v == pytest.approx(drive.drive_v)
