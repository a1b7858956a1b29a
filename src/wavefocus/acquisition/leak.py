"""The leak of the loopback into the response input: measured with the loopback alone, judged by the median row."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace

import numpy as np

from wavefocus.acquisition.attempt import AttemptResult, Play, record_play
from wavefocus.acquisition.engine.station import Station
from wavefocus.acquisition.judgement import Cure, Judgement, poor
from wavefocus.acquisition.setup import Setup, naming_role, point_at, take_record
from wavefocus.calibration import Float64Array
from wavefocus.calibration.crosstalk import (
    MAX_DELAY_S,
    NONE_DB,
    REMEDY,
    SPARE,
    UNKNOWN_ROWS_SHARE,
    Crosstalk,
    crosstalk_of_record,
    leak_limit,
)
from wavefocus.calibration.evidence import SOUND
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.config.messages.campaign import CrosstalkMeasured
from wavefocus.config.messages.rig_checks import Finding
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.drivers.protocols import Recording, RecordLabel
from wavefocus.storage.bank.ledger import Status, usable
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.raw.writer import RawWriter

SWEEP_S, BAND_HZ = 0.5, (40.0, 400.0)
"""Length of the sweep, and its band where no campaign says another; as of doctor, calibrate and sweeps by hand."""
DEFECT = "crosstalk"
TRIES = 3
"""Records in which the vibrometer loses the surface for a moment are taken again so often in all."""
PARKED_S = 0.1
"""Longest time that a mirror of any driver takes to its parking direction."""
ROWS = 100
"""So many positions, spread over all valid ones, give the median row."""


def measure_leak(
    setup: Setup,
    place_mm: Sequence[float],
    amplitude_v: float,
    sample_rate_hz: float,
    band_hz: tuple[float, float] = BAND_HZ,
) -> Crosstalk:
    """Measure the leak: play a sweep of 0.5 s on the loopback alone, the beam on a place where light comes back.

    Raises InstrumentError: of the instrument that failed; a passing fault only when repeated records did not cure it.
    """
    point_at(setup, float(place_mm[0]), float(place_mm[1]))
    play = Play(0, setup.signals_v(_sweep_v(amplitude_v, sample_rate_hz, band_hz)))
    for number in range(1, TRIES + 1):
        label = RecordLabel(0, number, 0, DEFECT)
        found = leak_of(setup, record_play(setup, play, sample_rate_hz, label), sample_rate_hz, band_hz)
        if found.resolves(UNKNOWN_ROWS_SHARE):
            break
    return found


def _sweep_v(amplitude_v: float, sample_rate_hz: float, band_hz: tuple[float, float]) -> Float64Array:
    return PlayedExcitation(sample_rate_hz, *band_hz, SWEEP_S, MAX_DELAY_S, amplitude_v, averages=1).signal_v()


def leak_of(setup: Setup, recording: Recording, sample_rate_hz: float, band_hz: tuple[float, float]) -> Crosstalk:
    """The leak in a record that no actuator answers."""
    channels = {"reference_gain": setup.reference_gain, "inter_channel_delay_s": setup.inter_channel_delay_s}
    return crosstalk_of_record(recording.volts[0], recording.volts[1], sample_rate_hz, band_hz, **channels)


def crosstalk_finding(found: Crosstalk) -> Finding:
    """What of the loopback leaks into the response input, and what to do about it."""
    if found.reaches(UNKNOWN_ROWS_SHARE):
        return Finding("recorder", "crosstalk", "fail", f"the loopback leaks into the response input: {found}", REMEDY)
    if not found.resolves(UNKNOWN_ROWS_SHARE):
        what = f"the response input is too loud to see a leak of the loopback below {found.visible_db:z.0f} dB"
        return Finding("recorder", "crosstalk", "warn", what, "point the beam where light comes back, or play louder")
    return Finding("recorder", "crosstalk", "ok", str(found))


def check_pickup(setup: Setup, amplitude_v: float, sample_rate_hz: float) -> list[Finding]:
    """Play each output while no light comes back, shutter closed or beam parked: what of its voltage is picked up.

    Raises InstrumentError: of any instrument.
    """
    mirror = setup.mirror
    with naming_role("mirror"):
        mirror.park()
        mirror.block()
    setup.clock.sleep(PARKED_S)
    signal_v, found = _sweep_v(amplitude_v, sample_rate_hz, BAND_HZ), list[Crosstalk]()
    for number, actuators in enumerate([(), *((actuator,) for actuator in range(len(setup.actuator_channels)))]):
        label = RecordLabel(0, 1, number, "pickup")
        recording = take_record(setup, setup.signals_v(signal_v, *actuators), sample_rate_hz, label)
        found.append(leak_of(setup, recording, sample_rate_hz, BAND_HZ))
    alone, *single = found
    # Each record has the loopback's leak too: what exceeds it is the output's own.
    own = [Crosstalk(one.share - alone.is_seen * alone.share, one.delay_s, one.error) for one in single]
    worst = max(range(len(own)), key=lambda actuator: abs(own[actuator].share))
    if own[worst].reaches(UNKNOWN_ROWS_SHARE):
        what = f"the response input picks up output {setup.actuator_channels[worst]}: "
        what += f"{own[worst].level_db:.1f} dB re its voltage"
        return [Finding("recorder", "pickup", "fail", what, REMEDY)]
    visible_db = max(one.visible_db for one in own)
    return [Finding("recorder", "pickup", "ok", f"none of {len(own)} outputs is picked up above {visible_db:z.0f} dB")]


class LeakWatch:
    """Measures the leak in a campaign, and judges what is measured while there is one.

    unvouched: Rows that an earlier session measured after its last look.

    found: The leak of the latest look, where it makes 1 % of the median row; else None.
    due: Positions were committed since the latest look, whatever came of that.
    """

    def __init__(
        self, station: Station, bank: BankWriter, unvouched: Sequence[int] = (), raw: RawWriter | None = None
    ) -> None:
        self._station, self._bank, self._raw = station, bank, raw
        self._since = list(unvouched)
        self.due = bool(unvouched)
        self._unjudged: list[Crosstalk] = []
        self._latest: Crosstalk | None = None
        self.found: Crosstalk | None = None

    @property
    def level_db(self) -> float:
        """Level of the leak at the latest look as the bank keeps it; NaN before the first."""
        latest = self._latest
        return math.nan if latest is None else latest.level_db if latest.is_seen else NONE_DB

    def committed(self, position: int) -> None:
        """Note a position that was committed: the next look vouches for it, or does not."""
        self._since.append(position)
        self.due = True

    def look(self, worker: ThreadPoolExecutor) -> tuple[int, ...]:
        """Play the loopback alone, the beam on the first position of the plan; mark what a leak has spoilt.

        worker: Where marks are written.

        Returns the positions that were marked. Raises InstrumentError: an instrument failed for good; a passing fault
        that stays only leaves the leak unmeasured.
        """
        self.due = False
        plan, setup, session = self._station.plan, self._station.setup, self._station.session
        place_mm, sweep = plan.position_mm[0].tolist(), plan.excitation
        level = sweep.amplitude_v, sweep.sample_rate_hz, sweep.band_hz
        try:
            leak = self._station.recovery.retry_after_reconnect(lambda: measure_leak(setup, place_mm, *level))
        except InstrumentError as fault:
            session.fault(fault, None, retried=False)
            if isinstance(fault, TransientInstrumentError):
                return ()
            raise
        limit, marked = worker.submit(self._judge, leak).result()
        level_db = leak.level_db if leak.is_seen else leak.visible_db
        figures = level_db, leak.delay_s, leak.share, min(abs(leak.share) / max(leak.error, 1e-300), 1e6)
        reason = "" if self.found is None else sentence(self.found, limit)
        session.publish(CrosstalkMeasured, *figures, self.found is not None, marked, reason)
        return marked

    def _judge(self, leak: Crosstalk) -> tuple[float | None, tuple[int, ...]]:
        """Judge a look by the median row, and mark what was measured since the last clean one if there is a leak.

        Before the bank has rows nothing is judged: the next look judges both.

        Returns the share of the loopback that counts, and the positions that were marked.
        """
        self._latest = leak
        limit = _limit_of(self._bank, self._station.setup.response_per_volt)
        if limit is None:
            self._unjudged.append(leak)
            return None, ()
        worst = max((*self._unjudged, leak), key=lambda look: look.is_seen * abs(look.share))
        self._unjudged.clear()
        self.found = leak if leak.reaches(limit) else None
        marked = self._mark(worst) if worst.reaches(limit) else ()
        if worst.reaches(limit) or leak.resolves(limit):
            self._since.clear()
        return limit, marked

    def judged(self, result: AttemptResult) -> AttemptResult:
        """A good attempt is poor while there is a leak."""
        if self.found is None or not result.judgement.good:
            return result
        return replace(result, judgement=judgement_of(self.found, result.judgement.score))

    def _mark(self, leak: Crosstalk) -> tuple[int, ...]:
        marked = tuple(row for row in dict.fromkeys(self._since) if self._bank.status[row] == Status.VALID)
        for position in marked:
            if self._raw is not None and self._raw.recorded[position]:
                self._raw.note_leak(position, leak.level_db)
            self._bank.amend(position, status=int(Status.POOR_SIGNAL), leak_db=leak.level_db)
        return marked


def _limit_of(bank: BankWriter, response_per_volt: float) -> float | None:
    """Share of the loopback that makes 1 % of the median row of a bank; None while it has no rows."""
    rows = np.flatnonzero(usable(bank.status))
    rows = rows[:: max(1, len(rows) // ROWS)]
    if not len(rows):
        return None
    rms = np.stack([np.sqrt(np.square(bank.green(row), dtype=np.float64).mean(axis=1)) for row in rows.tolist()])
    header = bank.header
    return leak_limit(rms, header.taps, header.sample_rate_hz, header.band_hz, response_per_volt)


def mark_leaks(bank: BankWriter, response_per_volt: float) -> list[str]:
    """Mark as poor what was measured with a leak of 1 % of the median row, by ``/quality/leak_db``; sentences."""
    limit = _limit_of(bank, response_per_volt)
    if limit is None:
        return []
    sentences = []
    for position in np.flatnonzero(bank.status == Status.VALID).tolist():
        share = 10 ** (bank.record(position).leak_db / 20)
        if share >= SPARE * limit:
            bank.amend(position, status=int(Status.POOR_SIGNAL))
            part = f"{100 * SOUND * share / limit:.2g} % of the median row"
            sentences.append(f"position {position}: crosstalk: the leak of the loopback is {part}")
    return sentences


def sentence(found: Crosstalk, limit: float | None) -> str:
    """A leak that must be named, with what it makes of a row."""
    part = "" if limit is None else f", {100 * SOUND * abs(found.share) / limit:.2g} % of the median row"
    return f"crosstalk: the loopback leaks into the response input: {found}{part}: {REMEDY}"


def judgement_of(found: Crosstalk | None, score: float = 0.0) -> Judgement:
    """Poor, because of a leak; None stands for one that is over."""
    words = sentence(found, None) if found else "crosstalk: the loopback leaked into the response input"
    return poor(DEFECT, words, Cure.NOTHING, score=score)
