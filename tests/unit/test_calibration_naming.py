"""A calibration file named in a rig file that a person wrote."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from wavefocus.config.calibration import name_calibration
from wavefocus.storage.errors import InputError

NEW = "calibration-2026-11-21.toml"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[rig]\nname = 'a'  # mine\n", f"[rig]\nname = 'a'  # mine\n\n[calibration]\nfile = \"{NEW}\"\n"),
        (
            "[calibration]  # of the rig\n# file = 'x'\nstale_after_days = 30.0\n\n[rig]\nname = 'a'\n",
            f"[calibration]  # of the rig\nfile = \"{NEW}\"\n# file = 'x'\nstale_after_days = 30.0\n\n"
            "[rig]\nname = 'a'\n",
        ),
        ("[calibration]\nfile = 'old.toml'\n[rig]\n", f'[calibration]\nfile = "{NEW}"\n[rig]\n'),
        ("", f'\n[calibration]\nfile = "{NEW}"\n'),
    ],
)
def test_given_a_rig_file_then_only_the_line_of_the_calibration_changes(
    tmp_path: Path, text: str, expected: str
) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(text, encoding="utf-8")
    file.chmod(0o640)
    name_calibration(file, NEW)
    assert file.read_text(encoding="utf-8") == expected
    assert tomllib.loads(expected)["calibration"]["file"] == NEW
    assert file.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    "text",
    [
        'calibration = { file = "old.toml" }\n',
        'calibration.file = "old.toml"\n',
        'text = """\n[calibration]\n"""\n',
    ],
)
def test_given_a_table_written_otherwise_then_it_is_left_alone_and_a_person_is_asked(tmp_path: Path, text: str) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match="by hand"):
        name_calibration(file, NEW)
    assert file.read_text(encoding="utf-8") == text
