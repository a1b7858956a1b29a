"""The serial faults, all of them on one dialect and some on the others, on either wire."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from functools import partial

import pytest
import serial

from tests.lab_files import wire_fault
from tests.wire import protocol_hang
from tests.wire.serial_bench import DIALECTS, LIMIT_MRAD, LOCAL, PARK_MRAD, answering, mirror_bench
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.mocks.wire.asi_tiger import AsiTigerDevice
from wavefocus.mocks.wire.mirrors import GenericMirrorDevice, MirrorcleDevice, OptotuneDevice

# All faults meet the first; the others some of them. Few go over TCP, which pyserial takes 0.3 s to close.
EACH = tuple(f"{dialect}/{LOCAL}" for dialect in DIALECTS)
FIRST, OVER_TCP = EACH[0], "generic/tcp"
# Long enough that a busy machine answers in time where it shall, short enough to wait for where it shall not.
ANSWER_S = 0.25


def bench_at(where, folder, *faults):
    return mirror_bench(*where.split("/"), folder, *faults)


def move_fault(kind, count=1, **more):
    return wire_fault("mirror", kind, "move", at_call=1, count=count, **more)


def moves(bench):
    return [command for command in bench.far.commands if command.startswith(DIALECTS[bench.dialect].move)]


@pytest.mark.parametrize(
    ("where", "kind", "count", "failure", "said"),
    [
        *((FIRST, kind, 1, "", 2) for kind in ("silent", "late", "truncated")),
        *((where, "garbled", 1, "", 2) for where in EACH),
        (FIRST, "silent", 2, "asked twice", 2),
        (OVER_TCP, "garbled", 2, "asked twice", 2),
        *((where, "refused", 1, DIALECTS[where.split("/")[0]].refusal, 1) for where in EACH),
    ],
)
def test_a_faulty_answer_then_the_move_is_asked_again_or_fails_and_the_next_is_done(
    where, kind, count, failure, said, tmp_path
):
    fault = move_fault(kind, count, seconds=1.5 * ANSWER_S if kind == "late" else 0.0)
    with bench_at(where, tmp_path, fault) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        if not failure:
            bench.check_move(mirror)
        else:
            with pytest.raises(TransientInstrumentError, match=failure) as caught:
                mirror.move_to(40.0, -25.0)
            assert f"({bench.dialect} at " in caught.value.instrument
            assert "moving to (40.000, -25.000) mrad" in caught.value.operation
        assert len(moves(bench)) == said
        if failure:
            with pytest.raises(TransientInstrumentError, match="latest move failed"):
                mirror.wait_settled(10.0)
        bench.check_move(mirror, -40.0, 25.0)


def test_an_answer_later_than_all_patience_then_it_is_not_taken_for_the_next_one(tmp_path):
    with bench_at(FIRST, tmp_path, move_fault("late", seconds=6 * ANSWER_S)) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        with pytest.raises(TransientInstrumentError):
            mirror.move_to(40.0, -25.0)
        for _ in range(10):
            with suppress(InstrumentLostError, TransientInstrumentError):
                mirror.move_to(-40.0, 25.0)
                break
        mirror.wait_settled(10.0)
        assert bench.stands_at(-40.0, 25.0)


@pytest.mark.parametrize(
    ("dialect", "device", "target_mrad", "refusal", "passing", "said"),
    [
        ("generic", None, (300.0, 0.0), r"ERR 3.*limit_mrad in the rig file", False, 1),
        ("asi-tiger", answering(AsiTigerDevice, "M ", ":N-4"), (40.0, -25.0), ":N-4", False, 2),
        ("optotune-mre2", None, (750.0, 750.0), r"cannot point to \(750, 750\) mrad", False, 0),  # beyond its circle
        *(("optotune-mre2", answering(OptotuneDevice, "xy=", answer), (40.0, -25.0), f"answers {answer}", passing, 1)
          for answer, passing in (("OU", False), ("OL", False), ("NO", True), ("ERROR 17", True))),
    ],
)  # fmt: skip
def test_a_refused_move_can_be_tried_again_only_where_that_can_help(
    dialect, device, target_mrad, refusal, passing, said, tmp_path
):
    limits = {"limit_mrad": 155.0, "park_mrad": (-150.0, -150.0)} if dialect == "asi-tiger" else {"limit_mrad": 800.0}
    with mirror_bench(dialect, LOCAL, tmp_path, device=device) as bench:
        mirror = bench.mirror(**limits)
        with pytest.raises(InstrumentError, match=refusal) as caught:
            mirror.move_to(*target_mrad)
        assert type(caught.value) is (TransientInstrumentError if passing else InstrumentError)
        assert len(moves(bench)) == said
        if said:
            with pytest.raises(TransientInstrumentError, match="latest move failed"):
                mirror.wait_settled(0.1)


@pytest.mark.parametrize("where", [FIRST, OVER_TCP])
def test_device_that_stops_reading_then_it_is_lost_and_found_again_after_replugging(where, tmp_path):
    with bench_at(where, tmp_path, move_fault("stalled")) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        with pytest.raises(TransientInstrumentError):
            mirror.move_to(40.0, -25.0)
        with pytest.raises(InstrumentLostError, match="stopped answering"):
            mirror.move_to(40.0, -25.0)
        bench.far.unplug()
        bench.far.plug()
        mirror.reconnect()
        bench.check_move(mirror)


@pytest.mark.parametrize(
    ("where", "operation"),
    [(OVER_TCP, "move"), *((FIRST, name) for name in ("move", "move under way", "identify", "park", "wait"))],
)
def test_an_unplugged_device_then_it_is_lost_until_it_is_back_at_the_same_place(where, operation, tmp_path):
    faults = [wire_fault("mirror", "unplugged", "move", at_call=2)] if operation == "move under way" else []
    with bench_at(where, tmp_path, *faults) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S, settle_s=0.0)
        port = bench.far.address
        mirror.move_to(40.0, -25.0)
        if not faults:
            bench.far.unplug()
        actions = {"wait": lambda: mirror.wait_settled(10.0), "identify": mirror.identify, "park": mirror.park}
        with pytest.raises(InstrumentLostError, match=r"connection broke|no such port|nothing there"):
            actions.get(operation, lambda: mirror.move_to(0.0, 0.0))()
        with pytest.raises(InstrumentLostError, match=r"there is no such port now|nothing there accepts"):
            mirror.reconnect()
        with pytest.raises(InstrumentLostError, match="connection is lost"):
            mirror.move_to(0.0, 0.0)
        bench.far.plug()
        assert bench.far.address == port
        mirror.reconnect()
        bench.check_move(mirror)


@pytest.mark.parametrize("where", EACH)
def test_given_a_connection_that_broke_and_is_back_then_parking_finds_it(where, tmp_path):
    with bench_at(where, tmp_path) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        mirror.move_to(40.0, -25.0)
        bench.far.unplug()
        bench.far.plug()
        mirror.park()
        mirror.wait_settled(10.0)
        assert bench.stands_at(*PARK_MRAD)


@pytest.mark.parametrize("dialect", [name for name, facts in DIALECTS.items() if facts.names_itself])
def test_another_name_once_is_asked_again_and_twice_is_another_device_for_good(dialect, tmp_path):
    # On opening it is asked twice; its first answer to `identify` is another's, and all from the next `identify` on.
    faults = [wire_fault("mirror", "impostor", "identify", at_call=at, count=count) for at, count in ((3, 1), (5, 100))]
    with mirror_bench(dialect, LOCAL, tmp_path, *faults) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        assert mirror.identify()
        with pytest.raises(InstrumentError, match=r"another device answers in its place: .*, and not "):
            mirror.identify()
        bench.far.unplug()
        bench.far.plug()
        with pytest.raises(InstrumentError, match="another device answers in its place") as caught:
            mirror.reconnect()
        assert not isinstance(caught.value, InstrumentLostError)


@pytest.mark.parametrize(
    ("where", "sentence"),
    [(FIRST, "another program has the port open|one program at a time"), (OVER_TCP, "one program at a time")],
)
def test_given_a_port_that_is_in_use_then_a_second_driver_is_refused(where, sentence, tmp_path):
    with bench_at(where, tmp_path) as bench:
        first = bench.mirror(answer_s=ANSWER_S)
        with pytest.raises(InstrumentLostError, match=sentence):
            bench.mirror(answer_s=ANSWER_S)
        bench.check_move(first)


class SlowMirrorcle(MirrorcleDevice):
    baud = 9600


SILENT = wire_fault("mirror", "silent", "any", at_call=1, count=1000)
MISUNDERSTOOD = [
    ("generic", "generic", [SILENT], {}, r"asking who it is: no answer came; switch it on.*driver and baud"),
    ("asi-tiger", "generic", [], {}, "driver and baud in the rig file"),
    # A TCP connection has no baud.
    ("generic", "generic", [], {"baud": 9600}, r"broke off after b'\\x.*driver and baud in the rig"),
    ("mirrorcle-mti", "mirrorcle-mti", [], {}, "115200 and 460800 baud"),
]


@pytest.mark.parametrize(
    ("device", "driver", "faults", "changes", "sentence"), MISUNDERSTOOD if LOCAL == "pty" else MISUNDERSTOOD[:2]
)
def test_a_device_that_cannot_be_understood_then_opening_says_what_to_check(
    device, driver, faults, changes, sentence, tmp_path
):
    kind = (lambda motion: SlowMirrorcle(motion, LIMIT_MRAD)) if device == "mirrorcle-mti" else None
    with mirror_bench(device, LOCAL, tmp_path, *faults, device=kind) as bench:
        bench.dialect = driver
        with pytest.raises(InstrumentLostError, match=sentence):
            bench.mirror(answer_s=ANSWER_S, patience_s=0.1, **changes)


def test_a_board_that_starts_is_waited_for_and_lines_nobody_asked_for_are_no_answers(tmp_path):
    class Chatty(GenericMirrorDevice):
        """Reports its motion on its own, in the very words of answers."""

        def answer(self, command):
            return super().answer(command) + ("0*30\r\n1*31\r\n" if command.startswith("XY=") else "")

    starting = wire_fault("mirror", "silent", "any", at_call=1, count=2)  # a board that starts when the port opens
    with mirror_bench("generic", LOCAL, tmp_path, starting, device=Chatty, settle_s=0.2) as bench:
        mirror = bench.mirror(settle_s=0.0, answer_s=ANSWER_S, patience_s=10.0)
        for target in ((10.0, 0.0), (20.0, 0.0)):
            with suppress(TransientInstrumentError):
                bench.check_move(mirror, *target)


def test_a_checksum_in_small_letters_then_a_mirror_is_read_and_found_again(tmp_path):
    class SmallLetters(GenericMirrorDevice):
        def answer(self, command):
            text, star, sum_ = super().answer(command).rpartition("*")
            return text + star + sum_.lower()

    device = partial(SmallLetters, identity="wavefocus,generic mirror,0001,1.x")  # its checksum is 6B
    with mirror_bench("generic", LOCAL, tmp_path, move_fault("silent"), device=device) as bench:
        bench.check_move(bench.mirror(answer_s=ANSWER_S), 12.5, -7.25)


def test_given_a_peer_that_never_ends_its_line_then_opening_ends(tmp_path):
    class Babbling(GenericMirrorDevice):
        def answer(self, command):
            return "wavefocus " * 1000

    with (
        mirror_bench("generic", "tcp", tmp_path, device=Babbling) as bench,
        pytest.raises(InstrumentLostError, match="no end of the line"),
    ):
        bench.mirror(answer_s=10.0)


@pytest.mark.parametrize(("dialect", "way_out"), [("asi-tiger", "reconnect"), ("generic", "park")])
def test_a_call_that_hangs_then_others_say_so_in_bounded_time_and_the_mirror_goes_on(
    dialect, way_out, tmp_path, monkeypatch
):
    monkeypatch.setattr(serial, "protocol_handler_packages", ["serial.urlhandler", "tests.wire"])
    for event in (protocol_hang.hung, protocol_hang.released):
        event.clear()
    with mirror_bench(dialect, "tcp", tmp_path) as bench, ThreadPoolExecutor(1) as thread, ExitStack() as after:
        after.callback(protocol_hang.released.set)
        mirror = bench.mirror(port=bench.far.address.replace("socket:", "hang:"), answer_s=ANSWER_S)
        protocol_hang.hangs.set()
        moving = thread.submit(mirror.move_to, 40.0, -25.0)
        protocol_hang.hung.wait()
        with pytest.raises(InstrumentLostError, match="an earlier call hangs"):
            mirror.where_mrad()
        getattr(mirror, way_out)()
        if way_out == "park":
            mirror.wait_settled(10.0)
            assert bench.stands_at(*PARK_MRAD)
        bench.check_move(mirror, -40.0, 25.0)
        mirror.close()
        protocol_hang.released.set()
        with pytest.raises(InstrumentLostError):
            moving.result()  # what hung finds its port closed, and nothing else goes wrong there
