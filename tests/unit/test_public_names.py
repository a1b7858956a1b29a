"""The package's public names."""

import re
import subprocess
import sys
from graphlib import TopologicalSorter
from importlib import import_module
from importlib.resources import files
from pathlib import Path

import grimp
import pytest

import wavefocus
from tools import python_reference

ROOT = Path(__file__).parents[2]


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


def test_the_package_is_typed_and_its_reference_has_every_public_name():
    assert (files("wavefocus") / "py.typed").is_file()
    entries = python_reference.entries()
    assert not [name for name in wavefocus.__all__ if f"### `{name}`" not in entries]
    assert "- `positions`: Number P of grid positions." in entries


def test_no_module_imports_itself_round_a_circle():
    graph = grimp.build_graph("wavefocus", cache_dir=None)  # lazy and type-only imports count, too
    TopologicalSorter({module: graph.find_modules_directly_imported_by(module) for module in graph.modules}).prepare()


def test_importing_the_package_loads_nothing_but_the_standard_library():
    code = "import sys; before = set(sys.modules); import wavefocus; print(*(set(sys.modules) - before))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    loaded = {name for name in done.stdout.split() if name.partition(".")[0] not in sys.stdlib_module_names}
    assert loaded == {"wavefocus"}
