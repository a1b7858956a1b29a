"""An ASI Tiger with each kind of card: nothing moves that is no scanner, and nothing is set that is no input mode."""

import math
import re
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


class TwoScanners(AsiTigerDevice):
    def answer(self, command):
        answer = super().answer(command)
        more = {"Motor Axes": "P Q", "Axis Types": "u u", "Axis Addr": "3 3", "Hex Addr": "33 33"}
        for name, row in more.items() if command == "BU X" else ():
            answer = re.sub(f"({name}:[^\r\n]*)", rf"\1 {row}", answer)
        return answer


NO_SCANNER, OTHER_AXES = r"no scanner.*X \(x\), Y \(x\)", r"not two axes of a scanner.*choose two of A, B"
BEYOND = r"the device ends at 160\.6 mrad; lower limit_mrad and park_mrad"


@pytest.mark.parametrize(
    ("device", "keys", "refusal", "only_asks"),
    [
        ({"board": "stage"}, {"axes": None}, NO_SCANNER, True),
        ({"board": "stage"}, {"axes": ("X", "Y")}, NO_SCANNER, True),
        *(({}, {"axes": axes}, OTHER_AXES, True) for axes in (("X", "Y"), ("A", "Y"), ("A", "A"), ("P", "Q"))),
        ({"device_class": TwoScanners}, {}, "more than one scanner, with axes A, B, P, Q", True),
        ({"external_input": True}, {}, "PM A=0", False),  # it ends the mirror's following of its analog inputs
        ({}, {"limit_mrad": 250.0, "park_mrad": (-240.0, -240.0)}, BEYOND, False),
        ({}, {"limit_mrad": 161.0, "park_mrad": (0.0, 0.0)}, BEYOND, False),
        ({"device_class": answering(AsiTigerDevice, "SL B?", ":A B=-1.000")}, {}, r"ends at 34\.91 mrad", False),
    ],
)
def test_a_controller_without_the_scanner_of_the_rig_is_refused_and_nothing_moves(
    device, keys, refusal, only_asks, tmp_path
):
    with bench_with(tmp_path, **device) as bench:
        with pytest.raises(InstrumentError, match=refusal) as caught:
            bench.mirror(**(MEMS | keys))
        assert not isinstance(caught.value, InstrumentLostError | TransientInstrumentError)
        assert bench.device.stage_units == {"X": 0.0, "Y": 0.0}
        commands = [command for command in bench.far.commands if command]
        assert not any(command.startswith("M ") for command in commands)
        if only_asks:
            assert all(command.upper().endswith("BU X") or command.endswith("?") for command in commands)


def test_given_two_scanners_then_the_named_one_moves(tmp_path):
    with bench_with(tmp_path, device_class=TwoScanners) as bench:
        bench.check_move(bench.mirror(axes=("A", "B"), **MEMS))


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
        if board != "mems":  # a range of its outputs is no input mode
            assert set(modes.values()) == {1}
            assert not any(command.startswith("PM") for command in bench.far.commands)


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
        with pytest.raises(InstrumentLostError, match="switched off and on"):
            [mirror.move_to(x_mrad, -25.0) for x_mrad in (40.0, 20.0)]


def test_a_micro_mirror_back_on_its_inputs_after_a_restart_is_told(tmp_path):
    fault = WireFault("mirror", "restarted", "move", at_call=1)
    with bench_with(tmp_path, fault, external_input=True) as bench:
        bench.device.answer("PM A=0 B=0")
        mirror = bench.mirror(**MEMS)
        with pytest.raises(InstrumentLostError):
            mirror.move_to(40.0, -25.0)
        with pytest.raises(InstrumentError, match="analog input, as it may after it was switched on"):
            mirror.reconnect()


@pytest.mark.parametrize("kind", ["template", "emulated"])
def test_given_the_angles_of_a_template_then_a_micro_mirror_card_reaches_them(kind):
    text = (resources.files("wavefocus.templates") / f"rig-{kind}.toml").read_text(encoding="utf-8")
    mirror = tomllib.loads(text)["mirror"]
    assert max(map(abs, (*mirror["park_mrad"], mirror["limit_mrad"]))) <= 2000 * math.radians(4.6)
