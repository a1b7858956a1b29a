"""A live session from files: bank, rig and scene, checked together, and the instruments opened."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import numpy as np

from wavefocus.config.messages.live import LiveReady
from wavefocus.config.scene import Output, Regularisation
from wavefocus.console import progress, spinner
from wavefocus.drives import naming
from wavefocus.input_files import require_sound
from wavefocus.live_session.session import LiveSession, Publish
from wavefocus.options import LiveOptions
from wavefocus.rendering.greens.source import is_check, usable
from wavefocus.rendering.live.engine import LiveEngine
from wavefocus.rendering.live.limiter import LiveLimiter
from wavefocus.rendering.live.recording import SessionRecording
from wavefocus.rendering.scene.model import load_scene
from wavefocus.rendering.scene.signals import Signal
from wavefocus.rig.limits import interface_of, rig_of, stricter
from wavefocus.rig.setup import open_player
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
    regularisation, output, signal = _of_scene(options.scene_file)
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

        with naming(options.scene_file or bank, view), spinner("modelling what lies between the bank's positions"):
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


def _of_scene(scene_file: Path | None) -> tuple[Regularisation, Output, Signal | None]:
    if scene_file is None:
        return Regularisation(), Output(), None
    scene = load_scene(scene_file)
    return scene.regularisation, scene.output, scene.sources[0].signal
