"""A calibration file named in a rig file that a person wrote."""

import tomllib

import pytest

from wavefocus.config.calibration import name_calibration
from wavefocus.storage.errors import InputError

NEW = "calibration-2026-11-21.toml"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[rig]\nname = 'a'  # mine\n", f"[rig]\nname = 'a'  # mine\n\n[calibration]\nfile = \"{NEW}\"\n"),
        (
            "[calibration]  # of the rig\n# file = 'x'\nstale_after_days = 30.0  # days\n\n[rig]\nname = 'a'\n",
            "[calibration]  # of the rig\n# file = 'x'\nstale_after_days = 30.0  # days\n"
            f"file = \"{NEW}\"\n\n[rig]\nname = 'a'\n",
        ),
        ("[calibration]\nfile = 'old.toml' # c\n[rig]\n", f'[calibration]\nfile = "{NEW}" # c\n[rig]\n'),
        ("", f'[calibration]\nfile = "{NEW}"\n'),
        ('calibration = { file = "old.toml" } # c\n', f'calibration = {{ file = "{NEW}" }} # c\n'),
        ("calibration = {}\n", f'calibration = {{file = "{NEW}"}}\n'),
        ('calibration.file = "old.toml" # c\nx = 1\n', f'calibration.file = "{NEW}" # c\nx = 1\n'),
        ("calibration.stale_after_days = 3.0\n", f'calibration.stale_after_days = 3.0\ncalibration.file = "{NEW}"\n'),
        ('text = """\n[calibration]\n"""\n', f'text = """\n[calibration]\n"""\n\n[calibration]\nfile = "{NEW}"\n'),
        ("a = 1\r\n[calibration]\r\nfile = 'x'\r\n", f'a = 1\r\n[calibration]\r\nfile = "{NEW}"\r\n'),
    ],
)
def test_given_a_rig_file_then_only_the_name_of_the_calibration_changes(tmp_path, text, expected):
    file = tmp_path / "rig.toml"
    file.write_bytes(text.encode())
    file.chmod(0o640)
    name_calibration(file, NEW)
    assert file.read_bytes().decode() == expected
    assert tomllib.loads(expected)["calibration"]["file"] == NEW
    assert file.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [file]


@pytest.mark.parametrize(
    "name", ["calibrations/new.toml", r"calibrations\new.toml", 'a"b.toml', "Plätte.toml", r"C:\n"]
)
def test_given_a_name_with_any_letter_then_it_is_read_back(tmp_path, name):
    file = tmp_path / "rig.toml"
    file.write_text("[calibration]\nfile = 'x'\n", encoding="utf-8")
    name_calibration(file, name)
    assert tomllib.loads(file.read_text(encoding="utf-8"))["calibration"]["file"] == name


DEEP = f"a = {'[' * 200}{']' * 200}\n"  # Python reads it; the editor of TOML does not


@pytest.mark.parametrize("text", ["calibration = 3\n", "[[calibration]]\nfile = 'x'\n", "[calibration\n", DEEP])
def test_given_a_file_that_has_no_such_table_then_it_is_left_alone(tmp_path, text):
    file = tmp_path / "rig.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"rig\.toml: "):
        name_calibration(file, NEW)
    assert file.read_text(encoding="utf-8") == text
