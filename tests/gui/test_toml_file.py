"""What the window takes a TOML file for, and which rig a file names: as the commands read them."""

from __future__ import annotations

from pathlib import Path

import pytest

from gui.files import TomlKind, names_virtual_rig, runs_on_virtual_rig, toml_kind
from gui.rig.tab import line_of, read_rig_file

REAL_RIG = '[rig]\nname = "lab"\n\n[mirror]\ndriver = "mirrorcle"\n\n[player]\nlimit_v = 2.0\n'


@pytest.mark.parametrize(
    ("text", "kind"),
    [
        ('[[source]]\npath = { kind = "point" }\n', TomlKind.SCENE),
        ('[scene]\nbank = "plate.h5"\n', TomlKind.SCENE),
        (REAL_RIG, TomlKind.RIG),
        ('[mirror]\ndriver = "virtual"\n[player]\nlimit_v = 1.0\n', TomlKind.RIG),
        ('rig = "rig.toml"\n\n[grid]\nspacing_mm = 2.0\n', TomlKind.RUN),
        ('format = "wavefocus-calibration"\nrig = "lab"\n[mirror]\ndevice = "virtual mirror"\n', TomlKind.OTHER),
        ("\ufeff" + REAL_RIG, TomlKind.RIG),  # with a byte-order mark
        ("rig = [", TomlKind.UNREADABLE),
        (None, TomlKind.UNREADABLE),
    ],
)
def test_the_kind_of_a_file_follows_from_its_tables(tmp_path: Path, text: str | None, kind: TomlKind) -> None:
    file = tmp_path / "file.toml"
    if text is not None:
        file.write_text(text, encoding="utf-8")
    assert toml_kind(file) is kind


@pytest.mark.parametrize("mark", ["", "\ufeff"], ids=["plain", "with a byte-order mark"])
def test_real_instruments_are_known_whatever_editor_wrote_the_files(tmp_path: Path, mark: str) -> None:
    rig, run = tmp_path / "rig.toml", tmp_path / "run.toml"
    rig.write_text(mark + REAL_RIG, encoding="utf-8")
    run.write_text(mark + 'rig = "rig.toml"\n', encoding="utf-8")
    assert not names_virtual_rig(rig)
    assert not runs_on_virtual_rig(run)
    assert not read_rig_file(rig).is_virtual
    assert line_of(rig, "rig.name") == 2
