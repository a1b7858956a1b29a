"""What the commands say of damaged files."""

import json
import shutil
from pathlib import Path

import h5py

from tests.system.captures import wavefocus


def _zero_ledger_page(bank: Path, position: int) -> None:
    with h5py.File(bank, "r") as file:
        offset = file["durability/ledger"].id.get_offset() + position * 4096
    with bank.open("r+b") as raw:
        raw.seek(offset)
        raw.write(bytes(4096))


def test_given_a_zeroed_ledger_page_then_every_command_names_the_position(lab, bank, capsys):
    sound = shutil.copy(bank, lab / "sound.h5")
    assert wavefocus("render", lab / "scene.toml", "--bank", sound, "--out", lab / "drive.h5") == 0
    _zero_ledger_page(bank, 2)
    commands = [
        ("check", bank),
        ("render", lab / "scene.toml", "--bank", bank, "--out", lab / "out.h5"),
        ("predict", lab / "drive.h5", "--bank", bank, "--out", lab / "field.h5"),
        ("export", bank, lab / "out.npz", "--to", "npz"),
        ("verify", lab / "scene.toml", "--bank", bank, "--rig", lab / "rig.toml", "--out", lab / "verify"),
    ]
    capsys.readouterr()
    assert [wavefocus(*command) for command in commands] == [1, 2, 2, 2, 2]
    assert "".join(capsys.readouterr()).count("position 2 is damaged") == 5
    assert not (lab / "out.h5").exists()
    assert wavefocus("predict", lab / "drive.h5", "--bank", bank, "--out", lab / "field.h5", "--positions", "0,1") == 0
    capsys.readouterr()
    assert wavefocus("status", bank, "--json") == 0
    told = json.loads(capsys.readouterr().out)
    assert (told["damaged_positions"], told["counts"]["damaged"], told["counts"]["not-measured"]) == ([2], 1, 0)
    assert wavefocus("resume", bank) == 0
    assert bank.read_bytes() == Path(sound).read_bytes()
