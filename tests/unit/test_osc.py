"""Orders by OSC: packets of other programs, wrong ones, floods, and the end."""

import threading
from collections.abc import Mapping
from queue import Queue

import numpy as np
import pytest
from oscpy.client import OSCClient
from oscpy.parser import format_bundle
from pythonosc.osc_message import OscMessage
from pythonosc.osc_message_builder import OscMessageBuilder
from pythonosc.udp_client import SimpleUDPClient

from wavefocus.live_session.osc import OscInput, OscMessages, address_of, read_message, split_packet
from wavefocus.storage.errors import InputError


def test_given_any_bytes_then_osc_refuses_or_reads_them():
    random, messages = np.random.default_rng(1), OscMessages()
    for size in range(400):
        noise = random.bytes(size)
        for datagram in (noise, b"#bundle\x00" + noise, b"/source/a/position\x00\x00,ff\x00" + noise):
            assert all(isinstance(one, Mapping | InputError) for one in messages.read(datagram))


def osc(address, *values):
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)
    return builder.build().dgram


def bundle(*messages):
    return b"#bundle\0" + bytes(7) + b"\1" + b"".join(len(one).to_bytes(4, "big") + one for one in messages)


def test_given_what_other_programs_write_then_it_is_read_as_they_read_it():
    for values in ([], [1, 2.5], ["text"], [b"blob"], [True, False, None], [2**40], [[1, [2.0]], "x"]):
        datagram = osc("/a/b", *values)
        assert read_message(datagram) == ("/a/b", OscMessage(datagram).params)
    parts = [[b"/source/a/position", [1.0, 2.0]], [b"/source/b/position", [3, 4.0, 0.5]]]
    ours = [read_message(one) for one in split_packet(format_bundle(parts)[0])]
    assert ours == [(address.decode(), values) for address, values in parts]
    assert [read_message(one) for one in split_packet(bundle(osc("/a"), bundle(osc("/b"), osc("/c")), osc("/d")))] == [
        ("/a", []), ("/b", []), ("/c", []), ("/d", [])
    ]  # fmt: skip


def test_bundle_of_positions_then_newest_of_each_source_is_read_and_rest_bounded():
    messages = OscMessages()
    many = [osc(f"/source/f{index % 20}/position", float(index), 0.0) for index in range(1400)]
    orders = list(messages.read(bundle(*many)))
    assert [order["at_mm"][0] for order in orders] == [float(index) for index in range(1380, 1400)]
    # What lies between two positions keeps both; an amplitude is not lost with the position that it came with.
    one = [osc("/source/a/position", 1.0, 1.0, 0.5), osc("/source/a/position", 2.0, 2.0), osc("/source/a/end"),
           osc("/source/a/position", 3.0, 3.0)]  # fmt: skip
    assert [order["order"] for order in messages.read(*one)] == ["move", "move", "end_source", "move"]
    names = [osc(f"/source/n{index}/position", 1.0, 1.0) for index in range(1400)]
    refused, *orders = messages.read(bundle(*names))
    assert isinstance(refused, InputError)
    assert [order["name"] for order in orders] == [f"n{index}" for index in range(1200, 1400)]


def test_given_a_receiver_whose_order_hangs_then_closing_comes_to_its_end():
    hangs, entered = threading.Event(), threading.Event()
    receiver = OscInput("127.0.0.1", 0)

    def receive(order, arrived_s):
        entered.set()
        hangs.wait(60)

    receiver.start(receive)
    host, _, port = receiver.address.rpartition(":")
    with SimpleUDPClient(host, int(port)) as sender:
        sender.send_message("/end", [])
    assert entered.wait(10)
    receiver.close()
    hangs.set()


@pytest.mark.parametrize("client", ["python-osc", "oscpy"])
def test_given_other_programs_as_clients_then_their_orders_arrive(client):
    orders: Queue[object] = Queue()
    receiver = OscInput("127.0.0.1", 0)
    receiver.start(lambda order, arrived_s: orders.put(order))
    host, _, port = receiver.address.rpartition(":")
    if client == "python-osc":
        with SimpleUDPClient(host, int(port)) as sender:
            sender.send_message("/source/a/position", [1.5, -2.0, 0.25])
    else:
        other = OSCClient(host, int(port), encoding="utf8")
        other.send_message("/source/a/position", [1.5, -2.0, 0.25])
        other.sock.close()
    assert orders.get(timeout=10) == {"order": "move", "name": "a", "at_mm": [1.5, -2.0], "amplitude": 0.25}
    receiver.close()


@pytest.mark.parametrize("text", ["", "9000", "host:", "host:-1", "host:65536", "host:9e3", ":9000"])
def test_given_an_address_that_is_none_then_it_is_refused(text):
    with pytest.raises(InputError, match="--osc"):
        address_of(text)
