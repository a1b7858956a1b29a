"""A call that hangs in a port's driver: nobody waits for it, neither to close the mirror nor to connect it again."""

import threading

import pytest
import serial

from tests.wire.hanging_ports import protocol_hang
from tests.wire.serial_bench import PARK_MRAD, mirror_bench
from wavefocus.drivers.errors import InstrumentLostError


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
