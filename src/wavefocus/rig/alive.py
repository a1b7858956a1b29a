"""A sign of life each minute, so that an outside service raises the alarm when everything here is silent."""

from __future__ import annotations

import os
import threading
import urllib.request
from collections.abc import Callable, Iterator
from http.client import HTTPException
from pathlib import Path
from types import TracebackType
from urllib.error import HTTPError

from wavefocus.config.messages.rig_checks import Act, Finding
from wavefocus.config.rig import MessagesSection
from wavefocus.console import say
from wavefocus.storage.errors import InputError

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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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
        found: dict[str, Callable[[], None]] = {}
        if self._file is not None:
            found["alive_file"] = self._touch
        if self._url:
            found["alive_url"] = self._ask
        return found

    def _touch(self) -> None:
        assert self._file is not None
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
