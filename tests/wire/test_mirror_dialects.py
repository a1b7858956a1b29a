"""Each dialect over each wire, without faults: what every mirror must do, and what each one says on the line."""

import math
from functools import partial

import pytest

from tests.wire.serial_bench import DIALECTS, LIMIT_MRAD, LOCAL, mirror_bench
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
        mirror = bench.mirror(settle_s=0.0)
        bench.check_move(mirror, 100.0, 100.0)


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
