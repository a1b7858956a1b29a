"""``wavefocus status``: how a campaign stands, also while it runs."""

from __future__ import annotations

import json
from datetime import datetime
from pathlib import Path

from acquisition.durations import hours
from acquisition.events import State
from acquisition.point_status import median_snr_db, status_counts
from calibration.bank import open_bank
from calibration.bank_owner import Owner, bank_owner
from calibration.errors import InputError
from rendering.report_drift import DriftPoint, drift_over_time
from wavefocus.console import finish_clock, say
from wavefocus.drift_history import drift_path, read_drift, suspect_rows
from wavefocus.event_log import last_events
from wavefocus.heartbeat import SILENT_AFTER_S, Heartbeat, read_heartbeat
from wavefocus.standing import Standing, standing


def status(bank: Path, *, as_json: bool, plot: Path | None = None) -> None:
    """Tell counts per status, who writes, how it stands and when it will have finished; reads only.

    Parameters
    ----------
    bank : Path
        The bank.
    as_json : bool
        Tell programs.
    plot : Path, optional
        Where to draw the drift of the sentinel position.

    Raises
    ------
    InputError
        The bank cannot be read, or there is no drift to draw.
    """
    with open_bank(bank) as view:
        counts = status_counts(view.status)
        total = view.positions
        done = total - counts["not-measured"]
        snr_db = median_snr_db(view.quality.get("snr_db"), view.status)
        plan_sha256 = view.plan_sha256
    owner, beat, drift = bank_owner(bank), read_heartbeat(bank), read_drift(bank)
    newest = next((event for event in last_events(bank) if event.get("event") == "progress"), None)
    stands = standing(last_events(bank)) if owner else Standing(State.IDLE)
    running = owner is not None and newest is not None
    if stands.state is State.IDLE and owner is not None and beat is not None and beat.pid == owner.pid:
        # The log is the quicker of the two, but a full disk may have ended it.
        stands = Standing(State(beat.state), beat.since.isoformat() if beat.since else None, beat.reason)
    if plot is not None:
        _draw(bank, drift, plot)
    facts: dict[str, object] = {
        "bank": str(bank),
        "positions": total,
        "done": done,
        "counts": counts,
        "median_snr_db": snr_db,
        "state": stands.state,
        "state_since": stands.since,
        "state_reason": stands.reason,
        "recovering": stands.recovering,
        "owner": {"host": owner.host, "pid": owner.pid} if owner else None,
        "last_sign_of_life": _life_facts(beat),
        "silent": owner is not None and _is_silent(beat),
        "positions_per_hour": newest["positions_per_hour"] if running and newest else None,
        "remaining_s": newest["remaining_s"] if running and newest else None,
        "last_event_at": newest["at"] if newest else None,
        "suspect_positions": suspect_rows(drift),
        "plan_sha256": plan_sha256,
    }
    if as_json:
        print(json.dumps(facts))
        return
    words = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    say(f"{bank}: {done} of {total} positions measured ({words})")
    if snr_db is not None:
        say(f"median signal-to-noise ratio {snr_db:.1f} dB over all pairs")
    if suspect := suspect_rows(drift):
        say(
            f"the sentinel position had changed after positions {suspect} were measured: put it right, then "
            f"wavefocus remeasure {bank} --positions {suspect}"
        )
    if owner is None:
        if beat is not None and beat.state not in ("finished", "idle"):
            # A process that was killed has not said good-bye.
            say(f"last heard {hours(beat.age_s())} ago: {beat.state}: {beat.reason}")
        left = f"; go on with: wavefocus resume {bank}" if done < total else ""
        say(f"no process owns the bank: no process is measuring{left}")
        return
    _tell_running(owner, stands, beat, newest)


def _tell_running(owner: Owner, stands: Standing, beat: Heartbeat | None, newest: dict[str, object] | None) -> None:
    who = f"process {owner.pid} on {owner.host}"
    if _is_silent(beat) and beat is not None:
        say(
            f"{who} owns the bank but has been silent for {hours(beat.age_s())}: it is held, or its machine is asleep "
            f"or hung; it last said {beat.state}: {beat.reason}"
        )
        return
    if stands.state is State.RECOVERING:
        since = datetime.fromisoformat(str(stands.since)).astimezone()
        tries = (stands.recovering or {}).get("tries") or "no"
        say(
            f"{who} is recovering since {since:%H:%M:%S}: {stands.reason} "
            f"({tries} tries so far); it goes on by itself when the instrument is back"
        )
    elif stands.state is State.RUNNING:
        say(f"{who} is measuring")
    else:
        say(f"{who} is {stands.state}: {stands.reason}")
    if beat is not None:
        at = "" if beat.position is None else f", at position {beat.position}"
        say(f"last sign of life {hours(beat.age_s())} ago{at}")
        if beat.fault:
            say(f"last fault: {beat.fault}")
    if newest is not None:
        remaining_s = float(str(newest["wall_remaining_s"]))
        at_s = datetime.fromisoformat(str(newest["at"])).astimezone()
        say(
            f"{float(str(newest['positions_per_hour'])):.0f} positions an hour, {hours(remaining_s)} left, "
            f"finished at {finish_clock(remaining_s)} (last position {at_s:%H:%M:%S})"
        )


def _is_silent(beat: Heartbeat | None) -> bool:
    return beat is not None and beat.age_s() > SILENT_AFTER_S


def _life_facts(beat: Heartbeat | None) -> dict[str, object] | None:
    if beat is None:
        return None
    return {
        "at": beat.at.isoformat(),
        "age_s": round(beat.age_s(), 1),
        "state": beat.state,
        "reason": beat.reason,
        "position": beat.position,
        "remaining_s": beat.remaining_s,
        "finish_at": beat.finish_at.isoformat() if beat.finish_at else None,
        "fault": beat.fault or None,
    }


def _draw(bank: Path, drift: list[DriftPoint], plot: Path) -> None:
    if not drift:
        raise InputError(f"{drift_path(bank)}: holds no drift to draw: the sentinel has not been measured again yet")
    from acquisition.sentinel import DriftLimits  # the configuration is read for a picture alone
    from wavefocus.blueprint import bank_configuration

    with open_bank(bank) as view:
        limits = DriftLimits(**bank_configuration(view).run.drift.model_dump())
    plot.write_bytes(drift_over_time(drift, limits).png)
    say(f"{plot}: drift of the sentinel position, {len(drift)} measurements")
