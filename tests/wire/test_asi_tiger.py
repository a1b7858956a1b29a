"""An ASI Tiger with each kind of card: nothing moves that is no scanner, and nothing is set that is no input mode."""

import math
import tomllib
from importlib import resources

import pytest

from tests.wire.serial_bench import LOCAL, answering, mirror_bench
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.mocks.wire import WireFault
from wavefocus.mocks.wire.asi_tiger import AsiTigerDevice

MEMS = {"limit_mrad": 155.0, "park_mrad": (-150.0, -150.0)}


def bench_with(folder, *faults, device_class=AsiTigerDevice, **device):
    return mirror_bench("asi-tiger", LOCAL, folder, *faults, device=lambda motion: device_class(motion, **device))


def only_asks(bench):
    """Whether nothing was said to the controller but questions."""
    return all(command.upper().endswith("BU X") or command.endswith("?") for command in bench.far.commands if command)


@pytest.mark.parametrize("axes", [None, ("X", "Y")])
def test_a_stage_and_no_scanner_card_then_it_is_refused_and_nothing_moves_or_is_set(axes, tmp_path):
    with bench_with(tmp_path, board="stage") as bench:
        with pytest.raises(InstrumentError, match=r"no scanner.*X \(x\), Y \(x\)") as caught:
            bench.mirror(axes=axes, **MEMS)
        assert not isinstance(caught.value, InstrumentLostError | TransientInstrumentError)
        assert bench.device.stage_units == {"X": 0.0, "Y": 0.0}
        assert only_asks(bench)


@pytest.mark.parametrize("axes", [("X", "Y"), ("A", "Y"), ("A", "A"), ("P", "Q")])
def test_given_named_axes_that_are_not_two_of_the_scanner_then_they_are_refused(axes, tmp_path):
    with bench_with(tmp_path) as bench:
        with pytest.raises(InstrumentError, match=r"not two axes of a scanner.*choose two of A, B"):
            bench.mirror(axes=axes, **MEMS)
        assert bench.device.stage_units == {"X": 0.0, "Y": 0.0}
        assert only_asks(bench)


def test_given_two_scanners_and_no_named_axes_then_they_are_listed_to_choose_from(tmp_path):
    class TwoScanners(AsiTigerDevice):
        def answer(self, command):
            answer = super().answer(command)
            if command != "BU X":
                return answer
            rows = {"Motor Axes:": "P Q", "Axis Types:": "u u", "Axis Addr:": "3 3", "Hex Addr:": "33 33"}
            lines = [line + f" {rows[line.partition(':')[0] + ':']}" if ":" in line and line.partition(":")[0] + ":" in
                     rows else line for line in answer.rstrip("\r\n").split("\r")]  # fmt: skip
            return "\r".join(lines) + "\r\n"

    with bench_with(tmp_path, device_class=TwoScanners) as bench:
        with pytest.raises(InstrumentError, match="more than one scanner, with axes A, B, P, Q"):
            bench.mirror(**MEMS)
        assert only_asks(bench)
        bench.mirror(axes=("A", "B"), **MEMS).move_to(10.0, 0.0)


@pytest.mark.parametrize(
    ("board", "address"), [("mems", "2"), ("mems", "\xf5"), ("dac_4ch", "\x81"), ("signal_dac", "\x85")]
)
def test_a_scanner_card_at_any_address_then_the_mirror_moves_and_the_stage_stands(board, address, tmp_path):
    with bench_with(tmp_path, board=board, address=address) as bench:
        mirror = bench.mirror(**MEMS)
        modes = bench.device.modes
        bench.check_move(mirror)
        assert bench.device.modes == modes
        assert bench.device.stage_units == {"X": 0.0, "Y": 0.0}
        mirror.reconnect()
        assert mirror.identify().isprintable()


@pytest.mark.parametrize("board", ["dac_4ch", "signal_dac"])
def test_given_a_card_with_outputs_then_its_range_is_not_taken_for_an_input_mode(board, tmp_path):
    with bench_with(tmp_path, board=board) as bench:
        assert set(bench.device.modes.values()) == {1}
        bench.mirror(**MEMS)
        assert not any(command.startswith("PM") for command in bench.far.commands)


def test_micro_mirror_on_its_analog_inputs_then_command_that_ends_that_is_named(tmp_path):
    with bench_with(tmp_path, external_input=True) as bench, pytest.raises(InstrumentError, match="PM A=0"):
        bench.mirror(**MEMS)


@pytest.mark.parametrize(
    "beyond", [{"limit_mrad": 250.0, "park_mrad": (-240.0, -240.0)}, {"limit_mrad": 161.0, "park_mrad": (0.0, 0.0)}]
)
def test_limits_beyond_those_of_the_controller_are_refused_and_nothing_moves(beyond, tmp_path):
    with bench_with(tmp_path) as bench:
        with pytest.raises(InstrumentError, match=r"the device ends at 160\.6 mrad; lower limit_mrad and park_mrad"):
            bench.mirror(**beyond)
        assert not any(command.startswith("M ") for command in bench.far.commands)


def test_given_a_limit_on_one_side_alone_then_it_counts(tmp_path):
    with (
        bench_with(tmp_path, device_class=answering(AsiTigerDevice, "SL B?", ":A B=-1.000")) as bench,
        pytest.raises(InstrumentError, match=r"ends at 34\.91 mrad"),
    ):
        bench.mirror(**MEMS)


def test_given_a_controller_in_the_other_syntax_then_opening_changes_that(tmp_path):
    with bench_with(tmp_path, tiger_syntax=True) as bench:
        mirror = bench.mirror(**MEMS)
        mirror.move_to(40.0, -25.0)
        mirror.wait_settled(10.0)
        assert mirror.where_mrad() == pytest.approx((40.0, -25.0), abs=0.01)
        before, _, _ = "|".join(filter(None, bench.far.commands)).partition("VB X=0")
        assert set(before.strip("|").split("|")) == {"BU X"}


@pytest.mark.parametrize("verbosity", [1, 8, 16, 31])
def test_a_saved_verbosity_then_the_controller_is_opened_moved_and_opened_again(verbosity, tmp_path):
    with bench_with(tmp_path, verbosity=verbosity) as bench:
        mirror = bench.mirror(answer_s=0.25, **MEMS)
        identity = mirror.identity
        bench.check_move(mirror)
        bench.device.restart()
        mirror.reconnect()
        assert mirror.identity == identity
        bench.check_move(mirror, -40.0, 25.0)


@pytest.mark.parametrize("answer", [":A 2291.8 -1432.4 ", ":A 2291 -1432", ":A"])
def test_given_a_card_that_prints_the_target_all_the_same_then_the_move_is_done(answer, tmp_path):
    with bench_with(tmp_path, device_class=answering(AsiTigerDevice, "M ", answer)) as bench:
        bench.mirror(**MEMS).move_to(40.0, -25.0)


@pytest.mark.parametrize("code", [":N-2", ":N-4"])
def test_given_a_refusal_that_a_lost_character_explains_then_it_is_asked_once_more(code, tmp_path):
    class LosesOneCharacter(AsiTigerDevice):
        lost = False

        def answer(self, command):
            if command.startswith("M ") and not self.lost:
                self.lost = True
                return f"{code}\r\n"
            return super().answer(command)

    with bench_with(tmp_path, device_class=LosesOneCharacter) as bench:
        mirror = bench.mirror(**MEMS)
        bench.check_move(mirror)


def test_given_such_a_refusal_twice_then_it_is_final(tmp_path):
    with bench_with(tmp_path, device_class=answering(AsiTigerDevice, "M ", ":N-4")) as bench:
        mirror = bench.mirror(**MEMS)
        with pytest.raises(InstrumentError, match=":N-4") as caught:
            mirror.move_to(40.0, -25.0)
        assert not isinstance(caught.value, TransientInstrumentError)
        assert len([command for command in bench.far.commands if command.startswith("M ")]) == 2


@pytest.mark.parametrize("operation", ["move", "where"])
def test_given_a_controller_that_restarted_then_it_is_lost_and_set_up_again(operation, tmp_path):
    fault = WireFault("mirror", "restarted", operation, at_call=1)
    with bench_with(tmp_path, fault) as bench:
        mirror = bench.mirror(settle_s=0.0, **MEMS)
        with pytest.raises(InstrumentLostError, match="switched off and on meanwhile: its position and its settings"):
            bench.check_move(mirror)
        before = len(bench.far.commands)
        mirror.reconnect()
        assert any(command == "VB F=0" for command in bench.far.commands[before:])
        bench.check_move(mirror, -40.0, 25.0)


def test_a_restart_between_two_moves_then_the_banner_is_not_taken_for_an_answer(tmp_path):
    class RestartsAfterTheFirstMove(AsiTigerDevice):
        def answer(self, command):
            answer = super().answer(command)
            if command.startswith("M A="):
                self.restart()
                return answer + self.banner()
            return answer

    with bench_with(tmp_path, device_class=RestartsAfterTheFirstMove) as bench:
        mirror = bench.mirror(**MEMS)

        def move_twice():
            mirror.move_to(40.0, -25.0)
            mirror.move_to(20.0, -25.0)

        with pytest.raises(InstrumentLostError, match="switched off and on"):
            move_twice()


def test_a_micro_mirror_back_on_its_inputs_after_a_restart_is_told(tmp_path):
    fault = WireFault("mirror", "restarted", "move", at_call=1)
    with bench_with(tmp_path, fault, external_input=True) as bench:
        bench.device.answer("PM A=0 B=0")
        mirror = bench.mirror(**MEMS)
        with pytest.raises(InstrumentLostError):
            mirror.move_to(40.0, -25.0)
        with pytest.raises(InstrumentError, match="analog input, as it may after it was switched on"):
            mirror.reconnect()


def test_the_banner_of_a_controller_that_still_starts_is_passed_over(tmp_path):
    class Starting(AsiTigerDevice):
        started = False

        def answer(self, command):
            banner, self.started = ("" if self.started else self.banner()), True
            return banner + super().answer(command)

    with bench_with(tmp_path, device_class=Starting) as bench:
        bench.mirror(**MEMS).move_to(1.0, 1.0)


@pytest.mark.parametrize("kind", ["template", "emulated"])
def test_given_the_angles_of_a_template_then_a_micro_mirror_card_reaches_them(kind):
    text = (resources.files("wavefocus.templates") / f"rig-{kind}.toml").read_text(encoding="utf-8")
    mirror = tomllib.loads(text)["mirror"]
    assert max(map(abs, (*mirror["park_mrad"], mirror["limit_mrad"]))) <= 2000 * math.radians(4.6)
