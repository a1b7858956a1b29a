"""What only some commands need is an extra; where it is not installed, they say so in a line."""

import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

from wavefocus.console import EXTRAS, Exit, exit_code, sentence
from wavefocus.drivers.errors import MissingPackageError

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]
# A process of its own, in which the import of some packages fails as if they were not installed.
RUN = """
import sys
for name in sys.argv[1].split(","):
    sys.modules[name] = None
from wavefocus.__main__ import run
sys.exit(run(sys.argv[2:]))
"""


def without(packages, *words, cwd):
    return subprocess.run(
        [sys.executable, "-c", RUN, packages, *words], cwd=cwd, capture_output=True, text=True, check=False
    )


def test_the_window_and_grpc_are_extras_and_tests_and_emulator_have_what_they_need():
    needed = {re.match(r"[\w-]+", one)[0] for one in PROJECT["dependencies"]}
    assert needed.isdisjoint({"PyQt5", "pyqtgraph", "grpcio"})
    assert not any("[grpc]" in one for one in PROJECT["dependencies"])
    extras = PROJECT["optional-dependencies"]
    assert set(EXTRAS.values()) <= set(extras)
    assert "wavefocus[window,remote]" in extras["test"]
    assert "wavefocus[remote]" in extras["emulate"]


@pytest.mark.parametrize(
    ("packages", "words", "extra"),
    [
        ("PyQt5,pyqtgraph", ("gui",), "window"),
        ("pyqtgraph", ("gui",), "window"),
        ("grpc", ("emulate", "rig.toml"), "emulate"),
    ],
)
def test_an_extra_that_is_not_installed_then_exit_2_and_one_line_with_the_command(
    packages, words, extra, tmp_path, monkeypatch
):
    monkeypatch.setenv("QT_QPA_PLATFORM", "offscreen")
    assert without("nothing", "init", "--rig", "emulated", ".", cwd=tmp_path).returncode == 0
    done = without(packages, *words, cwd=tmp_path)
    assert done.returncode == 2, done.stderr
    assert f"wavefocus[{extra}]" in done.stderr
    assert len(done.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("failure", "code", "said"),
    [
        (MissingPackageError("recorder", "opening", "no grpc", "pip install it"), Exit.WRONG_INPUT, "pip install it"),
        (ModuleNotFoundError("No module", name="skfem.mesh"), Exit.WRONG_INPUT, '"wavefocus[plates]"'),
        (ModuleNotFoundError("No module", name="acme"), Exit.WRONG_INPUT, 'pip install "acme"'),
        (ModuleNotFoundError("No module", name="wavefocus.nothing"), Exit.DEFECT, ""),  # a defect
    ],
)
def test_a_missing_package_is_wrong_input_and_a_missing_module_of_ours_a_defect(failure, code, said):
    assert exit_code(failure) == code
    assert said in sentence(failure)
