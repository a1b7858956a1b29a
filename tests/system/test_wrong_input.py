"""Wrong input through the command line: one sentence, exit 2, and the file untouched."""

import os

import h5py
import pytest

from tests.lab_files import flip
from tests.system.captures import refused, said_by, wavefocus


# Unit tests have what else may be wrong with a bank; each command opens it by one function.
def test_given_a_broken_bank_then_one_sentence_exit_2_and_the_file_untouched(lab, bank, capsys):
    os.truncate(bank, bank.stat().st_size // 2)
    before, files = bank.read_bytes(), sorted(path.name for path in lab.iterdir())
    render = ["render", lab / "scene.toml", "--out", lab / "new.h5", "--bank"]
    for words in (["resume"], ["status"], ["check"], ["remeasure", "--positions", "1"], render):
        assert bank.name in refused(capsys, *words, bank)
        assert bank.read_bytes() == before
        assert sorted(path.name for path in lab.iterdir()) == files


def test_a_flipped_byte_is_refused_named_by_check_and_measured_again_by_resume(lab, bank, capsys):
    sound = bank.read_bytes()
    with h5py.File(bank, "r") as file:
        offset = file["green"].id.get_chunk_info(1).byte_offset + 777
    flip(bank, offset)
    flipped = bank.read_bytes()
    assert "position 1" in refused(capsys, "render", lab / "scene.toml", "--bank", bank, "--out", lab / "drive.h5")
    assert "position 1" in said_by(capsys, "check", bank, code=1).out
    assert bank.read_bytes() == flipped
    assert wavefocus("resume", bank) == 0
    assert bank.read_bytes() == sound


@pytest.mark.parametrize(
    ("command", "names"),
    [
        (["capture", "nowhere.toml", "--bank", "plate.h5"], "nowhere.toml"),
        (["status", "nowhere.h5"], "nowhere.h5"),
        (["check", "."], "."),
        (["render", "nowhere.toml", "--bank", "b.h5", "--out", "d.h5"], "nowhere.toml"),
        (["predict", "nowhere.h5", "--bank", "b.h5", "--out", "d.h5"], "nowhere.h5"),
        (["capture"], "RUN.toml"),
        (["status", "b.h5", "--frobnicate"], "--frobnicate"),
        (["render", "s.toml", "--bank", "b.h5", "--out", "d.h5", "--method", "guessed"], "guessed"),
    ],
)
def test_given_a_wrong_command_line_then_one_sentence_names_it(command, names, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert names in refused(capsys, *command)
    assert list(tmp_path.iterdir()) == []
