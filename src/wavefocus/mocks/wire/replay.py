"""A serial device that answers as one did in a record of exchanges (`wavefocus doctor --record`)."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from wavefocus.drivers.exchange_record import FORMAT, FORMAT_VERSION
from wavefocus.mocks.wire.emulated_serial import SerialDevice


@dataclass(frozen=True, slots=True)
class Exchange:
    """A command as it was sent, with its end, and all that came before the next one."""

    sent: str
    received: str


def read_exchanges(path: Path, role: str) -> tuple[list[Exchange], int]:
    """The exchanges of a record with one instrument, and the baud that it was opened with last.

    Raises OSError; ValueError: the file is not such a record, or the role has no serial exchange in it.

    role: ``"mirror"`` or ``"vibrometer"``.
    """
    try:
        # What follows the last line's end is half a line, of a doctor that was killed.
        whole = path.read_text(encoding="utf-8").split("\n")[:-1]
        head, *lines = (json.loads(line) for line in whole)
    except ValueError:
        raise ValueError(f"{path}: it is not a record of exchanges") from None
    if (head.get("format"), head.get("format_version")) != (FORMAT, FORMAT_VERSION):
        raise ValueError(f"{path}: format is {head.get('format')!r}; it must be {FORMAT!r}, version {FORMAT_VERSION}")
    exchanges: list[Exchange] = []
    baud = 0
    for line in lines:
        if line["instrument"].split(" ")[0] != role:
            continue
        baud = line.get("baud", baud)
        if "sent" in line:
            exchanges.append(Exchange(line["sent"], ""))
        elif "received" in line and exchanges:
            latest = exchanges.pop()
            exchanges.append(Exchange(latest.sent, latest.received + line["received"]))
    if not exchanges:
        raise ValueError(f"{path}: nothing was sent to a {role} over a serial line")
    return exchanges, baud


class ReplayedDevice(SerialDevice):
    """Answers each command as it was answered in a record.

    Commands that repeat, polls as a rule, may come more or less often than in the record: less often, then the rest is
    skipped; more often, then the latest answer is given again. What was never recorded is not answered; `unknown` lists
    it.
    """

    def __init__(self, role: str, exchanges: Sequence[Exchange], baud: int) -> None:
        self.role = role
        self.baud = baud
        self.command_end = exchanges[0].sent[-1:]
        self.unknown: list[str] = []
        self._exchanges = _without_empty_commands(exchanges)
        self._next = 0

    @classmethod
    def of_record(cls, path: Path, role: str) -> ReplayedDevice:
        """The instrument of a role as it answered in a record; errors as of `read_exchanges`."""
        return cls(role, *read_exchanges(path, role))

    def operation(self, command: str) -> str:
        return command

    def answer(self, command: str) -> str:
        asked = {self._command(number) for number in range(self._next)}
        for number in range(self._next, len(self._exchanges)):
            if self._command(number) == command:
                self._next = number + 1
                return self._exchanges[number].received
            if self._command(number) not in asked and command in asked:
                break  # a command that is new comes in its turn
        for number in range(self._next - 1, -1, -1):
            if self._command(number) == command:
                return self._exchanges[number].received
        self.unknown.append(command)
        return ""

    def refusal(self, command: str) -> str:
        return ""

    def impostor(self, command: str) -> str:
        return ""

    def restart(self) -> None:
        self._next = 0

    def _command(self, number: int) -> str:
        return self._exchanges[number].sent.strip("\r\n")


def _without_empty_commands(exchanges: Sequence[Exchange]) -> list[Exchange]:
    """What an end by itself was answered comes before the next answer: an emulated wire passes no empty command on."""
    found: list[Exchange] = []
    before = ""
    for one in exchanges:
        if not one.sent.strip("\r\n"):
            before += one.received
        else:
            found.append(Exchange(one.sent, before + one.received))
            before = ""
    return found
