"""Going on with a corrected rig file: what may change, what may not, and the command as it is printed."""

import shlex

from tests.lab_files import ABSENT_RIG, change_text
from tests.system.captures import empty_bank, held, refused, wavefocus


def _printed(told):
    """The words of the command that a line ends with, without the program's name."""
    words = shlex.split(told.rpartition("go on with: ")[2])
    assert words[0] == "wavefocus"
    return words[1:]


def test_given_a_wrong_port_then_the_printed_command_opens_the_corrected_one(lab, capsys):
    place = lab / "my lab"
    place.mkdir()
    bank, rig = place / "plate.h5", lab / "rig.toml"
    rig.write_text(ABSENT_RIG.format(folder=lab.as_posix()), encoding="utf-8")
    change_text(lab / "run.toml", "[virtual]\nseed = 3\nnoise_v = 1e-4\n", "")
    capture = ["capture", lab / "run.toml", "--bank", bank]
    told = refused(capsys, *capture, code=3)
    assert told.startswith("wavefocus: recorder Dev1 at localhost:1: ")  # it is asked before a bank is made
    assert (_printed(told), bank.exists()) == ([str(word) for word in capture], False)
    empty_bank(lab, "my lab/plate.h5")
    told = refused(capsys, *capture, code=3)
    assert told.startswith("wavefocus: mirror (generic at ")
    assert "no-such-port" in told
    command = _printed(told)
    change_text(rig, "no-such-port", "new port")
    told = refused(capsys, *command, code=3)
    assert "new port" in told
    assert "no-such-port" not in told
    assert _printed(told) == command
    assert "new port" in refused(capsys, "remeasure", bank, "--positions", "0", "--rig", rig, code=3)
    told = refused(capsys, "resume", bank, code=3)
    assert "no-such-port" in told
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
    assert 0 not in held(bank)
