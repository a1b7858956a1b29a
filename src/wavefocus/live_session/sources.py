"""Live sources in Python: the session runs in a thread of its own, and orders return when they have taken effect."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from pathlib import Path

from wavefocus.banks import LOG
from wavefocus.config.messages import Message
from wavefocus.config.messages.live import EndLive, EndSource, LiveEnded, LiveNotice, LiveReady, LiveState, MoveSource
from wavefocus.live_session.opening import open_session
from wavefocus.live_session.orders import Order, UseSignal, check_name
from wavefocus.live_session.priority import raise_priority
from wavefocus.live_session.session import LiveSession
from wavefocus.options import LiveOptions
from wavefocus.rendering.live.emitted import live_samples
from wavefocus.rendering.scene.signals import Signal
from wavefocus.storage.argument_types import checked
from wavefocus.storage.errors import InputError

LOOKS_EVERY_S = 0.25


@checked
@contextmanager
def live(
    bank: str | Path,
    rig: str | Path | None = None,
    *,
    scene: str | Path | None = None,
    look_ahead_ms: float = 50.0,
    block_ms: float = 5.0,
    ahead_ms: float | None = None,
    gain_db: float = 0.0,
    record: str | Path | None = None,
    independent: bool = False,
) -> Iterator[LiveSources]:
    """Play sources that move while they sound, as ``wavefocus live``.

    At the end of the ``with`` block all sources fade; the outputs are muted on every way out.

    Parameters
    ----------
    bank
        Path of a bank.
    rig
        Path of a rig file, or ``"virtual"``; by default the rig that the bank was measured with.
    scene
        Path of a scene file: its regularisation, its output and the signal of its first source are used. By default
        noise of the bank's band, without saturation, between positions by ``auto``.
    look_ahead_ms
        By how much sources lag what is ordered, 0 to 2000; what is not known by then is predicted.
    block_ms
        Time of a block, 1 to 50; orders take effect with the next one.
    ahead_ms
        So much waits to be played, 1 to 1000; by default 40, and twice as much after each underrun.
    gain_db
        On the amplitudes of all orders; limits hold all the same.
    record
        Folder in which the session is recorded as a scene that renders to the same drives.
    independent
        Whether each source is quiet where the others are, also at those of amplitude 0.

    Returns
    -------
    LiveSources
        Moves, changes and ends sources; for the ``with`` statement.

    Raises
    ------
    InputError
        Bank, rig and scene do not go together, or an option is out of range.
    InstrumentError
        The interface cannot be opened, or failed.

    Examples
    --------
    >>> import wavefocus as wf
    >>> with wf.live("plate.h5") as sources:
    ...     for x_mm in range(-10, 11):
    ...         sources.move("finger", (x_mm, 0.0), amplitude=0.01)
    >>> sources.ended.positions
    21
    """
    for name, value, least, most in (
        ("look_ahead_ms", look_ahead_ms, 0, 2000),
        ("block_ms", block_ms, 1, 50),
        ("ahead_ms", ahead_ms, 1, 1000),
        ("gain_db", gain_db, -200, 200),
    ):
        if value is not None and not least <= value <= most:
            raise InputError(f"{name} is {value}; allowed: {least} to {most}")
    options = LiveOptions(
        None if scene is None else Path(scene),
        look_ahead_ms,
        block_ms,
        ahead_ms,
        gain_db,
        record=None if record is None else Path(record),
        independent=independent,
    )
    reports = _Reports()
    rig_file = None if rig is None else Path(rig)
    with open_session(Path(bank), rig_file, options, reports) as (session, ready):
        sources = LiveSources(session, ready, reports)
        sources._start()
        try:
            yield sources
            sources._end()
        finally:
            session.stop()
            sources._thread.join()


class LiveSources:
    """Sources of a live session; made by `live`. Safe to use from several threads.

    ready: Its figures when it began, a `wavefocus.config.messages.live.LiveReady`.
    """

    def __init__(self, session: LiveSession, ready: LiveReady, reports: _Reports) -> None:
        self._session, self._reports, self.ready = session, reports, ready
        self._failure: BaseException | None = None
        self._begun = threading.Event()
        self._thread = threading.Thread(target=self._run, name="live", daemon=True)

    @checked
    def move(self, name: str, at_mm: tuple[float, float], amplitude: float | None = None) -> None:
        """Set the position of a source as it is now; one that does not sound yet begins to.

        Returns within a block. A source without a position for 0.25 s fades.

        Parameters
        ----------
        name
            Of the source, any text.
        at_mm
            Position on the surface in mm, x to the right and y up from its centre.
        amplitude
            As of a scene's source; by default as before, 1 at first.

        Raises
        ------
        InputError
            The position is off the measured surface, a value is not finite, or too many sources sound.
        """
        check_name(name)
        self._order(MoveSource(name, (float(at_mm[0]), float(at_mm[1])), amplitude))

    @checked
    def set_signal(self, name: str, signal: Signal, *, repeat: bool = True) -> None:
        """Give a source a signal, such as `Sine`, before or while it sounds; it repeats unless it shall not.

        Raises InputError: The signal cannot be made at the bank's rate, or is longer than a minute.
        """
        check_name(name)
        values = live_samples(signal, self._session.engine.rate_hz)
        self._order(UseSignal(name, signal, values, repeat))

    @checked
    def end_source(self, name: str) -> None:
        """Let a source fade and vanish. Raises InputError: none of that name sounds."""
        check_name(name)
        self._order(EndSource(name))

    @property
    def state(self) -> LiveState | None:
        """Latest figures, five times a second: latency, load, underruns, sources as they sound."""
        return self._reports.state

    @property
    def ended(self) -> LiveEnded:
        """Figures of the session so far: positions, latency at the 99.9th percentile, underruns."""
        return self._session.ended()

    def _start(self) -> None:
        self._thread.start()
        while not self._begun.wait(LOOKS_EVERY_S):
            self._check_alive()

    def _end(self) -> None:
        """Let all sources fade and sound to their end."""
        self._session.order(EndLive(), time.monotonic())
        self._thread.join()
        if self._failure is not None:
            raise self._failure

    def _run(self) -> None:
        raise_priority()
        try:
            self._session.run(self._begun.set)
        except BaseException as failure:  # raised in the thread that uses it
            self._failure = failure

    def _order(self, order: Order) -> None:
        answer: Future[None] = Future()
        self._session.order(order, time.monotonic(), answer)
        while True:
            try:
                return answer.result(LOOKS_EVERY_S)
            except TimeoutError:
                self._check_alive()

    def _check_alive(self) -> None:
        if not self._thread.is_alive():
            raise self._failure or InputError("the live session is over")


class _Reports:
    """Keeps the latest state, and logs notices."""

    def __init__(self) -> None:
        self.state: LiveState | None = None

    def __call__(self, message: Message) -> None:
        if isinstance(message, LiveState):
            self.state = message
        elif isinstance(message, LiveNotice):
            LOG.warning(message.sentence)
