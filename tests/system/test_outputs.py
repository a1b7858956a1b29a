"""Outputs of every command: what they never replace, and what is there when disks fail or processes are killed."""

import contextlib
import itertools
import json
import os
import shutil
import socket
from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.lab_files import point_scene, write_foreign
from tests.system.lines import python
from wavefocus.__main__ import run
from wavefocus.commands.demo import _prepare
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replacement

pytestmark = pytest.mark.skipif(os.name == "nt", reason="pipes, devices and limits of POSIX")

RATE_HZ = 2000.0
OLD = b"precious results of an earlier day"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A folder with a bank, a scene with its sound, a drive and a field of them."""
    import soundfile

    folder = tmp_path_factory.mktemp("made")
    with contextlib.chdir(folder):
        for name in ("bank.h5", "other.h5"):
            write_foreign(Path(name))
        with h5py.File("other.raw.h5", "w") as file:
            file.attrs["format"], file.attrs["format_version"] = "wavefocus-raw", 1
        soundfile.write("sound.wav", np.random.default_rng(4).uniform(-1, 1, 200), int(RATE_HZ))
        Path("scene.toml").write_text(point_scene([4, 8], 'kind = "file", path = "sound.wav"'), encoding="utf-8")
        assert run(["render", "scene.toml", "--bank", "bank.h5", "--out", "drive.h5"]) == 0
        assert run(["predict", "drive.h5", "--bank", "bank.h5", "--out", "field.h5"]) == 0
    return folder


@pytest.fixture
def lab(made, tmp_path, monkeypatch):
    """The same, as the working folder of a test."""
    monkeypatch.chdir(tmp_path)
    return Path(shutil.copytree(made, tmp_path, dirs_exist_ok=True))


RENDER = ["render", "scene.toml", "--bank", "bank.h5", "--out"]
MOVIE = ["movie", "field.h5", "--bank", "bank.h5", "--drive", "drive.h5"]
COMMANDS = {
    "render": RENDER,
    "wav": [*RENDER, "new.h5", "--wav"],
    "predict": ["predict", "drive.h5", "--bank", "bank.h5", "--out"],
    "movie": [*MOVIE, "--to-s", "0.01", "--slow", "9", "--out"],
    "snapshots": [*MOVIE, "--snapshots"],
    "sofa": ["export", "bank.h5", "--to", "sofa"],
    "uff": ["export", "bank.h5", "--to", "uff"],
    "mat": ["export", "bank.h5", "--to", "mat"],
    "npz": ["export", "bank.h5", "--to", "npz"],
    "netcdf": ["export", "bank.h5", "--to", "netcdf"],
    "csv": ["export", "bank.h5", "--to", "csv"],
}


@pytest.mark.parametrize("name", COMMANDS)
def test_what_must_stay_is_replaced_by_no_command_and_an_older_output_with_force(lab, name):
    os.link("bank.h5", "hard.h5")
    Path("soft.h5").symlink_to("other.h5")
    os.mkfifo("pipe")
    Path("folder").mkdir()
    with socket.socket(socket.AF_UNIX) as server:
        server.bind("socket")
    Path("loop").symlink_to("loop")
    kept = {path: path.read_bytes() for path in lab.iterdir() if path.is_file()}
    entries = sorted(entry.name for entry in lab.iterdir())
    for output in (
        *("bank.h5", "./folder/../bank.h5", "hard.h5", "soft.h5", "other.h5", "other.raw.h5"),
        *("pipe", "socket", "folder", "loop", "loop/x", "nowhere/x", "/dev/null"),
    ):
        assert run([*COMMANDS[name], output, "--force"]) == 2
    assert {path: path.read_bytes() for path in kept} == kept
    assert sorted(entry.name for entry in lab.iterdir()) == entries
    Path("old").write_bytes(OLD)
    Path("old").chmod(0o640)
    assert run([*COMMANDS[name], "old"]) == 2
    assert Path("old").read_bytes() == OLD
    assert run([*COMMANDS[name], "old", "--force"]) == 0
    assert Path("old").read_bytes() != OLD
    assert Path("old").stat().st_mode & 0o777 == 0o640
    assert not list(lab.glob(".*"))


@pytest.mark.parametrize(
    ("command", "victim"),
    [
        ([*RENDER, "new.h5", "--force", "--wav"], "sound.wav"),  # named by the scene
        ([*RENDER, "new.h5", "--force", "--wav"], "scene.toml"),
        ([*RENDER, "new.h5", "--force", "--wav"], "new.h5"),
        (["predict", "drive.h5", "--bank", "bank.h5", "--force", "--out"], "drive.h5"),
        (["movie", "field.h5", "--bank", "bank.h5", "--force", "--out"], "field.h5"),
    ],
)
def test_given_an_input_or_another_output_then_it_is_not_replaced(lab, command, victim):
    before = (lab / victim).read_bytes() if (lab / victim).exists() else None
    assert run([*command, victim]) == 2
    assert ((lab / victim).read_bytes() if (lab / victim).exists() else None) == before


def test_folders_of_results_then_they_stay_without_force_and_banks_in_them_with_it(lab):
    verify = ["verify", "scene.toml", "--bank", "bank.h5", "--rig", "virtual", "--out"]
    for folder, name in (("a", "verify.json"), ("b", "scan.h5"), ("c", "drift.png"), ("d", "report.html")):
        Path(folder).mkdir()
        (lab / folder / name).write_bytes(OLD)
        assert run([*verify, folder]) == 2
        assert [entry.name for entry in (lab / folder).iterdir()] == [name]
    Path("e").mkdir()
    os.link("other.h5", "e/scan.h5")
    assert run([*verify, "e", "--force"]) == 2
    Path("f").mkdir()
    (lab / "f" / "bank.json").write_bytes(OLD)
    assert run(["export", "bank.h5", "f", "--to", "wav"]) == 2
    assert run(["export", "bank.h5", "f", "--to", "wav", "--force"]) == 0
    Path("bench").mkdir()
    (lab / "bench" / "render.json").write_bytes(OLD)
    assert run(["bench", "render", "--quick", "--out", "bench"]) == 2
    Path("demo").mkdir()
    (lab / "demo" / "made-by-wavefocus-demo").touch()
    assert run(["demo", "--out", "demo"]) == 2


def test_given_a_folder_of_the_demo_then_it_is_cleared_of_its_own_names_alone(tmp_path):
    for name in ("made-by-wavefocus-demo", "rig.toml", "plate.waves.h5", ".plate.h5.heartbeat.1f.new", "lab.h5"):
        (tmp_path / name).touch()
    with pytest.raises(InputError, match=r"holds lab\.h5"):
        _prepare(tmp_path, force=True)
    (tmp_path / "lab.h5").unlink()
    _prepare(tmp_path, force=True)
    assert [path.name for path in tmp_path.iterdir()] == ["made-by-wavefocus-demo"]


# Commands in forks of one process, which has run each once: libraries are loaded once. Nothing measures coverage in
# there: a limit on the size of files would hold for its file too.
FORKS = """
import contextlib, json, os, resource, signal, sys
from pathlib import Path
from wavefocus.__main__ import run

def loaded(arguments):
    with open(os.devnull, "w") as nowhere, contextlib.redirect_stdout(nowhere), contextlib.redirect_stderr(nowhere):
        assert run(arguments) == 0

def forked(arguments, prepare):
    child = os.fork()
    if not child:
        code = 99
        try:
            said = os.open("said", os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(said, 1)
            os.dup2(said, 2)
            prepare()
            code = run(arguments)
        finally:
            os._exit(code)
    return os.waitpid(child, 0)[1]

def hidden():
    return [str(path) for path in Path().glob(".*")]
"""
LIMITED = """
for name, arguments in json.loads(sys.argv[1]).items():
    loaded([*arguments, "old", "--force"])
    for limit in (0, 1500, 6000) if name == "render" else (1500,):
        Path("old").write_bytes(old)
        limits = (resource.RLIMIT_FSIZE, (limit, limit))
        status = forked([*arguments, "old", "--force"], lambda: resource.setrlimit(*limits))
        assert os.WIFEXITED(status), (name, limit, status)
        if os.WEXITSTATUS(status) == 0 and limit:
            assert 0 < Path("old").stat().st_size <= limit, name  # it needs no more
        else:
            assert os.WEXITSTATUS(status) == 2, (name, limit, status)
            assert Path("old").read_bytes() == old, (name, limit)
        assert not hidden(), (name, limit, hidden())
"""
# Each fork kills itself at the n-th call that could change a file of the working folder.
KILLED = """
EVENTS = {"open", "os.mkdir", "os.link", "os.rename", "os.remove", "os.rmdir", "os.chmod", "os.truncate"}

def kill_at(number):
    def hook(event, details):
        nonlocal number
        if event in EVENTS and isinstance(details[0], (str, Path)) and ".partial" in str(details):
            if number == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            number -= 1
    sys.addaudithook(hook)

for name, arguments in json.loads(sys.argv[1]).items():
    arguments = [*arguments, "old", "--force"]
    loaded(arguments)
    new = Path("old").stat().st_size
    for number in range(0, 400, int(sys.argv[2])):
        Path("old").write_bytes(old)
        status = forked(arguments, lambda: kill_at(number))
        found = Path("old").read_bytes()
        assert found == old or (len(found) == new and new != len(old)), (name, number, len(found), new)
        if os.WIFEXITED(status):
            assert os.WEXITSTATUS(status) == 0 and found != old, (name, number)
            break
    assert number > 3, name
    assert not hidden(), (name, hidden())
"""


def in_forks(script, names, *options):
    environment = {name: value for name, value in os.environ.items() if not name.startswith("COV")}
    environment |= {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
    commands = json.dumps({name: COMMANDS[name] for name in names})
    done = python("-c", f"{FORKS}\nold = {OLD!r}\n{script}", commands, *options, env=environment, timeout=600)
    assert done.returncode == 0, done.stderr


@pytest.mark.timeout(600)
def test_given_a_disk_without_room_then_exit_2_and_the_older_output_is_intact(lab):
    in_forks(LIMITED, COMMANDS)


@pytest.mark.parametrize(
    ("names", "step"),
    [
        (["npz"], "1"),
        (["wav", "predict"], "8"),
        pytest.param(["render", "snapshots", "uff", "mat", "movie"], "4", marks=pytest.mark.nightly),
    ],
)
@pytest.mark.timeout(600)
def test_given_kills_then_the_older_output_or_the_new_one_is_there(lab, names, step):
    """At every call, or every few, that change a file."""
    in_forks(KILLED, names, step)


@pytest.mark.parametrize("number", [1, 2])
def test_given_a_folder_that_cannot_be_synced_then_the_older_file_is_back(tmp_path, monkeypatch, number):
    """The disk is asked by ``fsync`` of the folder, before and after the name is given."""
    real, calls = os.fsync, itertools.count(1)

    def fsync(fd):
        if next(calls) == number:
            raise OSError(5, "Input/output error")
        real(fd)

    def write():
        with monkeypatch.context() as broken, replacement(tmp_path / "file") as temporary:
            temporary.write_bytes(b"new")
            broken.setattr(os, "fsync", fsync)

    (tmp_path / "file").write_bytes(OLD)
    with pytest.raises(InputError):
        write()
    assert (tmp_path / "file").read_bytes() == OLD
    assert [entry.name for entry in tmp_path.iterdir()] == ["file"]
