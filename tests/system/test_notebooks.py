"""The notebooks run as scripts, and draw what they explain."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.py"))


@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_every_notebook_is_in_the_table_of_its_folder(notebook):
    assert f"]({notebook.name})" in (FOLDER / "README.md").read_text(encoding="utf-8")


@pytest.mark.nightly
@pytest.mark.parametrize("notebook", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_runs_twice_without_a_warning_and_saves_its_pictures(notebook, tmp_path):
    environment = os.environ | {"FOLDER": str(tmp_path / "out"), "MPLBACKEND": "Agg", "OMP_NUM_THREADS": "1"}
    for _ in range(2):
        done = subprocess.run(
            [sys.executable, "-W", "always", str(notebook)],
            cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=110, check=False,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        assert done.stderr == ""
    pictures = re.findall(r'savefig\(folder / "(.+?)"', notebook.read_text(encoding="utf-8"))
    assert pictures
    assert all((tmp_path / "out" / name).stat().st_size > 5000 for name in pictures)
