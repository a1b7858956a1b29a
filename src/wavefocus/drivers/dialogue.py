"""Questions over a serial line, asked again once where that can help, and never mistaken for one another.

A device answers in the order in which it was asked, so an answer that comes late looks like that to the
next question. Therefore no question follows an unanswered one directly: in between, the device is asked for
something that only it answers so (its identity, as a rule), and whatever arrives before that is dropped.
"""

import re
import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from itertools import count
from typing import Generic, TypeVar

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.protocols import Clock, WallClock
from wavefocus.drivers.serial_line import LineFailedError, NoAnswerError, SerialLine
from wavefocus.drivers.timeouts import CallThread, HungError

Answer = TypeVar("Answer")


class UnreadableError(Exception):
    """The answer is not what this question can be answered with."""


def matched(pattern: str, answer: str) -> re.Match[str]:
    """Match a whole answer. Raises UnreadableError: it is another one."""
    found = re.fullmatch(pattern, answer)
    if found is None:
        raise UnreadableError(answer)
    return found


class RefusedError(Exception):
    """The device says that it will not.

    meaning: What its answer means.
    remedy: What to do about it.
    passing: Whether a new attempt can go well.
    again: Whether a disturbed command is answered so too, so that it is asked once more before the answer is believed.
    """

    def __init__(self, meaning: str, remedy: str, *, passing: bool = False, again: bool = False) -> None:
        super().__init__(meaning)
        self.meaning = meaning
        self.remedy = remedy
        self.passing = passing
        self.again = again


class RestartedError(Exception):
    """The device answers as it does after power-on: its settings and its position are lost."""


@dataclass(frozen=True, slots=True)
class Query(Generic[Answer]):
    """A question to a device; asking it twice does no harm.

    text: The command, without its end.
    read: Turns the answer into its meaning; raises `UnreadableError`, `RefusedError` or `RestartedError`.
    """

    text: str
    read: Callable[[str], Answer]


@dataclass(frozen=True, slots=True)
class Marker:
    """A question that only one device answers in one way, to find the place in its answers again.

    text: The command, without its end.
    device: Who answers, for messages.
    marks: Whether a line ends with the answer; half another answer may stand before it.
    stranger: Which other device a line comes from, or None where it says nothing of that; raises `RestartedError`.
    """

    text: str
    device: str
    marks: Callable[[str], bool]
    stranger: Callable[[str], str | None]


# Closing a port is a matter of milliseconds, unless its driver hangs.
_CLOSING_S = 1.0
# Pause after a command whose answer is not waited for, as public drivers make it (0.2 s, lab-built ones for MTI).
_BEFORE_S = 0.2


class Dialogue:
    """Asks a device over a line, one thread at a time.

    instrument: Whose device it is, for messages.
    clock: Passes the time while a device starts; by default the wall's.
    """

    def __init__(self, instrument: str, line: SerialLine, clock: Clock | None = None) -> None:
        self._clock = clock or WallClock()
        self._instrument = instrument
        self._line = line
        self._marker: Marker | None = None
        self._behind = False
        # How often each question was sent whose answer has not come; only the marker's are waited for.
        self._due: Counter[str] = Counter()
        self._lock = threading.RLock()

    @property
    def instrument(self) -> str:
        """Whose device it is, for messages."""
        return self._instrument

    def open(self) -> None:
        """Open the line afresh."""
        with self._lock:
            self._marker = None
            self._behind = False
            self._due.clear()
            self._line.open()

    def close(self) -> None:
        """Release the line, whether or not a call of another thread still hangs in it; never waits for long."""
        guard = CallThread(f"closing of {self._instrument}")
        with suppress(HungError):  # what hangs ends by itself, or never
            guard.call(self._line.close, _CLOSING_S, needs_thread=False)
        guard.abandon()

    def introduce(
        self,
        query: Query[Answer],
        patience_s: float,
        before: str = "",
        between: str = "",
        also: Query[Answer] | None = None,
    ) -> Answer:
        """Ask a device that was just opened who it is, again and again: it may still be starting.

        Raises InstrumentLostError.

        query: Answered with the identity.
        patience_s: How long to try; a try that was begun is finished.
        before: A command to send before each try, whether it is answered or not.
        between: A command to send before the second try and each later one; then there are two tries at least.
        also: A question for devices that do not know the other one, asked in every second try; two tries at least.
        """
        doing = "asking who it is"
        latest = NoAnswerError("no answer came")
        gives_up_s = self._clock.now_s() + patience_s
        questions = [query] if also is None else [query, also]
        least = max(len(questions), 2 if between else 1)
        with self._turn(doing), self._losses(doing):
            for number in count():
                question = questions[number % len(questions)]
                try:
                    # An end rounds off what another program may have left half said.
                    self._line.send(before)
                    if before:
                        self._clock.sleep(_BEFORE_S)
                    self._send(question.text)
                    answer = self._first_readable(question)
                    self._due[question.text] -= 1
                    return answer
                except NoAnswerError as missing:
                    latest = missing
                except LineFailedError as failure:
                    self._line.close()
                    cause = f"the connection was closed ({failure})"
                    remedy = "it may serve one program at a time: close the others; check its power"
                    raise self._lost(doing, cause, remedy) from failure
                before = between or before
                if number + 1 >= least and self._clock.now_s() > gives_up_s:
                    break
        remedy = "switch it on; check the cable, and driver and baud in the rig file"
        raise InstrumentLostError(self._instrument, doing, str(latest), remedy)

    def recognise(self, marker: Marker) -> None:
        """Use this identity from now on.

        The place in its answers is taken to be in doubt: more than one introduction may have been asked for. Where they
        were the marker's own question, their late answers look like the marker's, so that all are waited for.
        """
        self._marker = marker
        self._behind = True

    def verify(self, doing: str) -> None:
        """Make sure that the device answers, and that it is still the same.

        Raises InstrumentError or InstrumentLostError.
        """
        with self._turn(doing), self._losses(doing):
            self._require_open(doing)
            try:
                self._catch_up(doing)
            except NoAnswerError:
                self._catch_up_or_fail(doing)

    def ask(self, query: Query[Answer], doing: str) -> Answer:
        """Ask, and once more if no answer can be read.

        It lasts at most eight times the line's longest wait for an answer, however the device behaves; three where it
        is silent.

        Raises InstrumentError: the device refuses for good. TransientInstrumentError: it refuses for now, or did not
        answer twice. InstrumentLostError: the port is gone, or the device did not answer the time before either.
        """
        with self._turn(doing), self._losses(doing):
            self._require_open(doing)
            if self._behind or self._line.received():
                self._catch_up_or_fail(doing)
            try:
                try:
                    return self._exchange(query)
                except NoAnswerError:
                    self._catch_up(doing)
                    return self._exchange(query)
                except RefusedError as refused:
                    if not refused.again:
                        raise
                    return self._exchange(query)
            except NoAnswerError as missing:
                raise TransientInstrumentError(
                    self._instrument, doing, f"{missing}, asked twice", "try again; if it stays, check cable and power"
                ) from missing
            except RefusedError as refused:
                kind = TransientInstrumentError if refused.passing else InstrumentError
                raise kind(self._instrument, doing, refused.meaning, refused.remedy) from refused

    # -- one exchange --------------------------------------------------------------------------

    def _exchange(self, query: Query[Answer]) -> Answer:
        # Until an answer has come, whatever ends the wait for it, an interrupt too, leaves the place in doubt.
        self._behind = True
        self._send(query.text)
        answer = self._line.receive(time.monotonic() + self._line.settings.answer_s)
        if answer.strip() == query.text.strip() and answer.strip():
            # The line echoes what is sent over it; the answer comes after that.
            answer = self._line.receive(time.monotonic() + self._line.settings.answer_s)
        self._due[query.text] -= 1
        if self._line.received():
            raise NoAnswerError(f"more came than the answer {answer!r}")
        try:
            read = query.read(answer)
        except UnreadableError:
            raise NoAnswerError(f"the answer {answer!r} cannot be read") from None
        except RefusedError:
            self._behind = False
            raise
        self._behind = False
        return read

    def _send(self, question: str) -> None:
        self._line.send(question)
        self._due[question] += 1

    def _first_readable(self, query: Query[Answer]) -> Answer:
        """The first line that answers a question, whatever comes before it."""
        deadline_s = time.monotonic() + self._line.settings.answer_s
        unread = ""
        while True:
            try:
                line = self._line.receive(deadline_s)
            except NoAnswerError as missing:
                raise NoAnswerError(f"it answers {unread!r}" if unread else str(missing)) from None
            try:
                return query.read(line)
            except (UnreadableError, RefusedError):
                unread = line if line.strip() and line.strip() != query.text else unread

    # -- finding the place again -----------------------------------------------------------------

    def _catch_up(self, doing: str) -> None:
        """Drop all answers up to the marker's. Raises NoAnswerError or InstrumentError."""
        marker = self._marker
        if marker is None:
            raise NoAnswerError("no answer came")
        # An end by itself completes a command of which only a part was sent.
        self._line.send("")
        strangers: list[str] = []
        for _ in range(2):
            self._send(marker.text)
            stranger = self._await(marker)
            if stranger is None:
                self._behind = False
                return
            strangers.append(stranger)
        if strangers[0] != strangers[1]:
            raise NoAnswerError(f"the answer {strangers[1]!r} cannot be read")
        cause = f"another device answers in its place: {strangers[1]!r}, and not {marker.device!r}"
        remedy = "plug in the right device, or correct the rig file, port and identity"
        raise InstrumentError(self._instrument, doing, cause, remedy)

    def _await(self, marker: Marker) -> str | None:
        """None once every marker asked for so far is answered; else who answers in its place, if anybody does.

        Where one of several is missing, it was lost: no answer comes within the longest wait.
        """
        deadline_s = time.monotonic() + self._line.settings.answer_s
        answered = False
        stranger: str | None = None
        while True:
            try:
                line = self._line.receive(deadline_s)
            except NoAnswerError:
                if time.monotonic() <= deadline_s:
                    continue  # noise; the answer may still come
                if stranger is None and not answered:
                    raise
                break
            if marker.marks(line):
                answered = True
                self._due[marker.text] -= 1
                if self._due[marker.text] <= 0:
                    break
            else:
                stranger = marker.stranger(line) or stranger
        if answered:
            self._due[marker.text] = 0
        return None if answered else stranger

    def _catch_up_or_fail(self, doing: str) -> None:
        """Catch up with a device that did not answer the time before either."""
        try:
            self._catch_up(doing)
        except NoAnswerError as missing:
            self._behind = True
            cause = f"the device has stopped answering ({missing})"
            remedy = "check its power and its cable"
            raise self._lost(doing, cause, remedy) from missing

    @contextmanager
    def _turn(self, doing: str) -> Iterator[None]:
        """Wait until no other thread asks, and no longer than a call can take. Raises InstrumentLostError."""
        # A call ends within eight times the line's longest wait for an answer; a longer one hangs in the port's driver.
        if not self._lock.acquire(timeout=10 * self._line.settings.answer_s):
            cause = "an earlier call hangs in the driver of its port"
            remedy = "connect it again; if it stays, unplug the port and plug it in again"
            raise self._lost(doing, cause, remedy)
        try:
            yield
        finally:
            self._lock.release()

    # -- losing the device -------------------------------------------------------------------------

    def _require_open(self, doing: str) -> None:
        if not self._line.is_open:
            raise self._lost(doing, "the connection is lost", "check power and cable; it must be opened again")

    @contextmanager
    def _losses(self, doing: str) -> Iterator[None]:
        """Close the line where it failed, or where the device has restarted."""
        try:
            yield
        except LineFailedError as failure:
            self._line.close()
            raise self._lost(doing, f"the connection broke ({failure})", "plug it in and switch it on") from failure
        except RestartedError as restarted:
            self._line.close()
            cause = "the device was switched off and on meanwhile: its position and its settings are lost"
            remedy = "check its power supply; it is set up afresh when it is opened again"
            raise self._lost(doing, cause, remedy) from restarted

    def _lost(self, doing: str, cause: str, remedy: str) -> InstrumentLostError:
        return InstrumentLostError(self._instrument, doing, cause, remedy)
