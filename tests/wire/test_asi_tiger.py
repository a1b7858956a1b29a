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


class StartingTiger(AsiTigerDevice):
    """Sends its banner when it is first spoken to."""

    started = False

    def answer(self, command):
        banner, self.started = ("" if self.started else self.banner()), True
        return banner + super().answer(command)


@pytest.mark.parametrize(
    "device",
    [
        {"device_class": TwoScanners},  # the one that the rig file names
        *({"board": board, "address": address}
          for board, address in (("mems", "2"), ("mems", "\xf5"), ("dac_4ch", "\x81"), ("signal_dac", "\x85"))),
        {"tiger_syntax": True},
        *({"verbosity": saved} for saved in (1, 8, 16, 31)),
        {"device_class": StartingTiger},
        {"device_class": answering(AsiTigerDevice, "PM", ":N-1")},  # older firmware has no input modes
        *({"device_class": answering(AsiTigerDevice, "UM", answer)}
          for answer in (":A {axis}=1000", ":{axis}=1000.000000 A", "{axis}=1000 :A")),
        # Refusals that one lost character of a command explains; it is asked once more.
        *({"device_class": answering(AsiTigerDevice, "M ", answer, times=1)} for answer in (":N-2", ":N-4")),
    ],
)  # fmt: skip
def test_a_controller_of_any_card_firmware_and_state_moves_its_scanner_and_no_stage(device, tmp_path):
    with bench_with(tmp_path, **device) as bench:
        mirror = bench.mirror(answer_s=0.25, axes=("A", "B"), **MEMS)
        identity, modes = mirror.identity, bench.device.modes
        assert mirror.identify().isprintable()
        bench.check_move(mirror)
        assert mirror.where_mrad() == pytest.approx((40.0, -25.0), abs=0.01)
        bench.device.restart()
        mirror.reconnect()
        assert mirror.identity == identity
        bench.check_move(mirror, -40.0, 25.0)
        assert bench.device.modes == modes
        assert bench.device.stage_units == {"X": 0.0, "Y": 0.0}
        commands = [command for command in bench.far.commands if command]
        if device.get("board", "mems") != "mems":  # a range of its outputs is no input mode
            assert set(modes.values()) == {1}
            assert not any(command.startswith("PM") for command in commands)
        if "tiger_syntax" in device:
            assert set(commands[: commands.index("VB X=0")]) == {"BU X"}


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
