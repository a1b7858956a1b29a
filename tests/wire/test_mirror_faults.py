"""The serial faults, all of them on one dialect and some on the others, on either wire."""

import socket
import threading

import pytest
import serial

from tests.wire.hanging_ports import protocol_hang
from tests.wire.serial_bench import DIALECTS, EACH, FIRST, LOCAL, OVER_TCP, PARK_MRAD, mirror_bench
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.mocks.wire import WireFault
from wavefocus.mocks.wire.mirrors import GenericMirrorDevice

NAMED = [where for where in EACH if DIALECTS[where.split("/")[0]].names_itself]
# Long enough that a busy machine answers in time where it shall, short enough to wait for where it shall not.
ANSWER_S = 0.25


def bench_at(where, folder, *faults, **settings):
    dialect, wire = where.split("/")
    return mirror_bench(dialect, wire, folder, *faults, **settings)


def move_fault(kind, count=1, **more):
    return WireFault("mirror", kind, "move", at_call=1, count=count, **more)


def moves(bench):
    return [command for command in bench.far.commands if command.startswith(DIALECTS[bench.dialect].move)]


@pytest.mark.parametrize(
    ("where", "kind"),
    [*((FIRST, kind) for kind in ("silent", "late", "truncated")), *((where, "garbled") for where in EACH)],
)
def test_one_answer_that_cannot_be_had_then_the_move_is_said_once_more_and_done(where, kind, tmp_path):
    fault = move_fault(kind, seconds=1.5 * ANSWER_S if kind == "late" else 0.0)
    with bench_at(where, tmp_path, fault) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        bench.check_move(mirror)
        assert len(moves(bench)) == 2
        bench.check_move(mirror, -40.0, 25.0)


@pytest.mark.parametrize(("where", "kind"), [(FIRST, "silent"), (OVER_TCP, "garbled")])
def test_two_answers_that_cannot_be_had_then_attempt_fails_and_next_one_works(where, kind, tmp_path):
    with bench_at(where, tmp_path, move_fault(kind, count=2)) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        with pytest.raises(TransientInstrumentError, match="asked twice") as caught:
            mirror.move_to(40.0, -25.0)
        assert f"({bench.dialect} at " in caught.value.instrument
        assert "moving to (40.000, -25.000) mrad" in caught.value.operation
        assert len(moves(bench)) == 2
        with pytest.raises(TransientInstrumentError, match="latest move failed"):
            mirror.wait_settled(10.0)
        bench.check_move(mirror)


def test_an_answer_later_than_all_patience_then_it_is_not_taken_for_the_next_one(tmp_path):
    with bench_at(FIRST, tmp_path, move_fault("late", seconds=6 * ANSWER_S)) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        with pytest.raises(TransientInstrumentError):
            mirror.move_to(40.0, -25.0)
        for _ in range(10):
            try:
                mirror.move_to(-40.0, 25.0)
                break
            except (InstrumentLostError, TransientInstrumentError):
                continue
        mirror.wait_settled(10.0)
        assert bench.stands_at(-40.0, 25.0)


@pytest.mark.parametrize("where", EACH)
def test_given_a_refusal_then_its_code_is_reported_and_the_next_attempt_works(where, tmp_path):
    with bench_at(where, tmp_path, move_fault("refused")) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        with pytest.raises(TransientInstrumentError, match=DIALECTS[bench.dialect].refusal):
            mirror.move_to(40.0, -25.0)
        assert len(moves(bench)) == 1
        bench.check_move(mirror)


def test_given_an_angle_that_the_device_does_not_reach_then_no_new_attempt_is_made(tmp_path):
    with mirror_bench("generic", LOCAL, tmp_path) as bench:
        with pytest.raises(InstrumentError, match=r"ERR 3.*limit_mrad in the rig file") as caught:
            bench.mirror(limit_mrad=400.0).move_to(300.0, 0.0)
        assert not isinstance(caught.value, TransientInstrumentError)


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
    ("where", "operation"), [(OVER_TCP, "move"), *((FIRST, name) for name in ("move", "identify", "park", "wait"))]
)
def test_an_unplugged_device_then_it_is_lost_until_it_is_back_at_the_same_place(where, operation, tmp_path):
    with bench_at(where, tmp_path) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S, settle_s=0.0)
        port = bench.far.address
        mirror.move_to(40.0, -25.0)
        bench.far.unplug()
        actions = {
            "move": lambda: mirror.move_to(0.0, 0.0),
            "wait": lambda: mirror.wait_settled(10.0),
            "identify": mirror.identify,
            "park": mirror.park,
        }
        with pytest.raises(InstrumentLostError, match=r"connection broke|no such port|nothing there"):
            actions[operation]()
        with pytest.raises(InstrumentLostError, match=r"there is no such port now|nothing there accepts"):
            mirror.reconnect()
        with pytest.raises(InstrumentLostError, match="connection is lost"):
            mirror.move_to(0.0, 0.0)
        bench.far.plug()
        assert bench.far.address == port
        mirror.reconnect()
        bench.check_move(mirror)


def test_a_plug_out_and_in_again_is_reconnected_until_it_works(tmp_path):
    fault = WireFault("mirror", "unplugged", "move", at_call=2, seconds=0.2)
    with bench_at(FIRST, tmp_path, fault) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        mirror.move_to(40.0, -25.0)
        with pytest.raises(InstrumentLostError):
            mirror.move_to(10.0, 10.0)
        back = False
        while not back:
            try:
                mirror.reconnect()
                back = True
            except InstrumentLostError:
                threading.Event().wait(0.05)
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


@pytest.mark.parametrize("where", NAMED)
def test_another_device_at_same_place_then_it_is_refused_for_good_and_both_are_named(where, tmp_path):
    # On opening it is asked twice; all after that is another's.
    fault = WireFault("mirror", "impostor", "identify", at_call=3, count=100)
    with bench_at(where, tmp_path, fault) as bench:
        mirror = bench.mirror(answer_s=ANSWER_S)
        with pytest.raises(InstrumentError, match=r"another device answers in its place: .*, and not "):
            mirror.identify()
        bench.far.unplug()
        bench.far.plug()
        with pytest.raises(InstrumentError, match="another device answers in its place") as caught:
            mirror.reconnect()
        assert not isinstance(caught.value, InstrumentLostError)


@pytest.mark.parametrize("where", NAMED)
def test_one_answer_with_another_name_then_it_is_asked_again_before_it_is_believed(where, tmp_path):
    with bench_at(where, tmp_path, WireFault("mirror", "impostor", "identify", at_call=3)) as bench:
        assert bench.mirror(answer_s=ANSWER_S).identify()


@pytest.mark.parametrize(
    ("where", "sentence"), [(FIRST, "another program has the port open"), (OVER_TCP, "one program at a time")]
)
def test_given_a_port_that_is_in_use_then_a_second_driver_is_refused(where, sentence, tmp_path):
    with bench_at(where, tmp_path) as bench:
        first = bench.mirror(answer_s=ANSWER_S)
        with pytest.raises(InstrumentLostError, match=sentence if where.endswith(LOCAL) else "one program at a time"):
            bench.mirror(answer_s=ANSWER_S)
        bench.check_move(first)


def test_given_a_device_that_never_answers_then_opening_ends_with_what_to_check(tmp_path):
    fault = WireFault("mirror", "silent", "any", at_call=1, count=1000)
    with (
        mirror_bench("generic", LOCAL, tmp_path, fault) as bench,
        pytest.raises(InstrumentLostError, match=r"asking who it is: no answer came; switch it on.*driver and baud"),
    ):
        bench.mirror(answer_s=ANSWER_S)


@pytest.mark.may_skip("a TCP connection has no baud")
@pytest.mark.skipif(LOCAL == "tcp", reason="a TCP connection has no baud")
def test_given_the_wrong_baud_then_opening_says_that_what_comes_is_no_text(tmp_path):
    with (
        mirror_bench("generic", LOCAL, tmp_path) as bench,
        pytest.raises(InstrumentLostError, match=r"answer broke off after b'\\x.*driver and baud in the rig file"),
    ):
        bench.mirror(baud=9600, answer_s=ANSWER_S)


def test_given_the_wrong_dialect_then_opening_says_that_the_answers_do_not_fit(tmp_path):
    with mirror_bench("asi-tiger", LOCAL, tmp_path) as bench:
        bench.dialect = "generic"
        with pytest.raises(InstrumentLostError, match="driver and baud in the rig file"):
            bench.mirror(answer_s=ANSWER_S)


def test_given_a_board_that_starts_when_the_port_opens_then_it_is_waited_for(tmp_path):
    fault = WireFault("mirror", "silent", "any", at_call=1, count=2)
    with mirror_bench("generic", LOCAL, tmp_path, fault) as bench:
        bench.check_move(bench.mirror(answer_s=ANSWER_S, patience_s=10.0))


def test_given_lines_that_nobody_asked_for_then_they_are_not_taken_for_answers(tmp_path):
    class Chatty(GenericMirrorDevice):
        """Reports its motion on its own, in the very words of answers."""

        def answer(self, command):
            return super().answer(command) + ("0*30\r\n1*31\r\n" if command.startswith("XY=") else "")

    with mirror_bench("generic", LOCAL, tmp_path, device=Chatty, settle_s=0.2) as bench:
        mirror = bench.mirror(settle_s=0.0, answer_s=ANSWER_S)
        for target in ((10.0, 0.0), (20.0, 0.0)):
            try:
                mirror.move_to(*target)
                mirror.wait_settled(10.0)
            except TransientInstrumentError:
                continue
            assert bench.stands_at(*target)


def test_given_a_peer_that_never_stops_sending_then_opening_ends(tmp_path):
    stop = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def babble():
            client, _ = server.accept()
            with client:
                client.settimeout(0.1)
                while not stop.is_set():
                    try:
                        client.send(b"wavefocus " * 100)
                    except TimeoutError:
                        continue
                    except OSError:
                        return

        thread = threading.Thread(target=babble)
        thread.start()
        with mirror_bench("generic", LOCAL, tmp_path) as bench:
            port = f"socket://127.0.0.1:{server.getsockname()[1]}"
            try:
                with pytest.raises(InstrumentLostError, match="no end of the line"):
                    bench.mirror(port=port, answer_s=10.0)
            finally:
                stop.set()
                thread.join()


@pytest.fixture
def hung_move(tmp_path, request):
    """A mirror whose move hangs in the driver of its port."""
    serial.protocol_handler_packages.append("tests.wire.hanging_ports")
    protocol_hang.released.clear()
    with mirror_bench(request.param, "tcp", tmp_path) as bench:
        mirror = bench.mirror(port=bench.far.address.replace("socket:", "hang:"), answer_s=0.1)
        protocol_hang.hangs.set()
        failures = []

        def move():
            try:
                mirror.move_to(40.0, -25.0)
            except InstrumentLostError as failure:
                failures.append(failure)

        thread = threading.Thread(target=move, daemon=True)
        thread.start()
        protocol_hang.hung.acquire()
        protocol_hang.hangs.clear()
        yield bench, mirror
        protocol_hang.released.set()
        thread.join()
        assert len(failures) == 1  # what hung finds its port closed, and nothing else goes wrong there
    serial.protocol_handler_packages.remove("tests.wire.hanging_ports")


@pytest.mark.parametrize("hung_move", ["asi-tiger"], indirect=True)
def test_given_a_call_that_hangs_then_the_mirror_is_connected_again_without_it(hung_move):
    bench, mirror = hung_move
    mirror.reconnect()
    bench.check_move(mirror, -40.0, 25.0)


@pytest.mark.parametrize("hung_move", ["generic"], indirect=True)
def test_a_call_that_hangs_then_parking_connects_again_and_closing_does_not_wait(hung_move):
    bench, mirror = hung_move
    mirror.park()
    mirror.wait_settled(10.0)
    assert bench.stands_at(*PARK_MRAD)
    mirror.close()


@pytest.mark.parametrize("hung_move", ["generic"], indirect=True)
def test_given_a_call_that_hangs_then_another_call_says_so_in_bounded_time(hung_move):
    _, mirror = hung_move
    with pytest.raises(InstrumentLostError, match="an earlier call hangs"):
        mirror.where_mrad()
    mirror.close()
