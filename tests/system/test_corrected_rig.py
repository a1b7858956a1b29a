"""Going on with a corrected rig file: what may change, what may not, and the command as it is printed."""

import shlex

from tests.lab_files import ACTUATORS, change_text
from tests.system.captures import empty_bank, refused, wavefocus
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


def test_another_rig_is_refused_by_the_keys_that_rows_depend_on_and_else_counts(lab, capsys):
    bank, rig = empty_bank(lab, "plate.h5"), lab / "rig.toml"
    command, measured = ["resume", bank, "--rig", rig], rig.read_text(encoding="utf-8")
    for text, key in (
        ("[recorder]\nresponse_range_v = 5.0\n", "recorder.response_range_v"),
        ("[mirror]\ndistance_mm = 900.0\n", "mirror.matrix"),
        ("[player]\nchannels = [2, 1, 0]\n", "player.channels"),
        ("[player]\nlimit_v = 0.001\n", "limit_v"),  # the sweep is too loud for it
    ):
        rig.write_text(measured + text, encoding="utf-8")
        line = refused(capsys, *command)
        assert str(rig) in line
        assert key in line
    other = measured.replace("three coils", "three other coils")
    rig.write_text(f"{other}[player]\nlimit_v = 3.0\n", encoding="utf-8")
    assert wavefocus(*command) == 0
    with open_bank(bank) as view:
        assert view.status.all()
