"""The loop of a live session on a scripted player that keeps no time; orders as objects and by OSC."""

import functools
import math
import threading
import time
from collections.abc import Callable, Mapping
from concurrent.futures import Future
from queue import Queue

import numpy as np
import pytest
from oscpy.client import OSCClient
from oscpy.parser import format_bundle
from pythonosc.osc_message import OscMessage
from pythonosc.osc_message_builder import OscMessageBuilder
from pythonosc.udp_client import SimpleUDPClient

from tests.unit.plate_banks import RATE_HZ, TAPS, plate_bank
from wavefocus import InputError, Sine, load_scene
from wavefocus.config.messages import Message, Refused
from wavefocus.config.messages.live import EndLive, EndSource, LiveNotice, LiveState, MoveSource
from wavefocus.config.scene import Regularisation
from wavefocus.drivers.errors import InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.drivers.timeouts import BoundedPlayer
from wavefocus.live_session.orders import MAX_WAITING, Inbox, UseSignal, order_of
from wavefocus.live_session.osc import OscInput, OscMessages, address_of, read_message, split_packet
from wavefocus.live_session.session import LiveSession
from wavefocus.rendering.drive.coil_limits import DriveLimits
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.live.engine import LiveEngine
from wavefocus.rendering.live.limiter import LiveLimiter
from wavefocus.rendering.live.lives import emitted_by
from wavefocus.rendering.live.recording import SessionRecording

INTERFACE_HZ = round(RATE_HZ)
BLOCK = 20
BANK = plate_bank()
CHANNELS = tuple(range(BANK.actuators))
AMPLITUDE = 1e-3
AHEAD_S = 60.0


class ScriptedPlayer:
    """A player that takes pieces; `script` is called with the number of each piece, from 0."""

    channels, full_scale_v, latency_s = len(CHANNELS), 5.0, 0.0
    identity = DeviceIdentity("", "scripted player")

    def __init__(self, script, gone_at_begin=()):
        self.pieces: list[np.ndarray] = []
        self.written_s = -math.inf
        self.begun = self.reconnected = 0
        self.ended = False
        self._script, self._gone_at_begin = script, gone_at_begin

    def begin_pieces(self, channels, sample_rate_hz, ahead_s):
        self.begun += 1
        if self.begun in self._gone_at_begin:
            raise InstrumentLostError("player", "beginning", "it is gone", "")

    def add_piece(self, volts):
        self.written_s = time.monotonic()
        self.pieces.append(volts)
        self._script(len(self.pieces) - 1)
        return AHEAD_S

    def end_pieces(self):
        self.ended = True

    def reconnect(self):
        self.reconnected += 1

    def wait(self, timeout_s) -> None: ...

    def mute(self) -> None: ...


class Bench:
    """A session with its player; orders are given by a script of the piece's number."""

    def __init__(
        self, script, *, look_ahead=0, limits=None, limiter=LiveLimiter, interface_hz=INTERFACE_HZ, recording=None,
        gain=1.0, gone=(),
    ):  # fmt: skip
        engine = LiveEngine(
            BANK, block_samples=BLOCK, look_ahead_samples=look_ahead, record=recording is not None,
            regularisation=Regularisation(saturation=0.5), frame_rate_hz=float(interface_hz),
        )  # fmt: skip
        self.messages: list[Message] = []
        self.tape = ScriptedPlayer(lambda piece: script.get(piece, lambda _: None)(self.session), gone)
        self.limiter = limiter(limits or DriveLimits(), np.full(len(CHANNELS), 5.0), interface_hz)
        self.session = LiveSession(
            engine, BoundedPlayer(self.tape, 20.0), self.limiter, self.messages.append,
            channels=CHANNELS, ahead_s=AHEAD_S, adapts=True, gives_up_s=1.0, gain=gain, recording=recording,
        )  # fmt: skip
        self.session.run()
        self.frames = np.concatenate(self.tape.pieces, axis=1)

    def notices(self):
        return [one.code for one in self.messages if isinstance(one, LiveNotice)]


def move(name, x_mm, y_mm=0.0, amplitude=AMPLITUDE):
    return lambda session: session.order(MoveSource(name, (x_mm, y_mm), amplitude), time.monotonic())


def end(session):
    session.order(EndLive(), time.monotonic())


def test_with_sufficient_look_ahead_the_recorded_scene_renders_to_what_was_played(tmp_path):
    script: dict[int, Callable] = {piece: move("a", 0.5 * piece, 3.0) for piece in range(30)}
    script[7] = lambda session: (script_move(session), session.order(UseSignal("a", emitted_by(SINE, RATE_HZ)), 0.0))
    script_move, second = move("a", 3.0, 3.0), move("b", -9.0, 8.0, 0.5 * AMPLITUDE)
    script |= {20: lambda session: (move("a", 10.0, 3.0)(session), second(session)), 30: end}
    recording = SessionRecording(
        tmp_path / "felt", rate_hz=RATE_HZ, regularisation=Regularisation(saturation=0.5), interpolation="nearest"
    )
    # What is decided at each block's begin is known a look-ahead before it counts, here with a block to spare.
    with recording:
        bench = Bench(script, look_ahead=TAPS - 1 + 4 * BLOCK, recording=recording, gain=0.5)
    drive, _ = render_with_report(load_scene(tmp_path / "felt" / "scene.toml"), BANK)
    drive_v = drive.drive_v[:, TAPS - 1 :]
    played_v = bench.frames[:, bench.limiter.look_ahead_frames :]
    assert np.abs(drive_v).max() > 0
    assert 30 * BLOCK < drive_v.shape[1] < played_v.shape[1]
    drive_v = np.pad(drive_v, [(0, 0), (0, played_v.shape[1] - drive_v.shape[1])])
    np.testing.assert_allclose(played_v, drive_v, rtol=0, atol=1e-4 * np.abs(drive_v).max())
    assert bench.tape.ended
    assert bench.session.ended().positions == 31
    assert not bench.session.unrecorded
    assert bench.notices() == []
    # Stopped before a second knot is final, it leaves no file: another session may be recorded there.
    silent = SessionRecording(
        tmp_path / "none", rate_hz=RATE_HZ, regularisation=Regularisation(), interpolation="nearest"
    )
    with silent:
        bench = Bench({3: move("a", 0.0), 4: LiveSession.stop}, recording=silent)
    assert bench.session.unrecorded
    assert list((tmp_path / "none").iterdir()) == []


def test_given_positions_that_go_on_after_the_end_then_the_session_ends_all_the_same():
    script: dict[int, Callable] = {piece: move("a", 0.0) for piece in range(80)}
    assert len(Bench({**script, 10: end}).tape.pieces) < 40


def test_given_orders_just_before_the_end_then_they_are_answered_before_it():
    bench = Bench({3: lambda session: (move("a", 500.0)(session), end(session))})
    assert [type(one) for one in bench.messages] == [Refused]


SINE = Sine(120.0, 0.3)


def test_given_limits_then_no_frame_is_beyond_them_and_it_is_said():
    script = {piece: move("a", 0.0, 0.0, 1e6) for piece in range(40)}
    bench = Bench({**script, 40: end}, limits=DriveLimits(0.01), interface_hz=4800)
    assert 0.005 < np.abs(bench.frames).max() <= 0.01
    assert bench.notices() == ["limited"]
    assert bench.session.ended().limited_s > 0


def test_a_player_that_runs_dry_or_is_lost_begins_again_and_counts_sources():
    def dry(session):
        raise TransientInstrumentError("player", "playing", "underflow", "")

    def lost(session):
        raise InstrumentLostError("player", "playing", "it is gone", "")

    script: dict[int, Callable] = {piece: move("a", 0.0) for piece in range(60)}
    bench = Bench({**script, 10: dry, 20: lost, 60: end}, gone=[3])
    assert (bench.tape.begun, bench.tape.reconnected) == (4, 2)
    assert bench.session.ended().underruns == 1
    assert [code for code in bench.notices() if code != "late"] == ["underrun", "lost", "reconnected"]
    assert any(isinstance(one, LiveState) and one.underruns == 1 for one in bench.messages)


class SlowLimiter(LiveLimiter):
    """Takes twice the time of a block."""

    def limit(self, block):
        time.sleep(2 * BLOCK / RATE_HZ)
        return super().limit(block)


def test_blocks_that_take_too_long_then_underruns_say_so_and_all_sources_sound_on():
    def dry(session):
        raise TransientInstrumentError("player", "playing", "underflow", "")

    def both(session):
        move("a", 0.0)(session)
        move("b", 9.0)(session)

    bench = Bench({**dict.fromkeys(range(45), both), 10: dry, 30: dry, 45: end}, limiter=SlowLimiter)
    underruns = [one.sentence for one in bench.messages if isinstance(one, LiveNotice) and one.code == "underrun"]
    assert bench.session.ended().underruns == 2
    assert "computing a block of 10 ms takes " in underruns[0]
    assert "fewer sources" in underruns[0]
    states = [one for one in bench.messages if isinstance(one, LiveState)]
    assert [[source.name for source in state.sources] for state in states[:2]] == [["a", "b"]] * 2
    assert all(state.load >= 2.0 for state in states[:2])


def test_off_the_grid_is_refused_and_the_source_fades_when_positions_stop():
    answer: Future[None] = Future()
    off = MoveSource("a", (1e6, 0.0))
    bench = Bench({
        0: move("a", 0.0),
        1: lambda session: session.order(off, 0.0),
        2: lambda session: session.order(off, 0.0, answer),
        3: move("a", 0.0),
        80: end,
    })  # fmt: skip
    assert sum(isinstance(one, Refused) for one in bench.messages) == 1
    assert isinstance(answer.exception(0), InputError)
    assert bench.frames[:, 4 * BLOCK : 8 * BLOCK].any()
    assert bench.notices() == ["late"]
    assert not bench.frames[:, 60 * BLOCK :].any()


def test_in_a_flood_of_positions_the_newest_waits_and_the_first_arrival_counts():
    inbox = Inbox()
    for index in range(10 * MAX_WAITING):
        inbox.put(MoveSource(f"{index % 3}", (float(index), 0.0), 2.0 if index < 3 else None), float(index))
    waiting = inbox.take()
    assert [(one.order.at_mm[0], one.order.amplitude, one.arrived_s) for one in waiting] == [
        (9999.0, 2.0, 0.0), (9997.0, 2.0, 1.0), (9998.0, 2.0, 2.0),
    ]  # fmt: skip
    assert inbox.positions == 10 * MAX_WAITING
    for index in range(MAX_WAITING):
        inbox.put(EndSource(f"{index}"), 0.0)
    with pytest.raises(InputError):
        inbox.put(EndSource("one more"), 0.0)
    inbox.put(EndLive(), 0.0)
    assert [type(one.order) for one in inbox.take()][-1] is EndLive


def test_given_a_wrong_order_then_a_short_sentence_refuses_it(tmp_path):
    for order in (
        {}, {"order": "sing"}, {"order": "move", "name": "a"}, {"order": "move", "name": "", "at_mm": [0, 0]},
        {"order": "move", "name": "a" * 10_000, "at_mm": [0, 0]},
        {"order": "move", "name": "a", "at_mm": [0, 0], "amplitude": "loud"},
        {"order": "move", "name": "a", "at_mm": [0, 0], "speed": 1},
        {"order": "signal", "name": "a", "signal": {}},
        {"order": "signal", "name": "a", "signal": {"kind": functools.reduce(lambda inner, _: [inner], range(500))}},
        {"order": "signal", "name": "a", "signal": {"kind": "file", "path": "none.wav"}},
        {"order": "signal", "name": "a", "signal": {"kind": "sine", "frequency_hz": 200.0, "duration_s": 1e12}},
    ):  # fmt: skip
        with pytest.raises(InputError) as refusal:
            order_of(order, RATE_HZ, tmp_path)
        assert 0 < len(str(refusal.value)) < 500


# --- orders by OSC


def osc(address, *values):
    builder = OscMessageBuilder(address)
    for value in values:
        builder.add_arg(value)
    return builder.build().dgram


def bundle(*messages):
    return b"#bundle\0" + bytes(7) + b"\1" + b"".join(len(one).to_bytes(4, "big") + one for one in messages)


def test_given_any_bytes_then_osc_refuses_or_reads_them():
    random, messages = np.random.default_rng(1), OscMessages()
    for size in range(0, 400, 2):
        noise = random.bytes(size)
        for datagram in (noise, b"#bundle\x00" + noise, b"/source/a/position\x00\x00,ff\x00" + noise):
            assert all(isinstance(one, Mapping | InputError) for one in messages.read(datagram))


def test_given_a_wrong_message_by_osc_then_a_sentence_refuses_it(tmp_path):
    engine = LiveEngine(BANK, block_samples=BLOCK, look_ahead_samples=0)

    def carry_out(content):
        if isinstance(content, InputError):
            raise content
        engine.move("a", order_of(content, RATE_HZ, tmp_path).at_mm)

    for address, *values in (
        ("/source/a/position", 1.0), ("/source/a/position", 1.0, "two"), ("/source/a/position", math.nan, 1.0),
        ("/source/a/signal", '{"kind": "file", "path": "/etc/passwd"}'), ("/source/a/colour", 1), ("/elsewhere",),
    ):  # fmt: skip
        (content,) = OscMessages().read(osc(address, *values))
        with pytest.raises(InputError):
            carry_out(content)
    for text in ("", "9000", "host:", "host:-1", "host:65536", "host:9e3", ":9000"):
        with pytest.raises(InputError, match="--osc"):
            address_of(text)


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


def test_orders_of_other_programs_arrive_and_a_hanging_one_lets_the_receiver_close():
    orders, hangs = Queue(), threading.Event()
    receiver = OscInput("127.0.0.1", 0)

    def receive(order, arrived_s):
        orders.put(order)
        if isinstance(order, dict) and order["order"] != "move":
            hangs.wait(60)

    host, _, port = receiver.address.rpartition(":")
    other = OSCClient(host, int(port), encoding="utf8")
    with SimpleUDPClient(host, int(port)) as sender:
        for index in range(70):
            sender.send_message(f"/source/n{index}/position", [1.0, 2.0])
        time.sleep(0.1)  # all of them are there, whatever the system
        receiver.start(receive)
        refused, *burst = [orders.get(timeout=10) for _ in range(65)]
        assert isinstance(refused, InputError)
        assert [order["name"] for order in burst] == [f"n{index}" for index in range(6, 70)]
        for client in (sender, other):
            client.send_message("/source/a/position", [1.5, -2.0, 0.25])
            assert orders.get(timeout=10) == {"order": "move", "name": "a", "at_mm": [1.5, -2.0], "amplitude": 0.25}
        sender.send_message("/end", [])
    other.sock.close()
    assert orders.get(timeout=10)["order"] == "end"
    receiver.close()
    hangs.set()
