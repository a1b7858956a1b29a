"""Recordings kept next to the bank: header of a plan's raw file, and the parts of an attempt that go into it.

The order is the design: an attempt's recordings are committed to the raw file before its Green's functions are
committed to the bank, so that no crash leaves a bank row without its recordings. The other way round, recordings
without their row, is what a crash in between leaves; the position is then measured again and both are
replaced.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from acquisition.measuring.plays import channels_of, used_samples
from acquisition.measuring.record import record_samples
from acquisition.measuring.setup import Setup
from acquisition.schedule.plan import Plan
from drivers.protocols import Recording
from storage.errors import InputError
from storage.point_status import Status
from storage.raw.header import RawHeader, sequential
from storage.raw.writer import RawWriter

COUNTS = 32768
# Sensitivity and gain are read from instruments; what is the same to this share is the same.
SAME = 1e-6

MEASURED = int(Status.VALID | Status.OVER_RANGE | Status.POOR_SIGNAL)


def raw_header(plan: Plan, setup: Setup, *, rig_json: str, run_json: str, software: str) -> RawHeader:
    """What the raw file of a plan says of itself.

    setup: With what. One count is a 32768th of the range that the campaign begins with: counts of the widest range
        would bury quiet positions in their rounding.
    rig_json, run_json, software: As of the bank's header.
    """
    excitation, signal, used = plan.excitation, plan.staggered, used_samples(plan, setup)
    channels = channels_of(setup)
    rate = excitation.sample_rate_hz
    whole = record_samples(setup, excitation.averages * excitation.period_samples, rate)
    return RawHeader(
        sample_rate_hz=rate,
        samples=whole if used is None else used.stop - used.start,
        taps=plan.taps,
        band_hz=excitation.band_hz,
        schedule=sequential(plan.actuators) if signal is None else signal.schedule(),
        position_mm=plan.position_mm,
        actuator_mm=plan.actuator_mm,
        response_per_volt=channels.response_per_volt,
        reference_gain=channels.reference_gain,
        inter_channel_delay_s=channels.inter_channel_delay_s,
        volts_per_count=(setup.range_v[0] / COUNTS, setup.range_v[1] / COUNTS),
        averages=excitation.averages if signal is None else None,
        sweep_s=excitation.duration_s if signal is None else signal.period_samples / rate,
        decay_s=excitation.decay_s if signal is None else None,
        rig_json=rig_json,
        run_json=run_json,
        plan_sha256=plan.sha256,
        software=software,
    )


def require_same(raw: RawWriter, wanted: RawHeader) -> None:
    """Refuse to add recordings to a file whose others were scaled otherwise.

    Raises InputError: sensitivity, gain, delay or range is not what the file says.
    """
    for name in ("response_per_volt", "reference_gain", "inter_channel_delay_s", "volts_per_count"):
        then, now = getattr(raw.header, name), getattr(wanted, name)
        if not np.allclose(then, now, rtol=SAME, atol=1e-12):
            raise InputError(
                f"{raw.path} was recorded with {name} {then}, the rig now has {now}; set the instrument as it was, or "
                "start a new bank"
            )


def keep_recordings(raw: RawWriter, position: int, recordings: Sequence[Recording]) -> None:
    """Commit all records of an attempt.

    Of an attempt that was taken in a wider range, what lies beyond the file's counts is cut to them: an estimate then
    marks the position as over-range, while the bank has it right.

    Raises WavefocusError: the disk failed; positions committed earlier are intact.
    """
    kept = []
    for channel, step_v in enumerate(raw.header.volts_per_count):
        volts = np.stack([one.volts[channel] for one in recordings])
        kept.append(np.clip(volts, -COUNTS * step_v, (COUNTS - 1) * step_v, dtype=np.float32))
    raw.commit(position, kept[0], kept[1])


def without_recordings(status: NDArray[np.uint8], raw: RawWriter) -> list[int]:
    """Positions that a bank holds Green's functions of and the raw file no recordings, as where it was damaged.

    status, uint8 (positions,): The bank's.
    raw: The file of recordings.
    """
    return [int(row) for row in np.flatnonzero((status & MEASURED > 0) & ~raw.recorded)]
