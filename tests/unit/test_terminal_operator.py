"""A person at a terminal: what is typed, and what comes of it."""

import io

import pytest

from wavefocus.commands.calibrate import TerminalOperator
from wavefocus.mocks.virtual import PatchBay
from wavefocus.rig.calibration_session import Cables


def typing(text):
    return TerminalOperator(io.StringIO(text).readline)


@pytest.mark.parametrize(("line", "again"), [("", True), ("y", True), ("s", False), (" SKIP ", False)])
def test_given_a_problem_then_enter_tries_again_and_s_leaves_it_out(line, again):
    assert typing(line + "\n").again("no signal from output 3") is again


@pytest.mark.parametrize("source", ["vibrometer", "sum", "both", "output 13"])
def test_a_cable_to_plug_then_the_person_is_told_which_and_the_virtual_one_follows(source, capsys):
    bay = PatchBay(range(20), 20)
    Cables(typing("\n"), bay.connect).connect(source)
    assert bay.word == source
    told = capsys.readouterr().err
    assert "then press Enter" in told
    assert {"sum": "summing box", "both": "both inputs"}.get(source, source) in told
