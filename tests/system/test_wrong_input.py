"""Wrong input through the command line: one sentence, exit 2, and the file untouched."""

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from wavefocus.__main__ import run


def _told(capsys, *arguments):
    """Exit code and the one line on standard error."""
    capsys.readouterr()
    code = run([str(argument) for argument in arguments])
    captured = capsys.readouterr()
    lines = [line for line in captured.err.splitlines() if line.startswith("wavefocus: ")]
    assert len(lines) == 1, captured.err
    assert "Traceback" not in captured.err
    assert captured.out == ""
    return code, lines[0]


def _truncate(path):
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def _not_hdf5(path):
    path.write_bytes(b"position;actuator;volts\n" * 1000)


def _future(path):
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 2


def _external_link(path):
    with h5py.File(path.with_name("outside.h5"), "w") as file:
        file["green"] = np.ones((6, 3, 1000), np.float32)
    with h5py.File(path, "r+") as file:
        del file["green"]
        file["green"] = h5py.ExternalLink("outside.h5", "/green")


BROKEN: dict[str, Callable[[Path], None]] = {
    "truncated": _truncate,
    "not-hdf5": _not_hdf5,
    "future-version": _future,
    "external-link": _external_link,
}


# Every command opens a bank by one function: each kind through two of them, one that reads and one that writes.
@pytest.mark.parametrize(
    ("command", "kind"),
    [(command, kind) for kind in BROKEN for command in ("resume", "render")]
    + [(command, "truncated") for command in ("status", "check", "predict", "remeasure")],
)
def test_given_a_broken_bank_then_one_sentence_exit_2_and_the_file_untouched(lab, bank, kind, command, capsys):
    drive = lab / "drive.h5"
    if command == "predict":
        assert run(["render", str(lab / "scene.toml"), "--bank", str(bank), "--out", str(drive)]) == 0
    BROKEN[kind](bank)
    before, files = bank.read_bytes(), sorted(path.name for path in lab.iterdir())
    arguments: dict[str, list[object]] = {
        "resume": [bank],
        "status": [bank],
        "check": [bank],
        "remeasure": [bank, "--positions", "1"],
        "render": [lab / "scene.toml", "--bank", bank, "--out", lab / "new.h5"],
        "predict": [drive, "--bank", bank, "--out", lab / "new.h5"],
    }
    code, line = _told(capsys, command, *arguments[command])
    assert code == 2
    assert bank.name in line
    assert bank.read_bytes() == before
    assert sorted(path.name for path in lab.iterdir()) == files


def test_a_flipped_byte_is_refused_named_by_check_and_measured_again_by_resume(lab, bank, capsys):
    sound = bank.read_bytes()
    with h5py.File(bank, "r") as file:
        offset = file["green"].id.get_chunk_info(1).byte_offset + 777
    flipped = bytearray(sound)
    flipped[offset] ^= 0x10
    bank.write_bytes(flipped)
    code, line = _told(capsys, "render", lab / "scene.toml", "--bank", bank, "--out", lab / "drive.h5")
    assert code == 2
    assert "position 1" in line
    assert bank.read_bytes() == bytes(flipped)
    assert run(["check", str(bank)]) == 1
    assert "position 1" in capsys.readouterr().out
    assert bank.read_bytes() == bytes(flipped)
    assert run(["resume", str(bank)]) == 0
    assert bank.read_bytes() == sound


@pytest.mark.parametrize(
    ("command", "names"),
    [
        (["capture", "nowhere.toml", "--bank", "plate.h5"], "nowhere.toml"),
        (["plan", "nowhere.toml"], "nowhere.toml"),
        (["resume", "nowhere.h5"], "nowhere.h5"),
        (["status", "nowhere.h5"], "nowhere.h5"),
        (["check", "."], "."),
        (["render", "nowhere.toml", "--bank", "b.h5", "--out", "d.h5"], "nowhere.toml"),
        (["predict", "nowhere.h5", "--bank", "b.h5", "--out", "d.h5"], "nowhere.h5"),
        (["capture"], "RUN.toml"),
        (["captrue"], "captrue"),
        (["status", "b.h5", "--frobnicate"], "--frobnicate"),
        (["render", "s.toml", "--bank", "b.h5", "--out", "d.h5", "--method", "guessed"], "guessed"),
    ],
)
def test_given_a_wrong_command_line_then_one_sentence_names_it(command, names, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    code, line = _told(capsys, *command)
    assert code == 2
    assert names in line
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "names"),
    [
        (("duration_s = 0.3", "durations_s = 0.3"), "sweep.durations_s"),
        (('[grid]\npositions_file = "positions.csv"', "[grid]\nmargin_mm = 80"), "grid.margin_mm"),
        (("amplitude", "amplitude"), ""),
    ],
)
def test_given_a_mistake_in_the_run_file_then_file_key_value_and_what_is_allowed(lab, change, names, capsys):
    path = lab / "run.toml"
    text = path.read_text(encoding="utf-8")
    path.write_text(text.replace(*change) if names else text + "\nnot toml at all", encoding="utf-8")
    code, line = _told(capsys, "capture", path, "--bank", lab / "plate.h5")
    assert code == 2
    assert "run.toml" in line
    assert names in line
    assert not (lab / "plate.h5").exists()


def test_given_a_bank_whose_plan_was_edited_then_its_resume_is_refused(bank, capsys):
    with h5py.File(bank, "r+") as file:
        file.attrs["plan_sha256"] = "0" * 64
    before = bank.read_bytes()
    code, line = _told(capsys, "resume", bank)
    assert code == 2
    assert "header" in line
    assert bank.read_bytes() == before
