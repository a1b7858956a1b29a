"""Going on with a corrected rig file: what may change, what may not, and the command as it is printed."""

import shlex

import pytest

from tests.lab_files import ACTUATORS, change_text
from tests.system.captures import empty_bank
from wavefocus.__main__ import run
from wavefocus.storage.bank.reading import open_bank

REAL = f"""
[actuators]
position_mm = {ACTUATORS}
[mirror]
driver = "asi-tiger"
port = "PORT"
[recorder]
driver = "nidaqmx"
device = "Dev1"
address = "localhost:1"
[player]
driver = "sounddevice"
device = "none"
"""


def _printed(told):
    """The words of the command that the last line ends with, without the program's name."""
    words = shlex.split(told.splitlines()[-1].rpartition("go on with: ")[2])
    assert words[0] == "wavefocus"
    return words[1:]


def test_given_a_wrong_port_then_the_printed_command_opens_the_corrected_one(lab, capsys):
    place = lab / "my lab"
    place.mkdir()
    bank, rig = place / "plate.h5", lab / "rig.toml"
    rig.write_text(REAL.replace("PORT", str(lab / "old port")), encoding="utf-8")
    change_text(lab / "run.toml", "[virtual]\nseed = 3\nnoise_v = 1e-4\n", "")
    empty_bank(lab, "my lab/plate.h5")
    assert run(["capture", str(lab / "run.toml"), "--bank", str(bank)]) == 3
    command = _printed(capsys.readouterr().err)
    change_text(rig, "old port", "new port")
    assert run(command) == 3
    told = capsys.readouterr().err
    assert "new port" in told
    assert "old port" not in told
    assert _printed(told) == command
    assert run(["remeasure", str(bank), "--positions", "0", "--rig", str(rig)]) == 3
    assert "new port" in capsys.readouterr().err
    assert run(["resume", str(bank)]) == 3
    told = capsys.readouterr().err
    assert "old port" in told
    assert "--rig RIG.toml" in told


@pytest.mark.parametrize(
    ("text", "key"),
    [
        ("[recorder]\nresponse_range_v = 5.0\n", "recorder.response_range_v"),
        ("[mirror]\ndistance_mm = 900.0\n", "mirror.matrix"),
        ("[player]\nchannels = [2, 1, 0]\n", "player.channels"),
    ],
)
def test_given_a_rig_that_measures_other_rows_then_it_is_refused_by_its_keys(lab, capsys, text, key):
    bank = empty_bank(lab, "plate.h5")
    with (lab / "rig.toml").open("a", encoding="utf-8") as rig:
        rig.write(text)
    assert run(["resume", str(bank), "--rig", str(lab / "rig.toml")]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert str(lab / "rig.toml") in line
    assert key in line


def test_other_names_and_limits_then_the_campaign_goes_on_and_its_rig_file_counts(lab):
    bank = empty_bank(lab, "plate.h5")
    change_text(lab / "rig.toml", "three coils", "three other coils")
    with (lab / "rig.toml").open("a", encoding="utf-8") as rig:
        rig.write("[player]\nlimit_v = 0.001\n")
    command = ["resume", str(bank), "--rig", str(lab / "rig.toml")]
    assert run(command) == 2  # the sweep is too loud for it
    change_text(lab / "rig.toml", "limit_v = 0.001", "limit_v = 3.0")
    assert run(command) == 0
    with open_bank(bank) as view:
        assert view.status.all()
