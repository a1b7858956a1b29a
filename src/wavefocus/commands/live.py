"""``wavefocus live``: sources that move while they sound, by orders on standard input and over OSC."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from functools import partial
from pathlib import Path

from msgspec.structs import replace

from wavefocus.config.messages import Message, Refused
from wavefocus.config.messages.live import LiveEnded, LiveNotice, LiveReady
from wavefocus.console import Exit, say
from wavefocus.ending import ending_at_once
from wavefocus.json_lines import LinesOut, input_objects
from wavefocus.live_session.orders import order_of
from wavefocus.live_session.osc import OscInput, address_of
from wavefocus.live_session.pace import raise_priority
from wavefocus.live_session.session import LiveSession
from wavefocus.live_session.sources import open_session
from wavefocus.options import LiveOptions
from wavefocus.storage.errors import InputError

MAX_MESSAGES = 1000
"""A reader that does not keep up loses messages; the sound does not wait for it."""
WRITES_WITHIN_S = 5.0
MAX_AT_ONCE, FLOOD_PAUSE_S = 16, 0.002
"""Of a flood so many lines are read at once, then none for 2 ms: reading more would slow down computing."""


def live(bank: Path, rig_file: Path, options: LiveOptions, *, osc: str | None, as_json: bool) -> Exit:
    """Play until an order, the end of standard input or a signal ends it; the outputs are muted on every way out.

    Raises InputError: bank, rig, scene or address are wrong. Raises InstrumentError: the interface failed for good.
    """
    messages, receiver, session, code = Messages(as_json=as_json), None, None, Exit.DONE
    with messages.written():
        try:
            if osc is not None:
                receiver = OscInput(*address_of(osc))
                if not receiver.loopback:
                    say(f"warning: every computer that reaches {receiver.address} can move sources")
            with ending_at_once(), open_session(bank, rig_file, options, messages, _raise_all) as (session, ready):
                session.run(partial(_begin, ready, session, messages, receiver))
        except KeyboardInterrupt:
            code = Exit.STOPPED
        finally:
            if receiver is not None:
                receiver.close()
            if session is not None:
                if session.unrecorded:
                    messages(LiveNotice("recording", "nothing is recorded: no source has sounded long enough"))
                messages(session.ended())
            elif code is Exit.STOPPED:
                say("stopped by the user; nothing was played")
    return code


def _begin(ready: LiveReady, session: LiveSession, messages: Messages, receiver: OscInput | None) -> None:
    """Report that it plays, and read orders from standard input and from the receiver from now on."""
    messages(ready if receiver is None else replace(ready, osc=receiver.address))
    folder = Path()

    def receive(content: Mapping[str, object] | InputError, arrived_s: float) -> None:
        try:
            if isinstance(content, InputError):
                raise content
            session.order(order_of(content, session.engine.rate_hz, folder), arrived_s)
        except InputError as wrong:
            messages(Refused(str(wrong)))

    def read() -> None:
        count, last_s = 0, 0.0
        try:
            for content, arrived_s in input_objects():
                receive(content, arrived_s)
                count, last_s = count + 1 if arrived_s == last_s else 1, arrived_s
                if count % MAX_AT_ONCE == 0:
                    time.sleep(FLOOD_PAUSE_S)
        finally:
            session.stop()  # its starter is gone, or wants it to end

    threading.Thread(target=read, name="orders", daemon=True).start()
    if receiver is not None:
        receiver.start(receive)


def _raise_all() -> None:
    """Raise the priority of this thread and of those that write messages and the record."""
    raise_priority(*threading.enumerate())


class Messages:
    """Writes messages from a thread of its own: JSON lines on standard output, or sentences on standard error."""

    def __init__(self, *, as_json: bool) -> None:
        self._queue: queue.Queue[Message | None] = queue.Queue(MAX_MESSAGES)
        self._lines = LinesOut() if as_json else None
        self._second, self._refusals = 0, 0

    def __call__(self, message: Message) -> None:
        """Give a message, from any thread; never waits."""
        if isinstance(message, Refused):
            second = int(time.monotonic())
            self._refusals = self._refusals + 1 if second == self._second else 1
            self._second = second
            # A pointer that is beyond the surface is refused with each of its moves.
            if self._refusals > 10:
                return
        with suppress(queue.Full):
            self._queue.put_nowait(message)

    @contextmanager
    def written(self) -> Iterator[None]:
        """Write messages while the context lasts; those given by then are written before it ends."""
        writer = threading.Thread(target=self._write, name="messages", daemon=True)
        writer.start()
        try:
            yield
        finally:
            with suppress(queue.Full):
                self._queue.put(None, timeout=WRITES_WITHIN_S)
            writer.join(WRITES_WITHIN_S)

    def _write(self) -> None:
        while (message := self._queue.get()) is not None:
            if self._lines is not None:
                self._lines(message)
            elif line := _sentence(message):
                say(line)


def _sentence(message: Message) -> str:
    """A message for people; an empty text for one that they need not read."""
    match message:
        case LiveReady():
            (left, right), (low, high) = message.x_mm, message.y_mm
            osc = f", OSC at {message.osc}" if message.osc else ""
            predicted = "" if message.look_ahead_ms >= message.sufficient_ms else ", what is not known yet is predicted"
            return (
                f"{message.player}: {message.actuators} actuators, x from {left:g} to {right:g} mm, y from {low:g} to"
                f" {high:g} mm{osc}; sources lag by {message.look_ahead_ms:g} ms{predicted}, the interface by"
                f" {message.interface_ms:.0f} ms"
            )
        case Refused(sentence) | LiveNotice(_, sentence):
            return sentence
        case LiveEnded():
            return message.sentence
    return ""
