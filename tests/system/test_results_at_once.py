"""Results of several files are replaced at once: killed at any moment, old and new are never read as one."""

import hashlib
import json

import h5py
import numpy as np
import pytest

import wavefocus as wf
from tests.lab_files import POSITIONS as POSITIONS_MM
from tests.lab_files import change_text, write_arrays, write_positions
from tests.system.captures import answered, held, refused, wavefocus
from tests.system.lines import python
from tests.system.test_trials import TRIALS
from wavefocus.storage.errors import InputError

POSITIONS, ACTUATORS, TAPS = 5, 2, 16
# Python reports each renaming to audit hooks; the process ends there as if it were killed.
KILLED = """
import os, sys
left = int(sys.argv.pop(1))
def hook(event, arguments):
    global left
    if event == "os.rename":
        left -= 1
        if left == 0:
            os._exit(9)
sys.addaudithook(hook)
"""


RUNS = "from wavefocus.__main__ import run\nsys.exit(run(sys.argv[1:]))"


def killed_at(renaming, code, *arguments):
    """Run code in a process that is killed before its n-th renaming; whether it came that far."""
    done = python("-c", KILLED + code, renaming, *arguments)
    assert done.returncode in (0, 9), done.stderr
    return done.returncode == 9


def bank_of(path, factor):
    green = np.random.default_rng(3).standard_normal((POSITIONS, ACTUATORS, TAPS)) * factor
    return write_arrays(path, green.astype(np.float32), [[4.0 * row, 0.0] for row in range(POSITIONS)])


def values(folder, out):
    """Green's functions of an exported folder as an import reads them; None where it refuses it."""
    try:
        with wf.import_bank(folder, out, "wav") as bank:
            return np.stack([bank.green(row) for row in range(bank.positions)])
    except InputError:
        return None


def test_an_export_that_is_killed_over_an_older_one_then_leaves_no_mixture(tmp_path):
    first, second = bank_of(tmp_path / "1.h5", 1.0), bank_of(tmp_path / "2.h5", 1.13)
    whole = [h5py.File(one)["green"][()] for one in (first, second)]
    folder = tmp_path / "sounds"
    outcomes = set()
    for renaming in range(1, 20):
        assert wavefocus("export", first, folder, "--to", "wav", "--force") == 0
        killed = killed_at(renaming, RUNS, "export", second, folder, "--to", "wav", "--force")
        found = values(folder, tmp_path / f"i{renaming}.h5")
        which = -1 if found is None else next(n for n, one in enumerate(whole) if np.array_equal(found, one))
        outcomes.add((killed, which))
        if not killed:
            break
    assert (False, 1) in outcomes
    assert (True, 0) in outcomes
    assert {which for killed, which in outcomes if not killed} == {1}
    assert [entry.name for entry in tmp_path.iterdir() if "partial" in entry.name] == []


@pytest.mark.parametrize("renaming", [pytest.param(1, marks=pytest.mark.nightly), 2], ids=["recordings", "bank"])
def test_a_capture_and_an_extension_with_recordings_that_are_killed_then_go_on(lab, renaming):
    change_text(lab / "run.toml", "[capture]", "[capture]\nkeep_raw = true")
    for name, positions, words in (("old", 2, ["capture"]), ("new", 3, ["extend", lab / "old.h5", "--run"])):
        write_positions(lab, POSITIONS_MM[:positions])
        command = [*words, lab / "run.toml", "--bank", lab / f"{name}.h5"]
        assert killed_at(renaming, RUNS, *command)  # recordings and bank are each made whole
        assert wavefocus(*command) == 0
        assert wavefocus("check", lab / f"{name}.raw.h5") == 0
        assert held(lab / f"{name}.h5") == [1] * positions


def test_trials_that_are_killed_while_stimuli_are_prepared_go_on(lab, bank):
    (lab / "trials.toml").write_text(TRIALS, encoding="utf-8")
    command = ["trials", lab / "trials.toml", "--bank", bank, "--rig", lab / "rig.toml", "--prepare", "--out"]
    assert killed_at(3, RUNS, *command, lab / "killed")  # the list, two drives, the list again
    hashes = []
    for out in (lab / "killed", lab / "whole"):
        assert wavefocus(*command, out) == 0
        manifest = json.loads((out / "stimuli" / "manifest.json").read_text(encoding="utf-8"))
        hashes.append({name: entry["sha256"] for name, entry in manifest["stimuli"].items()})
    assert hashes[0] == hashes[1]


@pytest.mark.nightly
@pytest.mark.timeout(1800)
def test_a_corrected_verification_that_is_killed_then_goes_on(lab, bank):
    command = ["verify", lab / "scene.toml", "--bank", bank, "--rig", lab / "rig.toml"]
    for renaming in range(1, 60):
        out = lab / str(renaming)
        this = [*command, "--out", out, "--positions", "0,1,2", "--correct", "1"]
        if not killed_at(renaming, RUNS, *this):
            break
        assert wavefocus(*this) == 0
        record = json.loads((out / "verify.json").read_text(encoding="utf-8"))
        assert record["correction"] is not None
        left = {file.name for file in out.iterdir()}
        assert {*VERIFIED, "drive-corrected.h5"} <= left
        assert not {name for name in left if "unfinished" in name or "partial" in name}
    assert renaming > len(VERIFIED)


def test_a_smaller_export_then_leaves_no_files_of_the_older_one(tmp_path):
    folder = tmp_path / "sounds"
    command = ["export", bank_of(tmp_path / "1.h5", 1.0), folder, "--to", "wav"]
    assert wavefocus(*command) == 0
    assert wavefocus(*command, "--positions", "1,3") == 2
    assert wavefocus(*command, "--positions", "1,3", "--force") == 0
    files = sorted(file.name for file in folder.iterdir())
    assert files == ["bank.json", "places.csv", "position-1.wav", "position-3.wav"]
    (folder / "notes.txt").write_text("mine")
    assert wavefocus(*command, "--force") == 2
    assert (folder / "notes.txt").read_text() == "mine"


def test_an_export_then_states_checksums_and_a_file_of_another_export_is_refused(tmp_path, capsys):
    folders = [tmp_path / "1", tmp_path / "2"]
    for factor, folder in zip((1.0, 1.13), folders, strict=True):
        assert wavefocus("export", bank_of(tmp_path / f"{factor}.h5", factor), folder, "--to", "wav") == 0
    table = json.loads((folders[0] / "bank.json").read_text(encoding="utf-8"))
    assert all(len(one["sha256"]) == 64 for one in table["files"])
    name = table["files"][2]["file"]
    (folders[0] / name).write_bytes((folders[1] / name).read_bytes())
    command = ["import", folders[0], "--bank", tmp_path / "i.h5"]
    assert name in refused(capsys, *command)
    for one in table["files"]:
        del one["sha256"]  # as older versions wrote it
    (folders[0] / "bank.json").write_text(json.dumps(table), encoding="utf-8")
    assert "without a checksum" in answered(capsys, *command)["paragraph"]


# What a kill would leave of the results, at every renaming, removal and opening of a file: a hook cannot be taken away.
WATCHED = """
import hashlib, json, os, sys
from pathlib import Path
out, log, busy, seen = Path(sys.argv.pop(1)), Path(sys.argv.pop(1)), False, []
def hook(event, arguments):
    global busy
    if busy or event not in ("os.rename", "os.remove", "open") or str(out) not in str(arguments[:2]):
        return
    busy = True
    now = {path.name: hashlib.sha256(path.read_bytes()).hexdigest() for path in out.iterdir() if path.is_file()}
    if not seen or seen[-1] != now:
        seen.append(now)
    busy = False
sys.addaudithook(hook)
from wavefocus.__main__ import run
code = run(sys.argv[1:])
busy = True
log.write_text(json.dumps(seen))
sys.exit(code)
"""
VERIFIED = ("verify.json", "report.html", "drive.h5", "prediction.h5", "scan.h5")


def digests(folder):
    return {name: hashlib.sha256((folder / name).read_bytes()).hexdigest() for name in VERIFIED}


def test_a_verification_over_an_older_one_never_mixes_with_its_files(lab):
    out, scene, bank = lab / "verify", lab / "scene.toml", lab / "plate.h5"
    write_positions(lab, [*POSITIONS_MM, [0.0, 40.0], [4.0, 40.0]])  # a bank of the scene's positions alone will do
    change_text(scene, "limit_v = 1.0", 'limit_v = 1.0\ninterpolation = "nearest"')
    assert wavefocus("capture", lab / "run.toml", "--bank", bank, "--scene", scene) == 0
    out.mkdir()
    for name in VERIFIED:
        (out / name).write_text(f"older {name}", encoding="utf-8")
    older = digests(out)
    command = ["verify", scene, "--bank", bank, "--rig", lab / "rig.toml", "--out", out, "--force"]
    assert python("-c", WATCHED, out, lab / "seen.json", *command).returncode == 0
    newer = digests(out)
    assert all(older[name] != newer[name] for name in VERIFIED)
    moments = json.loads((lab / "seen.json").read_text(encoding="utf-8"))
    states = [{name: moment[name] for name in VERIFIED if name in moment} for moment in moments]
    assert states[0] == older
    assert {"verify.json"} < {name for state in states for name in older if name not in state}  # in between it is gone
    for state in states:
        if "verify.json" in state:
            assert state in (older, newer)
