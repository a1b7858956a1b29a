"""Whatever comes over a line, a position is right or it is an error; arbitrary bytes are never one."""

import itertools
import socket
import time
from contextlib import closing
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.lab_files import wire_fault
from tests.wire.serial_bench import LOCAL, mirror_bench
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.serial_device import SerialMirror
from wavefocus.drivers.serial_line import LineSettings, NoAnswerError, SerialLine

TARGET_MRAD = (40.0, -25.0)
ALWAYS = tuple(
    wire_fault("mirror", "garbled", operation, at_call=1, count=10**9) for operation in ("where", "busy", "move")
)


def garbled_mirror(dialect):
    """A mirror at `TARGET_MRAD`, and what changes its answers."""

    @pytest.fixture(scope="module")
    def garbled(tmp_path_factory):
        garbler = SimpleNamespace(change=bytes)

        def change(answer):
            return garbler.change(answer)

        with mirror_bench(
            dialect, LOCAL, tmp_path_factory.mktemp("port"), *ALWAYS, garbler=change, settle_s=0.0
        ) as bench:
            mirror = bench.mirror(answer_s=0.05, settle_s=0.0)
            mirror.move_to(*TARGET_MRAD)
            yield bench, mirror, garbler

    return garbled


garbled, checked = garbled_mirror("asi-tiger"), garbled_mirror("generic")


def where(mirror):
    """Where it says that it points, asked until it answers: no fault is left behind for the next example."""
    for _ in range(50):
        try:
            return mirror.where_mrad()
        except InstrumentError:
            time.sleep(0.02)
    raise AssertionError("the mirror was not found again")


def disturbed(bench, change, act):
    """What an action yields while answers are changed, None where it is an error."""
    _, mirror, garbler = bench
    garbler.change = change
    try:
        return act(mirror)
    except InstrumentError:
        return None
    finally:
        garbler.change = bytes


def replaced(answer, at, to):
    return answer[: at % len(answer)] + bytes([to]) + answer[at % len(answer) + 1 :]


@given(garbage=st.binary(max_size=40), place=st.sampled_from(["instead", "before", "behind"]))
def test_arbitrary_bytes_for_or_around_an_answer_then_position_is_right_or_an_error(garbled, garbage, place):
    changed = {"instead": lambda _: garbage, "before": lambda answer: garbage + answer}
    found = disturbed(garbled, changed.get(place, lambda answer: answer + garbage), SerialMirror.where_mrad)
    assert found is None or (found == pytest.approx(TARGET_MRAD, abs=0.01) and place != "instead")
    assert where(garbled[1]) == pytest.approx(TARGET_MRAD, abs=0.01)


@given(at=st.integers(0, 30), to=st.integers(0, 255))
def test_given_a_changed_byte_then_a_line_with_a_checksum_is_right_or_an_error(checked, at, to):
    found = disturbed(checked, lambda answer: replaced(answer, at, to), SerialMirror.where_mrad)
    assert found is None or found == pytest.approx(TARGET_MRAD, abs=0.01)
    where(checked[1])


@given(
    x_mrad=st.floats(-200, 200),
    at=st.integers(0, 30),
    to=st.sampled_from([*b"0123456789-. :ABNXYOK*\r\n", 0, 0xFF]),
    every=st.integers(1, 3),
)
def test_answers_changed_at_will_then_waiting_ends_well_only_where_the_beam_stands(garbled, x_mrad, at, to, every):
    count = itertools.count(1)

    def settled(mirror):
        mirror.move_to(x_mrad, 10.0)
        mirror.wait_settled(0.1)
        return True

    if disturbed(garbled, lambda answer: answer if next(count) % every else replaced(answer, at, to), settled):
        assert garbled[0].motion.where_mrad() == pytest.approx((x_mrad, 10.0), abs=0.5)
    where(garbled[1])


@pytest.fixture(scope="module")
def wired():
    with socket.create_server(("127.0.0.1", 0)) as server:
        line = SerialLine("line", f"socket://127.0.0.1:{server.getsockname()[1]}", LineSettings(115200, "\n", 5.0))
        line.open()
        client, _ = server.accept()
        with client, closing(line):
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            yield line, client


TEXT = st.text(st.characters(min_codepoint=32, max_codepoint=126), max_size=30)


@given(
    texts=st.lists(TEXT, min_size=1, max_size=4),
    end=st.sampled_from([b"\n", b"\r\n"]),
    sizes=st.lists(st.integers(1, 20), min_size=1),
)
def test_given_lines_cut_anywhere_then_they_arrive_whole_and_in_order(wired, texts, end, sizes):
    line, client = wired
    sent = b"".join(text.encode() + end for text in texts)
    for size in itertools.cycle(sizes):
        client.sendall(sent[:size])
        sent = sent[size:]
        if not sent:
            break
    assert [line.receive(time.monotonic() + 30) for _ in texts] == texts
    assert not line.received()


def test_half_a_line_and_bytes_that_are_no_text_are_told_as_they_came(wired):
    line, client = wired
    client.sendall(b"12.3")
    with pytest.raises(NoAnswerError, match=r"broke off after b'12\.3'"):
        line.receive(time.monotonic() + 0.2)
    client.sendall(b"4\n")
    assert line.receive(time.monotonic() + 30) == "12.34"
    client.sendall(b"\xff1\n")
    with pytest.raises(NoAnswerError, match="not text"):
        line.receive(time.monotonic() + 30)
