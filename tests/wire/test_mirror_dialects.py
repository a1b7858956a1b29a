"""Each dialect over each wire, without faults: what every mirror must do, and what each one says on the line."""

import math
import re
import tomllib
from functools import partial
from importlib import resources

import pytest

from tests.lab_files import wire_fault
from tests.wire.serial_bench import DIALECTS, LIMIT_MRAD, LOCAL, answering, mirror_bench
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.registry import MIRRORS
from wavefocus.mocks.wire.asi_tiger import AsiTigerDevice
from wavefocus.mocks.wire.mirrors import MIRROR_DEVICES, MirrorcleDevice, OptotuneDevice


def test_every_dialect_is_in_the_table_and_has_an_emulated_device():
    # "analog" follows outputs of the emulated NI box.
    assert set(MIRRORS.all()) - {"analog"} == set(MIRROR_DEVICES) == set(DIALECTS)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_a_mirror_says_where_it_points_is_found_again_and_no_other_is_taken_for_it(dialect, tmp_path):
    with mirror_bench(dialect, LOCAL, tmp_path) as bench:
        mirror = bench.mirror()
        named, identity = mirror.identify(), mirror.identity
        bench.check_move(mirror, 12.5, -7.25)
        reads_back = dialect in ("asi-tiger", "generic")
        assert mirror.where_mrad() == (pytest.approx((12.5, -7.25), abs=0.01) if reads_back else None)
        mirror.reconnect()
        assert (mirror.identify(), mirror.identity) == (named, identity)
        with pytest.raises(TransientInstrumentError, match="sent nowhere"):
            mirror.wait_settled(10.0)
        bench.check_move(mirror, 6.0, 6.0)
        mirror.close()
        with_another_limit = bench.mirror(limit_mrad=LIMIT_MRAD / 2, park_mrad=(0.0, 0.0))
        assert with_another_limit.identify() != named
        assert with_another_limit.identity == identity
        with_another_limit.close()
        with pytest.raises(InstrumentError, match=r"another device answers.*does not contain 'SN 4711'") as caught:
            bench.mirror(identity="SN 4711")
        assert not isinstance(caught.value, InstrumentLostError)


@pytest.mark.parametrize("dialect", ["asi-tiger", "generic", "optotune-mre2"])
def test_given_a_slow_mirror_then_the_driver_waits_until_it_is_idle(dialect, tmp_path):
    with mirror_bench(dialect, LOCAL, tmp_path, settle_s=0.05, slew_mrad_s=1000.0) as bench:
        bench.check_move(bench.mirror(settle_s=0.0), 100.0, 100.0)


def test_given_a_mirror_that_is_held_elsewhere_then_waiting_says_where_it_stands(tmp_path):
    with mirror_bench("generic", LOCAL, tmp_path) as bench:
        mirror = bench.mirror()
        mirror.move_to(10.0, 10.0)
        bench.motion.start(50.0, 10.0)
        with pytest.raises(TransientInstrumentError, match=r"standing at \(50\.0.*not at \(10\.0"):
            mirror.wait_settled(0.3)


def in_tangents(*angles_rad):
    return ";".join(f"{math.tan(angle_rad) / math.tan(math.radians(50)):.4f}" for angle_rad in angles_rad)


@pytest.mark.parametrize(
    ("dialect", "card", "changes", "target_mrad", "commands"),
    [
        ("asi-tiger", {"axes": ("P", "Q"), "units_per_degree": 500.0, "limit_degrees": 8.0}, {},
         (1000 * math.radians(1.0), 0.0), ("M P=250.000 Q=0.000",)),
        ("asi-tiger", {"limit_degrees": 8.0},
         {"beam_per_mirror": 1.0, "limit_mrad": 120.0, "park_mrad": (-100.0, -100.0), "axes": ("a", "b")},
         (1000 * math.radians(1.0), 0.0), ("M A=1000.000 B=0.000",)),
        ("mirrorcle-mti", None, {"setup": ("MTI+VB 80", "MTI+VD 135", "MTI+BW 120")}, (125.0, -62.5),
         ("MTI+DI", "MTI+VB 80", "MTI+VD 135", "MTI+BW 120", "MTI+EN", "MTI+GT 0.5000 -0.2500 0")),
        ("optotune-mre2", None, {}, (200.0, -100.0), (f"xy={in_tangents(0.2, -0.1)}",)),
    ],
)  # fmt: skip
def test_a_move_goes_to_the_device_in_its_own_units(dialect, card, changes, target_mrad, commands, tmp_path):
    device = None if card is None else partial(AsiTigerDevice, **card)
    with mirror_bench(dialect, LOCAL, tmp_path, device=device) as bench:
        bench.mirror(**changes).move_to(*target_mrad)
        assert bench.far.commands[-len(commands) :] == commands
        if dialect == "mirrorcle-mti":
            assert bench.far.commands[:2] == ("MTI+EX", "$MTI$")


def test_optotune_in_pro_mode_is_brought_back_to_simple_mode(tmp_path):
    with mirror_bench("optotune-mre2", LOCAL, tmp_path, device=partial(OptotuneDevice, pro_mode=True)) as bench:
        bench.check_move(bench.mirror())


@pytest.mark.skipif(LOCAL != "pty", reason="a TCP port has no baud")
@pytest.mark.parametrize("its_baud", [115200, 460800])
def test_given_either_factory_baud_then_mirrorcle_is_found_and_says_which(its_baud, tmp_path):
    class Set(MirrorcleDevice):
        baud = its_baud

    with mirror_bench("mirrorcle-mti", LOCAL, tmp_path, device=lambda motion: Set(motion, LIMIT_MRAD)) as bench:
        mirror = bench.mirror(answer_s=0.1, patience_s=0.1)
        bench.check_move(mirror)
        assert f"at {its_baud} baud" in mirror.identify()
        before = len(bench.far.commands)
        mirror.reconnect()  # at the baud that was found: one greeting is enough
        assert bench.far.commands[before:].count("$MTI$") <= 2
        bench.check_move(mirror)
        mirror.close()
        # A baud in the rig file is the only one that is tried.
        other = 576000 - its_baud
        with pytest.raises(InstrumentLostError):
            bench.mirror(baud=other, answer_s=0.1, patience_s=0.1)


def test_a_controller_still_enabled_takes_its_settings_with_the_voltage_off(tmp_path):
    with mirror_bench("mirrorcle-mti", LOCAL, tmp_path) as bench:
        bench.mirror(setup=("MTI+VB 80",)).close()  # closing leaves the mirror enabled
        with pytest.raises(InstrumentError, match=r"setting up \(MTI\+VB 500\).*MTI-ERR InvalidParameter"):
            bench.mirror(setup=("MTI+VB 500",))
        bench.check_move(bench.mirror(setup=("MTI+VB 80",)))


@pytest.mark.parametrize("digits", ["{:08X}", "0x{:08x}"])
def test_given_a_status_register_then_bit_4_alone_says_that_optotune_moves(digits, tmp_path):
    class Busy(OptotuneDevice):
        registers = (0xFFFFFFEF, 0x00000010, 0xFFFFFFFF, 0x0000000F)
        asked = 0

        def answer(self, command):
            if command != "status":
                return super().answer(command)
            self.asked += 1
            return digits.format(self.registers[min(self.asked, len(self.registers)) - 1]) + "\r\n"

    with mirror_bench("optotune-mre2", LOCAL, tmp_path, device=Busy) as bench:
        mirror = bench.mirror(settle_s=0.0)  # the first register answers the look for the place after `start`
        mirror.move_to(40.0, -25.0)
        mirror.wait_settled(10.0)
        assert bench.device.asked == len(Busy.registers)


def test_a_controller_that_restarted_unnoticed_is_lost_and_enabled_again(tmp_path):
    # Its high voltage is off then, and nothing on the line would say that it points nowhere.
    class Controller(MirrorcleDevice):
        def operation(self, command):
            if command.startswith("MTI+GT 0.4"):
                self.restart()
            return super().operation(command)

    with mirror_bench("mirrorcle-mti", LOCAL, tmp_path, device=lambda motion: Controller(motion, LIMIT_MRAD)) as bench:
        mirror = bench.mirror()
        with pytest.raises(InstrumentLostError, match="switched off and on"):
            mirror.move_to(100.0, 0.0)
        mirror.reconnect()
        bench.check_move(mirror, 75.0, 0.0)


@pytest.mark.parametrize(
    ("dialect", "wrong", "refusal"),
    [
        ("generic", {"park_mrad": (300.0, 0.0)}, "beyond the limit"),
        ("optotune-mre2", {"limit_mrad": 800.0, "park_mrad": (750.0, 750.0)}, "preparing to park: the device cannot"),
    ],
)
def test_given_a_park_direction_out_of_reach_then_it_is_refused_before_it_is_needed(dialect, wrong, refusal, tmp_path):
    with mirror_bench(dialect, LOCAL, tmp_path) as bench, pytest.raises(InstrumentError, match=refusal):
        bench.mirror(**wrong)


# -- ASI Tiger with each kind of card: nothing moves that is no scanner, nothing is set that is no input mode ----


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
    fault = wire_fault("mirror", "restarted", operation, at_call=1)
    with bench_with(tmp_path, fault) as bench:
        mirror = bench.mirror(settle_s=0.0, **MEMS)
        with pytest.raises(InstrumentLostError, match="switched off and on meanwhile: its position and its settings"):
            bench.check_move(mirror)
        before = len(bench.far.commands)
        mirror.reconnect()
        assert any(command == "VB F=0" for command in bench.far.commands[before:])
        bench.check_move(mirror, -40.0, 25.0)


def test_a_restart_after_a_move_is_no_answer_to_the_next_and_an_input_mode_is_told(tmp_path):
    class RestartsAfterEachMove(AsiTigerDevice):
        def answer(self, command):
            answer = super().answer(command)
            if command.startswith("M A="):
                self.restart()
                return answer + self.banner()
            return answer

    with bench_with(tmp_path, device_class=RestartsAfterEachMove, external_input=True) as bench:
        bench.device.answer("PM A=0 B=0")
        mirror = bench.mirror(**MEMS)
        with pytest.raises(InstrumentLostError, match="switched off and on"):
            [mirror.move_to(x_mrad, -25.0) for x_mrad in (40.0, 20.0)]
        with pytest.raises(InstrumentError, match="analog input, as it may after it was switched on"):
            mirror.reconnect()


@pytest.mark.parametrize("kind", ["template", "emulated"])
def test_given_the_angles_of_a_template_then_a_micro_mirror_card_reaches_them(kind):
    text = (resources.files("wavefocus.templates") / f"rig-{kind}.toml").read_text(encoding="utf-8")
    mirror = tomllib.loads(text)["mirror"]
    assert max(map(abs, (*mirror["park_mrad"], mirror["limit_mrad"]))) <= 2000 * math.radians(4.6)
