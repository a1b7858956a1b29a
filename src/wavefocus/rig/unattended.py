"""Sessions that nobody watches: messages to people through apprise, a sign of life each minute, and no sleep."""

from __future__ import annotations

import errno
import logging
import os
import queue
import re
import shutil
import socket
import subprocess
import sys
import threading
import time
import urllib.request
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from http.client import HTTPException
from pathlib import Path
from urllib.error import HTTPError

from wavefocus.acquisition.event_wording import sentence
from wavefocus.acquisition.wording import hours
from wavefocus.campaign.control import resume_line
from wavefocus.campaign.status import CampaignStatus
from wavefocus.config.messages.campaign import (
    Drift,
    Event,
    Fault,
    Logged,
    ReconnectTried,
    SessionEnded,
    State,
    StateChanged,
)
from wavefocus.config.messages.rig_checks import Act, Finding
from wavefocus.config.rig import MessagesSection, RigConfig
from wavefocus.console import say
from wavefocus.storage.errors import InputError

ADDRESSES_VARIABLE = "WAVEFOCUS_MESSAGES"
"""Addresses, with blanks between, for sessions that go on from a bank alone: the bank does not hold them."""
CLOSE_S = 20.0
"""At the end of a session so long is waited for messages under way."""
_WAITING = frozenset({State.SUSPENDED, State.RECOVERING})


class AppriseOutbox:
    """Addresses as apprise has them: ``mailto://...``, ``tgram://...``, ``json://...`` and some hundred more.

    Raises InputError: apprise is not installed, or not an address, which is named by number and kind.
    """

    def __init__(self, urls: Sequence[str]) -> None:
        try:
            import apprise
        except ImportError:
            raise InputError("messages.urls: sending needs the package apprise: pip install apprise") from None
        # What it logs may hold an address.
        log = logging.getLogger("apprise")
        log.addHandler(logging.NullHandler())
        log.propagate = False
        self._each: list[tuple[str, apprise.Apprise]] = []
        for number, url in enumerate(urls):
            one = apprise.Apprise()
            scheme = re.match(r"[A-Za-z][A-Za-z0-9+.-]{0,19}(?=://)", url)
            kind = "?" if scheme is None else scheme[0]
            if not one.add(url):
                raise InputError(
                    f"messages.urls, {ADDRESSES_VARIABLE}: address {number}: apprise does not support this kind "
                    f"({kind}), or it lacks a part; its documentation lists what each needs"
                )
            self._each.append((kind, one))

    def send(self, title: str, text: str) -> list[str]:
        """Send a message to all addresses; the kinds of those that did not take it."""
        refused = []
        for kind, one in self._each:
            try:
                taken = bool(one.notify(title=title, body=text))
            except Exception:  # whatever a sender raises must not end a campaign; its words may hold the address
                taken = False
            if not taken:
                refused.append(kind)
        return refused


def addresses(section: MessagesSection) -> tuple[str, ...]:
    """The addresses of a rig file, and those of the environment."""
    return (*section.urls, *os.environ.get(ADDRESSES_VARIABLE, "").split())


class Messenger:
    """Sends messages about a session's events; a subscriber, and a context that ends with the session.

    Sending goes on in a thread of its own: an address that does not answer never holds up a campaign.
    """

    def __init__(self, bank: Path, section: MessagesSection, outbox: AppriseOutbox | None, go_on: str = "") -> None:
        self._bank, self._section, self._outbox = bank, section, outbox
        self._go_on = go_on or resume_line(Path(bank.name), None)
        self._events: queue.SimpleQueue[Event | None] = queue.SimpleQueue()
        self._status = CampaignStatus()
        self._since_s: float | None = None
        self._waiting_sent = False
        self._look: Drift | None = None
        self._drift_sent = ""
        self._undelivered = 0
        self._thread = threading.Thread(target=self._work, name="messages", daemon=True)

    def __enter__(self) -> Messenger:
        if self._outbox is not None:
            self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._outbox is None:
            return
        self._events.put(None)
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            say(f"messages: the last one was not taken within {CLOSE_S:g} s and is given up")
        if self._undelivered:
            say(f"messages: {self._undelivered} were not taken by their address")

    def __call__(self, event: Event) -> None:
        """Take an event; returns at once."""
        if self._outbox is not None:
            self._events.put(event)

    def _work(self) -> None:
        while True:
            try:
                event = self._events.get(timeout=self._patience_s())
            except queue.Empty:
                self._send_waiting()
                continue
            if event is None:
                return
            self._take(event)

    def _patience_s(self) -> float | None:
        if self._since_s is None or self._waiting_sent:
            return None
        return max(0.0, self._since_s + 60 * self._section.suspended_after_min - time.monotonic())

    def _take(self, event: Event) -> None:
        self._status = self._status.after(Logged(datetime.now(UTC), event))
        # A change at the sentinel counts once its repeat confirms it; instruments may fail between the two.
        paused = isinstance(event, StateChanged) and event.state is State.PAUSED
        if self._look is not None and (paused or not isinstance(event, Fault | ReconnectTried | StateChanged)):
            if not (isinstance(event, Drift) and event.occasion == "repeat"):
                self._send_drift(self._look)
            self._look = None
        match event:
            case StateChanged() if event.state in _WAITING:
                self._since_s = time.monotonic() if self._since_s is None else self._since_s
            case StateChanged():
                if self._waiting_sent and event.state is State.RUNNING:
                    self._send("suspended", "goes on", event.reason)
                self._since_s, self._waiting_sent = None, False
            case Drift(occasion="repeat"):
                self._send_drift(event)
            case Drift():
                self._look = event
            case SessionEnded():
                self._send_end(event)

    def _send_drift(self, look: Drift) -> None:
        if look.verdict not in (self._drift_sent, "steady"):
            self._send("drift", "drift", sentence(look))
        self._drift_sent = look.verdict

    def _send_end(self, ended: SessionEnded) -> None:
        text = f"{sentence(ended)}."
        if ended.state is not State.FINISHED:
            reason = f"{self._status.reason}. " if self._status.reason else ""
            text = f"{reason}{text} Go on with: {self._go_on}"
        self._send(str(ended.state), str(ended.state), text)

    def _send_waiting(self) -> None:
        self._waiting_sent = True
        if self._since_s is not None:
            waited = hours(time.monotonic() - self._since_s)
            self._send("suspended", str(self._status.state), f"for {waited}: {self._status.reason}")

    def _send(self, about: str, title: str, text: str) -> None:
        if about not in self._section.about or self._outbox is None:
            return
        refused = self._outbox.send(f"{self._bank.name}: {title}", f"{text}\n{socket.gethostname()}")
        self._undelivered += len(refused)
        if refused:
            say(f"messages: not taken by {len(refused)} of the addresses ({', '.join(refused)})")


def messenger_for(bank: Path, section: MessagesSection, go_on: str = "") -> Messenger:
    """The messenger of a session, from the rig's addresses and those of the environment; `go_on` as of `Messenger`.

    Raises InputError: an address is unknown, or apprise is missing.
    """
    urls = addresses(section)
    return Messenger(bank, section, AppriseOutbox(urls) if urls else None, go_on)


REMEDY = "correct the address, or look whether its server can be reached from here"


def message_findings(rig: RigConfig, name: str, *, send: bool) -> Iterator[Finding]:
    """Look at the addresses of a rig file, and send a message to each if asked to; addresses are never shown."""
    urls, edit = addresses(rig.messages), Act("edit-rig", "messages.urls")
    if not urls:
        if send:
            yield Finding(
                "messages", "addresses", "fail", "there are none", "write messages.urls into the rig file", edit
            )
        return
    if not send:
        try:
            AppriseOutbox(urls)
        except InputError as wrong:
            yield Finding("messages", "addresses", "fail", str(wrong), "correct it", edit)
            return
        what = f"{len(urls)} given, none tried"
        yield Finding("messages", "addresses", "ok", what, "--test-message sends one to each", Act("test-message"))
    for number, url in enumerate(urls if send else ()):
        check, kind = f"address {number}", url.partition("://")[0][:20]
        try:
            refused = AppriseOutbox([url]).send(f"{name}: test", "A test message of wavefocus doctor.")
        except InputError as wrong:
            yield Finding("messages", check, "fail", str(wrong).split(": ", 2)[-1], "correct it", edit)
        else:
            taken = Finding("messages", check, "ok", f"{kind}: took a message")
            yield Finding("messages", check, "fail", f"{kind}: took no message", REMEDY, edit) if refused else taken


ALIVE_VARIABLE = "WAVEFOCUS_ALIVE_URL"
"""The address of the outside service, for sessions that go on from a bank alone: the bank does not hold it."""


class AliveSignal:
    """Touches a file and asks for an address each minute while a block runs, in threads of its own.

    A server that hangs delays neither the file nor the campaign; what fails is reported once, without the address.

    section: Has `alive_url` and `alive_file`.
    every_s: Seconds between two signals, > 0.

    Raises InputError: the address is not one of a web server.
    """

    def __init__(self, section: MessagesSection, every_s: float = 60.0) -> None:
        self._url = section.alive_url or os.environ.get(ALIVE_VARIABLE, "")
        if self._url and not self._url.startswith(("http://", "https://")):
            raise InputError("messages.alive_url: must begin with http:// or https://")
        self._file = None if section.alive_file is None else Path(section.alive_file)
        self._every_s = every_s
        self._over = threading.Event()

    def __enter__(self) -> AliveSignal:
        for key, signal in self.signals().items():
            threading.Thread(target=self._repeat, args=(signal, key), name=key, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()

    def _repeat(self, signal: Callable[[], None], key: str) -> None:
        reported = False
        while True:
            why = _failure_of(signal)
            if why and not reported:
                say(f"messages.{key}: no sign of life was given ({why}); it is tried again each minute")
            reported = bool(why)
            if self._over.wait(self._every_s):
                return

    def signals(self) -> dict[str, Callable[[], None]]:
        """How a sign of life is given once, by the key that asks for it."""
        touch: dict[str, Callable[[], None]] = {} if self._file is None else {"alive_file": self._touch}
        return touch | ({"alive_url": self._ask} if self._url else {})

    def _touch(self) -> None:
        assert self._file is not None
        if self._file.is_dir():  # other files change its time, too
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        self._file.touch()

    def _ask(self) -> None:
        with urllib.request.urlopen(self._url, timeout=20.0) as answer:
            answer.read(1)


def _failure_of(signal: Callable[[], None]) -> str:
    """Why a sign of life was not given, without its address; empty where it was."""
    try:
        signal()
    except HTTPError as failure:
        return f"the server answered {failure.code}"  # its phrase may repeat the address
    except (OSError, ValueError, HTTPException) as failure:
        return str(getattr(failure, "reason", None) or getattr(failure, "strerror", None) or type(failure).__name__)
    return ""


def alive_findings(section: MessagesSection) -> Iterator[Finding]:
    """Give each sign of life once; what came of it."""
    for key, signal in AliveSignal(section).signals().items():
        why = _failure_of(signal)
        if why:
            remedy = "correct it, or look whether it can be reached from here"
            yield Finding("messages", key, "fail", why, remedy, Act("edit-rig", f"messages.{key}"))
        else:
            yield Finding("messages", key, "ok", "a sign of life was given")


# SetThreadExecutionState, Windows API: the state lasts until it is changed, and is the display's affair no further.
_ES_CONTINUOUS = 0x80000000
_ES_SYSTEM_REQUIRED = 0x00000001


@contextmanager
def kept_awake(reason: str) -> Iterator[bool]:
    """Keep the system awake while the block runs; it may sleep again when this process is gone, however it ends.

    Linux: ``systemd-inhibit``, which ``systemd-inhibit --list`` shows with the reason. macOS: ``caffeinate``, which
    ``pmset -g assertions`` shows. Windows: SetThreadExecutionState, which ``powercfg /requests`` shows with the
    program. The screen may go dark.

    reason: What is going on, for people.

    Yields whether the system has accepted it; no run is held up where it does not.
    """
    if sys.platform == "win32":
        import ctypes

        set_state = ctypes.windll.kernel32.SetThreadExecutionState
        accepted = bool(set_state(_ES_CONTINUOUS | _ES_SYSTEM_REQUIRED))
        try:
            yield accepted
        finally:
            set_state(_ES_CONTINUOUS)
        return
    holder = next(filter(None, map(_started, _inhibitors(sys.platform, reason))), None)
    try:
        yield holder is not None
    finally:
        if holder is not None:
            _end(holder)


def awake_finding() -> Finding:
    """Whether this system can be kept awake."""
    with kept_awake("wavefocus doctor") as accepted:
        if accepted:
            return Finding("computer", "sleep", "ok", "kept awake while a run is on")
    what = "this system takes no request to stay awake"
    return Finding("computer", "sleep", "skipped", what, "set its power settings to never sleep")


def _inhibitors(platform: str, reason: str) -> list[list[str]]:
    """Commands that keep a platform (as `sys.platform`) awake, the first that it accepts being enough.

    On Linux they end when their standard input is closed, on macOS when this process is gone.
    """
    if platform == "darwin":
        return [["caffeinate", "-i", "-s", "-w", str(os.getpid())]]
    if platform.startswith("linux"):
        who = ["--who=wavefocus", f"--why={reason}", "--mode=block", "cat"]
        # A user who is logged in over the network may only refuse idling (org.freedesktop.login1.policy).
        return [["systemd-inhibit", f"--what={what}", *who] for what in ("sleep:idle:handle-lid-switch", "idle")]
    return []


def _started(command: list[str]) -> subprocess.Popen[bytes] | None:
    """Start a command; None where it is not there, or ends at once, for the system refused it."""
    if shutil.which(command[0]) is None:
        return None
    null = subprocess.DEVNULL
    try:
        holder = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=null, stderr=null, start_new_session=True)
    except OSError:
        return None
    try:
        # A system without a session manager refuses within milliseconds.
        holder.wait(0.2)
    except subprocess.TimeoutExpired:
        return holder
    _end(holder)
    return None


def _end(holder: subprocess.Popen[bytes]) -> None:
    with suppress(OSError):
        if holder.stdin is not None:
            holder.stdin.close()
    if sys.platform == "darwin":
        holder.terminate()
    try:
        holder.wait(5.0)
    except subprocess.TimeoutExpired:
        holder.kill()
        holder.wait()
