"""A live session opened from bank, rig and scene, and live sources in Python.

The session runs in a thread of its own, and orders return when they have taken effect.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from wavefocus.banks import LOG, options_from, taking
from wavefocus.config.messages import Message
from wavefocus.config.messages.live import EndLive, EndSource, LiveEnded, LiveNotice, LiveReady, LiveState, MoveSource
from wavefocus.config.scene import Output, Regularisation
from wavefocus.console import progress, spinner
from wavefocus.drives import naming
from wavefocus.input_files import require_sound
from wavefocus.live_session.orders import Order, UseSignal, check_name
from wavefocus.live_session.pace import raise_priority
from wavefocus.live_session.session import LiveSession, Publish
from wavefocus.options import LiveOptions
from wavefocus.rendering.greens.source import is_check, usable
from wavefocus.rendering.live.engine import LiveEngine
from wavefocus.rendering.live.limiter import LiveLimiter
from wavefocus.rendering.live.lives import emitted_by
from wavefocus.rendering.live.recording import SessionRecording
from wavefocus.rendering.scene.model import load_scene
from wavefocus.rendering.scene.signals import Signal
from wavefocus.rig.limits import interface_of, rig_of, stricter
from wavefocus.rig.setup import open_player
from wavefocus.storage.argument_types import checked
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.errors import InputError
from wavefocus.storage.units import PLAYED_UNITS

AHEAD_MS = 40.0
"""What waits to be played at first where nothing is asked for; an interface with long periods gets more, see `adapts`
of the session."""
TOO_COARSE = (
    "the bank's positions are too far apart for interpolation {!r}: between them the drives are wrong; use 'waves' or"
    " 'auto' in the scene's [output]"
)


@contextmanager
def open_session(
    bank: Path,
    rig_file: Path | None,
    options: LiveOptions,
    publish: Publish,
    on_loaded: Callable[[], object] = lambda: None,
) -> Iterator[tuple[LiveSession, LiveReady]]:
    """Open everything; whatever happens, the outputs are muted and released on the way out.

    rig_file: By default the bank's own rig. publish: As of `LiveSession`.
    on_loaded: Called when the bank is in memory, before the interface is opened.

    Raises InputError: bank, rig and scene do not go together. Raises InstrumentError: the interface cannot be opened.
    """
    regularisation, output = Regularisation(), Output()
    signal: Signal | None = None
    if options.scene is not None:
        scene = load_scene(options.scene)
        regularisation, output, signal = scene.regularisation, scene.output, scene.sources[0].signal
    if options.independent:
        regularisation = regularisation.model_copy(update={"independent": True})
    with ExitStack() as opened:
        view = opened.enter_context(open_bank(bank))
        require_sound(view)
        if view.drive_unit not in PLAYED_UNITS:
            raise InputError(f"{bank} takes drives in {view.drive_unit}, and the player plays volts")
        rig = rig_of(rig_file, view)
        if rig is None:
            raise InputError(f"{bank} does not say what rig it was measured with; name a rig file")
        rate_hz = float(view.sample_rate_hz)

        interface = interface_of(rig)

        def engine_and_limiter(interpolation: str) -> tuple[LiveEngine, LiveLimiter]:
            engine = LiveEngine(
                view,
                block_samples=max(1, round(options.block_ms * rate_hz / 1e3)),
                look_ahead_samples=round(options.look_ahead_ms * rate_hz / 1e3),
                regularisation=regularisation,
                interpolation=interpolation,
                signal=signal,
                record=options.record is not None,
                frame_rate_hz=interface.rate_hz,
            )
            return engine, LiveLimiter(stricter(output, rig.player), interface.full_scale_v, interface.rate_hz)

        with naming(options.scene or bank, view), spinner("modelling what lies between the bank's positions"):
            # Finer rows take seconds, and warm nothing up.
            warm = "nearest" if output.interpolation in ("kernel", "waves", "auto") else output.interpolation
            _warm_up(*engine_and_limiter(warm), view)
            engine, limiter = engine_and_limiter(output.interpolation)
        with progress("reading the bank", 1):
            engine.preload()
        recording = None
        if options.record is not None:
            recording = opened.enter_context(
                SessionRecording(
                    options.record, rate_hz=rate_hz, regularisation=regularisation, interpolation=output.interpolation
                )
            )
        on_loaded()
        player = opened.enter_context(open_player(rig, realtime=True))
        too_coarse = bool(is_check(view).any()) and engine.interpolation in ("nearest", "bilinear")
        ahead_ms = AHEAD_MS if options.ahead_ms is None else options.ahead_ms
        session = LiveSession(
            engine,
            player,
            limiter,
            publish,
            channels=rig.player.channels,
            ahead_s=ahead_ms / 1e3,
            adapts=options.ahead_ms is None,
            gives_up_s=rig.recovery.give_up_after_s,
            duration_s=options.duration_s,
            gain=10.0 ** (options.gain_db / 20.0),
            recording=recording,
            warning=TOO_COARSE.format(engine.interpolation) if too_coarse else "",
        )
        ready = LiveReady(
            player.identify(),
            str(bank),
            engine.actuators,
            1e3 * engine.block_samples / rate_hz,
            options.look_ahead_ms,
            1e3 * engine.sufficient_samples / rate_hz,
            ahead_ms + 1e3 * (limiter.look_ahead_frames / limiter.rate_hz + player.latency_s),
            engine.x_mm,
            engine.y_mm,
            independent=regularisation.independent,
        )
        yield session, ready


def _warm_up(engine: LiveEngine, limiter: LiveLimiter, bank: Bank) -> None:
    """Compute some blocks: what is loaded and planned when it is first used does not delay those of the session."""
    at_mm = bank.position_mm[int(np.flatnonzero(usable(bank))[0])].tolist()
    for block in range(3):
        engine.move(f"warm {block % 2}", (at_mm[0], at_mm[1]))
        limiter.limit(engine.next_block())
    engine.state()


LOOKS_EVERY_S = 0.25


@taking(LiveOptions)
@checked
def live(bank: str | Path, rig: str | Path | None = None, **options: Any) -> AbstractContextManager[LiveSources]:
    """Play sources that move while they sound, as ``wavefocus live``.

    At the end of the ``with`` block all sources fade; the outputs are muted on every way out.

    Parameters
    ----------
    bank
        Path of a bank.
    rig
        Path of a rig file, or ``"virtual"``; by default the rig that the bank was measured with.
    options
        As listed.

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
    >>> with wf.live("plate.h5", scene="scene.toml") as sources:
    ...     for x_mm in range(-10, 11):
    ...         sources.move("finger", (x_mm, 0.0), amplitude=0.01)
    >>> sources.ended.positions
    21
    """
    return _sounding(Path(bank), None if rig is None else Path(rig), options_from(LiveOptions, options))


@contextmanager
def _sounding(bank: Path, rig_file: Path | None, options: LiveOptions) -> Iterator[LiveSources]:
    reports = _Reports()
    with open_session(bank, rig_file, options, reports) as (session, ready):
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
        self._order(UseSignal(name, emitted_by(signal, self._session.engine.rate_hz, repeat=repeat)))

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
