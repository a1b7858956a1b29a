"""A person at a terminal: what is typed, and what comes of it."""

from __future__ import annotations

import io

import pytest

from wavefocus.acquisition.calibrate_mirror import Jog, JogView
from wavefocus.config.messages.rig_checks import By, Here, To
from wavefocus.mocks.virtual.laboratory import PatchBay
from wavefocus.rig.calibration_session import Cables
from wavefocus.rig.operators import TerminalOperator
from wavefocus.storage.errors import InputError

VIEW = JogView(2, 7, (80.0, -45.0), (1.0, -2.5))


def typing(text: str) -> TerminalOperator:
    return TerminalOperator(io.StringIO(text).readline)


@pytest.mark.parametrize(
    ("line", "jog"),
    [
        ("", Here()),
        ("   ", Here()),
        ("1 -2", By(1.0, -2.0)),
        ("0.5,-1e-2", By(0.5, -0.01)),
        ("= 10 20.5", To(10.0, 20.5)),
        ("=10 20.5", To(10.0, 20.5)),
    ],
)
def test_given_a_line_then_the_beam_moves_as_it_says(line: str, jog: Jog) -> None:
    assert typing(line + "\n").jog(VIEW) == jog


@pytest.mark.parametrize("line", ["1", "1 2 3", "one two", "= 1", "== 1 2", "1;2", "nan 1", "1 inf"])
def test_given_a_line_that_says_nothing_then_it_is_told_and_asked_again(
    line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert typing(f"{line}\n3 4\n").jog(VIEW) == By(3.0, 4.0)
    told = capsys.readouterr().err
    assert f"{line!r} is not understood: two numbers move the beam" in told
    assert told.count("mark 2 of 7 at (80, -45) mm; mirror at (1.000, -2.500) mrad") == 2


@pytest.mark.parametrize("do", ["jog", "connect", "again"])
def test_given_nobody_who_types_then_it_says_so_and_does_not_wait(do: str) -> None:
    operator = typing("")
    asked = {
        "jog": lambda: operator.jog(VIEW),
        "connect": lambda: operator.connect("sum"),
        "again": lambda: operator.again(""),
    }
    with pytest.raises(InputError, match="standard input: ended before"):
        asked[do]()


@pytest.mark.parametrize(("line", "again"), [("", True), ("y", True), ("s", False), (" SKIP ", False)])
def test_given_a_problem_then_enter_tries_again_and_s_leaves_it_out(line: str, again: bool) -> None:
    assert typing(line + "\n").again("no signal from output 3") is again


@pytest.mark.parametrize("source", ["vibrometer", "sum", "both", "output 13"])
def test_a_cable_to_plug_then_the_person_is_told_which_and_the_virtual_one_follows(
    source: str, capsys: pytest.CaptureFixture[str]
) -> None:
    bay = PatchBay(range(20), 20)
    Cables(typing("\n"), bay.connect).connect(source)
    assert bay.word == source
    told = capsys.readouterr().err
    assert "then press Enter" in told
    assert {"sum": "summing box", "both": "both inputs"}.get(source, source) in told
