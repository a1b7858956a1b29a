"""In CI a test that skips has failed: the rule of tests/conftest.py, tried on a small suite of its own."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

RULES = Path(__file__).parents[1] / "conftest.py"
SUITE = """
import pytest

def test_skipping():
    pytest.skip("no laser here")

@pytest.mark.may_skip("another platform")
def test_allowed():
    pytest.skip("not Windows")

@pytest.mark.xfail(reason="known")
def test_expected_failure():
    raise RuntimeError

def test_passing():
    pass
"""


def outcomes(folder: Path, ci: str, suite: str) -> tuple[int, dict[str, int], str]:
    """Exit code and counts per outcome of a suite run under the rules."""
    shutil.copy(RULES, folder / "conftest.py")
    (folder / "pytest.ini").write_text("[pytest]\nmarkers = may_skip(reason): allowed\n")
    (folder / "test_suite.py").write_text(suite)
    # Of the plug-ins the rules need none but the one whose hook they fill in.
    environment = {**os.environ, "CI": ci, "PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
    command = [sys.executable, "-m", "pytest", "-p", "xdist.plugin", "-p", "no:cacheprovider", "test_suite.py"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=False)
    last = done.stdout.strip().splitlines()[-1]
    return done.returncode, {word: int(n) for n, word in re.findall(r"(\d+) (\w+)", last)}, done.stdout


def test_skip_in_ci_fails_unless_it_is_allowed_to(tmp_path: Path) -> None:
    code, counts, output = outcomes(tmp_path, "true", SUITE)
    assert code == 1
    assert (counts["failed"], counts["skipped"], counts["xfailed"], counts["passed"]) == (1, 1, 1, 1)
    assert "no laser here" in output


def test_skip_elsewhere_is_a_skip(tmp_path: Path) -> None:
    code, counts, _ = outcomes(tmp_path, "", SUITE)
    assert code == 0
    assert (counts["skipped"], counts["xfailed"], counts["passed"]) == (2, 1, 1)


def test_module_that_skips_itself_fails_in_ci(tmp_path: Path) -> None:
    suite = "import pytest\nno_such_thing = pytest.importorskip('no_such_thing')\ndef test_passing(): pass\n"
    code, _, output = outcomes(tmp_path, "true", suite)
    assert code != 0
    assert "A skip is a failure in CI" in output


def test_allowance_without_a_reason_is_refused(tmp_path: Path) -> None:
    code, _, _ = outcomes(tmp_path, "", "import pytest\n@pytest.mark.may_skip\ndef test_one(): pass\n")
    assert code == 4
