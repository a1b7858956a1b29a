"""A user's own files of everyday names, and other packages, do not stand in the way of wavefocus, nor it in theirs."""

import os
import subprocess
import sys
import venv
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NAMES = (
    "acquisition", "benchmarks", "calibration", "config", "drivers", "gui", "mocks", "rendering", "storage", "trials",
)  # fmt: skip
SCRIPT = f"""
import {", ".join(NAMES)}
import wavefocus as wf
from wavefocus.config.rig import default_rig
assert all(module.LAB == 1 for module in ({", ".join(NAMES)}))
with wf.open_bank("plate.h5") as bank:
    drive = wf.render("scene.toml", bank)
    wf.predict(drive, bank, [0])
"""


def checked(*command, cwd):
    """Run a command in a folder, without this test's own paths; what it printed."""
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "COVERAGE"))}
    done = subprocess.run(
        list(map(str, command)), cwd=cwd, env=environment, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    return done.stdout


def take_names(folder):
    """Put a module or a package of each name into a folder, by turns."""
    for number, name in enumerate(NAMES):
        module = folder / f"{name}.py" if number % 2 else folder / name / "__init__.py"
        module.parent.mkdir(exist_ok=True)
        module.write_text("LAB = 1\n", encoding="utf-8")


@pytest.mark.long
@pytest.mark.timeout(900)
def test_a_wheel_next_to_the_package_config_does_its_work_among_users_files(bank, tmp_path):
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check"]
    build = ["wheel", "-q", "--no-deps", "--no-build-isolation", "-w", tmp_path / "wheel", copy_of_source(tmp_path)]
    checked(*pip, *build, cwd=tmp_path)
    (wheel,) = (tmp_path / "wheel").iterdir()
    environment = tmp_path / "environment"
    venv.create(environment, with_pip=False)
    python = environment / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    checked(*pip, "--python", python, "install", "-q", "--no-deps", wheel, "config", cwd=tmp_path)
    site = Path(checked(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path).strip())
    installed = {path.name for path in site.iterdir() if not path.name.endswith(".dist-info")}
    assert installed - {"__pycache__"} == {"wavefocus", "config"}
    # What wavefocus depends on comes from the environment of the tests: only its packages, not its .pth files.
    (site / "dependencies.pth").write_text("\n".join(one for one in sys.path if "site-packages" in one), "utf-8")
    assert checked(python, "-c", "import config; print(config.Config.__name__)", cwd=tmp_path)
    folder = bank.parent
    take_names(folder)
    (folder / "script.py").write_text(SCRIPT, encoding="utf-8")
    checked(python, "script.py", cwd=folder)
    where = checked(python, "-c", "import wavefocus.config; print(wavefocus.config.__file__)", cwd=folder)
    assert Path(where.strip()).is_relative_to(site)
    checked(python, "-m", "wavefocus", "init", "new", cwd=folder)
    scene = ["scene.toml", "--bank", bank, "--rig", "rig.toml"]
    checked(python, "-m", "wavefocus", "verify", *scene, "--out", "out", "--positions", "0", cwd=folder)
    assert (folder / "out" / "report.html").is_file()


def copy_of_source(tmp_path):
    """The files that git has, as a fresh checkout would hold them: a build leaves no trace among the sources."""
    source = tmp_path / "source"
    for name in checked("git", "ls-files", "-z", cwd=ROOT).split("\0"):
        if name and (ROOT / name).is_file() and not name.startswith(("docs/", "tests/")):
            (source / name).parent.mkdir(parents=True, exist_ok=True)
            (source / name).write_bytes((ROOT / name).read_bytes())
    return source
