"""Small campaigns on the virtual rig, quick enough for a test, through the same commands as large ones."""

import shutil

import pytest

from tests.lab_files import POSITIONS, RIG, RUN, stroke_scene, write_positions
from wavefocus.__main__ import run

SCENE = stroke_scene(
    [0, 0], [8, 0], 'kind = "sine", frequency_hz = 200.0, duration_s = 0.05', 'emission = "per_point"',
    "[output]\nlimit_v = 1.0",
)  # fmt: skip


def write_lab(folder):
    """Write the files of a small campaign into a folder."""
    (folder / "rig.toml").write_text(RIG, encoding="utf-8")
    (folder / "run.toml").write_text(RUN, encoding="utf-8")
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    write_positions(folder, POSITIONS)
    return folder


@pytest.fixture
def lab(tmp_path):
    """A folder with rig.toml, run.toml, scene.toml and positions.csv of a small campaign."""
    return write_lab(tmp_path)


@pytest.fixture(scope="session")
def measured(tmp_path_factory):
    """The bank of an undisturbed capture of a lab; to be copied, with what lies beside it."""
    lab = write_lab(tmp_path_factory.mktemp("measured"))
    assert run(["capture", str(lab / "run.toml"), "--bank", str(lab / "plate.h5")]) == 0
    return lab / "plate.h5"


@pytest.fixture
def bank(lab, measured):
    """The measured bank of six positions, in the lab."""
    for beside in measured.parent.glob("plate.*"):
        shutil.copy2(beside, lab / beside.name)
    return lab / measured.name


def add_to_rig(lab, text):
    """Write more tables into the rig file of a lab."""
    with (lab / "rig.toml").open("a", encoding="utf-8") as rig:
        rig.write(text)


def with_faults(lab, *faults):
    """Let the virtual rig of a lab show faults, each an inline TOML table; returns what mends it."""
    file = lab / "run.toml"
    sound = file.read_text(encoding="utf-8")
    file.write_text(sound + "".join(f"\n[[virtual.fault_plan]]\n{fault}\n" for fault in faults), encoding="utf-8")
    return lambda: file.write_text(sound, encoding="utf-8")
