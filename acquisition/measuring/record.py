"""One record: point the mirror, start the recorder, play; whatever fails leaves silence behind."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Protocol

from acquisition.measuring.setup import Setup, as_lost, asking, silence
from drivers.errors import TransientInstrumentError
from drivers.protocols import Float64Array, Recorder, Recording, RecordRequest, Take

# A driver that has not answered this long after the record should have ended is not going to.
ANSWER_MARGIN_S = 5.0


class Rolls(Protocol):
    """How long a record is before and after its signal; a `Setup` says so, and so does a rig's configuration."""

    @property
    def pre_roll_s(self) -> float:
        """Recording before the player starts."""
        ...

    @property
    def post_roll_s(self) -> float:
        """Recording after it should have ended."""
        ...


def record_samples(rolls: Rolls, signal_samples: int, sample_rate_hz: float) -> int:
    """Samples per channel of a record around a signal, pre-roll and post-roll included."""
    return round((rolls.pre_roll_s + rolls.post_roll_s) * sample_rate_hz) + signal_samples


def take_record(
    setup: Setup,
    signals_v: Mapping[int, Float64Array],
    sample_rate_hz: float,
    take: Take,
    samples: int | None = None,
) -> Recording:
    """Play signals and record reference and response around them.

    The recorder starts first: none of the low-cost DAQ boxes can trigger on an
    audio-level signal, so start offset and clock ratio are found from the reference
    channel afterwards.

    signals_v, mapping from player channel to float64 (samples,): Output volts, all of one length.
    sample_rate_hz: Rate of the signals and of the record.
    take: What the record is for.
    samples: Samples of the record; by default ``record_samples(...)``, so that it outlasts the signal.

    Returns as many samples of both channels.
    Raises InstrumentError: of the instrument that failed, with its role; the player is muted and the recorder stopped.
    An instrument that cannot even be silenced after a passing failure counts as lost.
    """
    signal_samples = len(next(iter(signals_v.values())))
    request = RecordRequest(
        samples=record_samples(setup, signal_samples, sample_rate_hz) if samples is None else samples,
        sample_rate_hz=sample_rate_hz,
        range_v=setup.range_v,
        take=take,
    )
    timeout_s = max(request.duration_s, record_samples(setup, signal_samples, sample_rate_hz) / sample_rate_hz)
    timeout_s += ANSWER_MARGIN_S
    player, recorder = setup.instruments.player, setup.instruments.recorder
    try:
        with asking("recorder"):
            recorder.start(request)
        setup.instruments.clock.sleep(setup.pre_roll_s)
        with asking("player"):
            player.play(signals_v, sample_rate_hz)
            player.wait(timeout_s)
        with asking("recorder"):
            return recorder.read(timeout_s)
    except BaseException as failure:
        for also in silence(setup.instruments):
            if isinstance(failure, TransientInstrumentError):
                raise as_lost(also, also.cause) from failure
            failure.add_note(str(also))
        raise


def record_silence(
    recorder: Recorder, seconds: float, sample_rate_hz: float, range_v: tuple[float, float], take: Take
) -> Recording:
    """Record for a while, > 0 s, while nothing plays; raises InstrumentError of the recorder, which was stopped."""
    request = RecordRequest(max(1, round(seconds * sample_rate_hz)), sample_rate_hz, range_v, take)
    with asking("recorder"):
        try:
            recorder.start(request)
            return recorder.read(request.duration_s + ANSWER_MARGIN_S)
        except BaseException:
            recorder.abort()
            raise


def start_move(setup: Setup, x_mm: float, y_mm: float) -> None:
    """Let the mirror set out for a place, and return at once.

    Raises InstrumentError: of the mirror.
    """
    x_mrad, y_mrad = setup.mirror_map.angles_mrad(x_mm, y_mm)
    with asking("mirror"):
        setup.instruments.mirror.move_to(float(x_mrad), float(y_mrad))


def point_at(setup: Setup, x_mm: float, y_mm: float) -> None:
    """Point at a place and wait until the beam stands; where the move is under way already, this only waits.

    Raises InstrumentError: of the mirror.
    """
    start_move(setup, x_mm, y_mm)
    with asking("mirror"):
        setup.instruments.mirror.wait_settled(setup.settle_timeout_s)
