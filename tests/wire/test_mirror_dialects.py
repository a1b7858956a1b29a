"""Each dialect over each wire, without faults: what every mirror must do, and what each one says on the line."""

import math

import pytest

from tests.wire.serial_bench import DIALECTS, EACH, LIMIT_MRAD, LOCAL, answering, mirror_bench
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.registry import MIRRORS
from wavefocus.mocks.wire.asi_tiger import AsiTigerDevice
from wavefocus.mocks.wire.mirrors import MIRROR_DEVICES, MirrorcleDevice, OptotuneDevice


@pytest.fixture(params=EACH)
def bench(request, tmp_path):
    dialect, kind = request.param.split("/")
    with mirror_bench(dialect, kind, tmp_path) as bench:
        yield bench


def test_every_dialect_is_in_the_table_and_has_an_emulated_device():
    # "analog" follows outputs of the emulated NI box.
    assert set(MIRRORS.all()) - {"analog"} == set(MIRROR_DEVICES) == set(DIALECTS)


def test_given_a_mirror_in_use_then_reconnecting_goes_on_with_the_same_device(bench):
    mirror = bench.mirror()
    named, identity = mirror.identify(), mirror.identity
    mirror.move_to(5.0, 5.0)
    mirror.reconnect()
    assert mirror.identify() == named
    assert mirror.identity == identity
    with pytest.raises(TransientInstrumentError, match="sent nowhere"):
        mirror.wait_settled(10.0)
    bench.check_move(mirror, 6.0, 6.0)


def test_given_another_limit_then_the_device_is_the_same_one(bench):
    first = bench.mirror()
    named, identity = first.identify(), first.identity
    first.close()
    second = bench.mirror(limit_mrad=LIMIT_MRAD / 2, park_mrad=(0.0, 0.0))
    assert second.identify() != named
    assert second.identity == identity


def test_given_another_identity_in_the_rig_file_then_the_device_is_refused_by_name(bench):
    with pytest.raises(InstrumentError, match=r"another device answers.*does not contain 'SN 4711'") as caught:
        bench.mirror(identity="SN 4711")
    assert not isinstance(caught.value, InstrumentLostError)


@pytest.mark.parametrize("dialect", DIALECTS)
def test_dialect_with_read_back_then_it_says_where_mirror_points_and_none_without(dialect, tmp_path):
    with mirror_bench(dialect, LOCAL, tmp_path) as bench:
        mirror = bench.mirror()
        bench.check_move(mirror, 12.5, -7.25)
        reads_back = dialect in ("asi-tiger", "generic")
        assert mirror.where_mrad() == (pytest.approx((12.5, -7.25), abs=0.01) if reads_back else None)


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


@pytest.mark.parametrize(
    ("device", "changes", "command"),
    [
        ({"axes": ("P", "Q"), "units_per_degree": 500.0, "limit_degrees": 8.0}, {}, "M P=250.000 Q=0.000"),
        (
            {"limit_degrees": 8.0},
            {"beam_per_mirror": 1.0, "limit_mrad": 120.0, "park_mrad": (-100.0, -100.0), "axes": ("a", "b")},
            "M A=1000.000 B=0.000",
        ),
    ],
)
def test_given_units_and_the_beam_s_share_of_a_degree_then_asi_moves_in_those_units(device, changes, command, tmp_path):
    with mirror_bench("asi-tiger", LOCAL, tmp_path, device=lambda motion: AsiTigerDevice(motion, **device)) as bench:
        bench.mirror(**changes).move_to(1000 * math.radians(1.0), 0.0)
        assert bench.far.commands[-1] == command


@pytest.mark.parametrize(
    ("asked", "answer"),
    [
        ("PM", ":N-1"),  # older firmware has no input modes
        ("UM", ":A {axis}=1000"),
        ("UM", ":{axis}=1000.000000 A"),
        ("UM", "{axis}=1000 :A"),
    ],
)
def test_given_each_form_in_which_firmware_states_a_setting_then_asi_reads_it(asked, answer, tmp_path):
    firmware = answering(AsiTigerDevice, asked, answer)
    with mirror_bench("asi-tiger", LOCAL, tmp_path, device=lambda motion: firmware(motion, limit_degrees=8.0)) as bench:
        bench.check_move(bench.mirror())


def test_given_full_scale_then_mirrorcle_gets_parts_of_it(tmp_path):
    with mirror_bench("mirrorcle-mti", LOCAL, tmp_path) as bench:
        bench.mirror(setup=("MTI+VB 80", "MTI+VD 135", "MTI+BW 120")).move_to(125.0, -62.5)
        assert bench.far.commands[:2] == ("MTI+EX", "$MTI$")
        assert bench.far.commands[-6:] == (
            "MTI+DI",
            "MTI+VB 80",
            "MTI+VD 135",
            "MTI+BW 120",
            "MTI+EN",
            "MTI+GT 0.5000 -0.2500 0",
        )


@pytest.mark.skipif(LOCAL != "pty", reason="a TCP port has no baud")
@pytest.mark.parametrize("its_baud", [115200, 460800])
def test_given_either_factory_baud_then_mirrorcle_is_found_and_says_which(its_baud, tmp_path):
    class Set(MirrorcleDevice):
        baud = its_baud

    def device(motion):
        return Set(motion, LIMIT_MRAD)

    with mirror_bench("mirrorcle-mti", LOCAL, tmp_path, device=device) as bench:
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


@pytest.mark.skipif(LOCAL != "pty", reason="a TCP port has no baud")
def test_given_no_answer_at_any_baud_then_all_that_were_tried_are_named(tmp_path):
    class Slow(MirrorcleDevice):
        baud = 9600

    with (
        mirror_bench("mirrorcle-mti", LOCAL, tmp_path, device=lambda motion: Slow(motion, LIMIT_MRAD)) as bench,
        pytest.raises(InstrumentLostError) as caught,
    ):
        bench.mirror(answer_s=0.1, patience_s=0.1)
    assert "115200 and 460800 baud" in caught.value.cause


def test_a_controller_still_enabled_takes_its_settings_with_the_voltage_off(tmp_path):
    with mirror_bench("mirrorcle-mti", LOCAL, tmp_path) as bench:
        bench.mirror(setup=("MTI+VB 80",)).close()  # closing leaves the mirror enabled
        with pytest.raises(InstrumentError, match=r"setting up \(MTI\+VB 500\).*MTI-ERR InvalidParameter"):
            bench.mirror(setup=("MTI+VB 500",))
        bench.check_move(bench.mirror(setup=("MTI+VB 80",)))


def test_given_tangents_then_optotune_gets_them_over_that_of_fifty_degrees(tmp_path):
    with mirror_bench("optotune-mre2", LOCAL, tmp_path) as bench:
        bench.mirror().move_to(200.0, -100.0)
        x, y = (math.tan(angle) / math.tan(math.radians(50)) for angle in (0.2, -0.1))
        assert bench.far.commands[-1] == f"xy={x:.4f};{y:.4f}"


def test_given_optotune_in_its_pro_mode_then_it_is_brought_back_to_simple_mode(tmp_path):
    with mirror_bench(
        "optotune-mre2", LOCAL, tmp_path, device=lambda motion: OptotuneDevice(motion, pro_mode=True)
    ) as bench:
        mirror = bench.mirror()
        bench.check_move(mirror)


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


@pytest.mark.parametrize("answer", ["OU", "OL", "NO", "ERROR 17"])
def test_refusal_of_optotune_then_move_can_be_tried_again_unless_it_was_clamped(answer, tmp_path):
    with mirror_bench("optotune-mre2", LOCAL, tmp_path, device=answering(OptotuneDevice, "xy=", answer)) as bench:
        mirror = bench.mirror()
        with pytest.raises(InstrumentError, match=f"answers {answer}") as caught:
            mirror.move_to(40.0, -25.0)
        assert isinstance(caught.value, TransientInstrumentError) == (answer not in ("OU", "OL"))
        with pytest.raises(TransientInstrumentError, match="latest move failed"):
            mirror.wait_settled(0.1)


def test_given_a_corner_of_the_square_then_it_is_outside_of_optotunes_circle(tmp_path):
    with mirror_bench("optotune-mre2", LOCAL, tmp_path) as bench:
        mirror = bench.mirror(limit_mrad=800.0)
        with pytest.raises(InstrumentError, match=r"cannot point to \(750, 750\) mrad"):
            mirror.move_to(750.0, 750.0)
        assert not any(command.startswith("xy=") for command in bench.far.commands)


def test_a_controller_that_restarted_unnoticed_is_lost_and_enabled_again(tmp_path):
    # Its high voltage is off then, and nothing on the line would say that it points nowhere.
    class Controller(MirrorcleDevice):
        def operation(self, command):
            if command.startswith("MTI+GT 0.4"):
                self.restart()
            return super().operation(command)

    def device(motion):
        return Controller(motion, LIMIT_MRAD)

    with mirror_bench("mirrorcle-mti", LOCAL, tmp_path, device=device) as bench:
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
