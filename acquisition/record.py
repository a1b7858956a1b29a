"""One record: the recorder listens, the player plays, and whatever fails leaves silence behind."""

from __future__ import annotations

from collections.abc import Mapping

from acquisition.setup import Setup
from drivers.protocols import Float64Array, Recording, RecordRequest, Take

# A driver that has not answered this long after the record should have ended is not going to.
ANSWER_MARGIN_S = 5.0


def record_samples(setup: Setup, signal_samples: int, sample_rate_hz: float) -> int:
    """Samples per channel of a record around a signal, pre-roll and post-roll included."""
    return round((setup.pre_roll_s + setup.post_roll_s) * sample_rate_hz) + signal_samples


def take_record(setup: Setup, signals_v: Mapping[int, Float64Array], sample_rate_hz: float, take: Take) -> Recording:
    """Play signals and record reference and response around them.

    The recorder starts first: none of the low-cost DAQ boxes can trigger on an
    audio-level signal, so start offset and clock ratio are found from the reference
    channel afterwards.

    Parameters
    ----------
    setup : Setup
        The rig.
    signals_v : mapping from player channel to float64 array, shape (samples,)
        Output volts, all of one length.
    sample_rate_hz : float
        Rate of the signals and of the record.
    take : Take
        What the record is for.

    Returns
    -------
    Recording
        ``record_samples(...)`` samples of both channels.

    Raises
    ------
    InstrumentError
        Of the instrument that failed; the player is muted and the recorder stopped.
    """
    signal_samples = len(next(iter(signals_v.values())))
    request = RecordRequest(
        samples=record_samples(setup, signal_samples, sample_rate_hz),
        sample_rate_hz=sample_rate_hz,
        range_v=setup.range_v,
        take=take,
    )
    timeout_s = request.duration_s + ANSWER_MARGIN_S
    player, recorder = setup.instruments.player, setup.instruments.recorder
    try:
        recorder.start(request)
        setup.instruments.clock.sleep(setup.pre_roll_s)
        player.play(signals_v, sample_rate_hz)
        player.wait(timeout_s)
        return recorder.read(timeout_s)
    except BaseException:
        player.mute()
        recorder.abort()
        raise
