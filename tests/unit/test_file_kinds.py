"""A file of the wrong kind, and a mistyped command: named at once, with what is meant."""

import json
import re

import h5py
import numpy as np
import pytest

from wavefocus import InputError, load_scene, open_bank
from wavefocus.__main__ import run
from wavefocus.cli import run_command
from wavefocus.command_line import nearest
from wavefocus.commands.table import COMMANDS
from wavefocus.config.calibration import load_calibration
from wavefocus.config.retired import COMMANDS as GONE
from wavefocus.config.retired import KEYS, OPTIONS
from wavefocus.configuration import configuration_from_json, load_rig, load_run
from wavefocus.trials.design import load_trials

LOADS = {"run": load_run, "rig": load_rig, "scene": load_scene, "trials": load_trials, "calibration": load_calibration}


@pytest.fixture(scope="module")
def lab(tmp_path_factory):
    """What `wavefocus init` writes, a calibration, and HDF5 files of other kinds."""
    folder = tmp_path_factory.mktemp("files") / "lab"
    assert run(["init", str(folder)]) == 0
    (folder / "calibration.toml").write_text('format = "wavefocus-calibration"\nformat_version = 1\n')
    for kind in ("bank", "drive", "raw", "field"):
        with h5py.File(folder / f"{kind}.h5", "w") as file:
            file.attrs["format"] = f"wavefocus-{kind}"
            file["green" if kind == "bank" else "values"] = np.ones((1, 1, 4))
    return folder


KINDS = {f"{kind}.toml": f"{kind} file" for kind in LOADS} | {
    "bank.h5": "bank", "drive.h5": "drive file", "raw.h5": "file of raw recordings", "field.h5": "field file",
}  # fmt: skip


@pytest.mark.parametrize("wanted", LOADS)
def test_given_a_file_of_another_kind_then_both_kinds_are_named(lab, wanted):
    for name, found in KINDS.items():
        if name != f"{wanted}.toml":
            with pytest.raises(InputError, match=rf"{re.escape(name)}: this is a {found}; a {wanted} file is needed"):
                LOADS[wanted](lab / name)


def test_a_toml_file_in_place_of_a_bank_and_a_key_of_a_rig_in_a_run_file_are_named(lab, tmp_path):
    with pytest.raises(InputError, match=r"run\.toml is a TOML file; .*bank, is needed"):
        open_bank(lab / "run.toml")
    (tmp_path / "run.toml").write_text("[grid]\nspacing_mm = 4.0\n[sweep]\nstop_hz = 400.0\n[mirror]\nsettle_s = 1.0\n")
    with pytest.raises(InputError, match=r"mirror = .*unknown key"):
        load_run(tmp_path / "run.toml")


@pytest.mark.parametrize(
    ("arguments", "meant"),
    [
        (["captrue", "run.toml"], "capture"),
        (["Capture", "run.toml"], "capture"),
        (["exprot"], "export"),
        (["cap"], "capture"),
        (["plan", "run.toml", "--scnee", "a.toml"], "--scene"),
        (["render", "s.toml", "--bank", "b.h5", "--out", "o.h5", "--Force"], "--force"),
        (["export", "b.h5", "o", "--to", "nectdf"], "netcdf"),
    ],
)
def test_given_a_mistyped_word_then_the_nearest_is_named(arguments, meant):
    with pytest.raises(InputError, match=f"did you mean {meant}\\?"):
        run_command(arguments)


def test_given_a_word_that_is_near_to_none_then_none_is_named():
    assert nearest("xyzzy", [one.name for one in COMMANDS]) == ""
    assert run(["xyzzy"]) == 2


@pytest.mark.parametrize("words", [*GONE, *OPTIONS])
def test_a_command_or_option_of_an_earlier_version_then_one_sentence_names_another(words, capsys):
    if words in GONE:
        assert run([*words.split(), "plate.h5", "--out", "x"]) == 2
        told = f"{words} is gone: {GONE[words]}"
    else:
        assert run(["plan", "run.toml", words, "x"]) == 2
        told = f"plan: {words} is gone: {OPTIONS[words]}"
    assert capsys.readouterr().err == f"wavefocus: {told}\n"


@pytest.mark.parametrize("key", ["refine_to", "refine_positions"])
def test_a_key_of_an_earlier_version_is_refused_in_files_and_read_in_banks(lab, tmp_path, key):
    (tmp_path / "run.toml").write_text(f"[grid]\n{key} = 1\n")
    with pytest.raises(InputError, match=rf"grid: {key} is gone: {KEYS[key]}$"):
        load_run(tmp_path / "run.toml")
    kept = configuration_from_json("{}", json.dumps({"grid": {key: 1}}), np.zeros((1, 2)), "b.h5")
    assert kept.plan_sha256 == configuration_from_json("{}", "{}", np.zeros((1, 2)), "b.h5").plan_sha256
