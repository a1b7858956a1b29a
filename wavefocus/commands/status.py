"""``wavefocus status``, ``pause``, ``go-on`` and ``stop``: how a campaign stands, and orders to it."""

from __future__ import annotations

import json
import time
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from acquisition.durations import a_while, hours
from acquisition.engine.events import Progress, State
from acquisition.schedule.row_ranges import row_ranges
from storage.bank.reading import open_bank
from storage.errors import InputError
from storage.ledger.owner import Owner, bank_owner
from storage.output_files import require_outputs, write_whole
from storage.point_status import median_snr_db, status_counts
from wavefocus.campaign.campaign_view import remaining
from wavefocus.campaign.sidecar_files import Standing, drift_path, last_events, read_drift, standing, suspect_rows
from wavefocus.campaign.supervision import SILENT_AFTER_S, Heartbeat, give_order, read_heartbeat, resume_line, withdraw
from wavefocus.console import answer, say
from wavefocus.exits import Exit

if TYPE_CHECKING:
    from acquisition.quality.limits import DriftPoint

# So many positions that stayed as they were are told one by one.
MOST_LINES = 5


def status(bank: Path, *, as_json: bool, plot: Path | None = None, force: bool = False) -> None:
    """Tell counts per status, who writes, how it stands and when it will have finished; reads only.

    Raises InputError: the bank cannot be read, or there is no drift to draw.
    """
    require_outputs((plot,), (bank,), force=force)
    with open_bank(bank) as view:
        counts = status_counts(view.status)
        broken = np.flatnonzero(view.broken).tolist()
        counts["damaged"] = len(broken)
        counts["not-measured"] -= len(broken)
        total = view.positions
        done = total - counts["not-measured"] - len(broken)
        snr_db = median_snr_db(view.quality.get("snr_db"), view.status)
        plan_sha256 = view.plan_sha256
        run_json = view.run_json
        moved_mm = view.quality["moved_mm"]
    moved = row_ranges(np.flatnonzero(moved_mm > 0).tolist())
    owner, beat, drift = bank_owner(bank), read_heartbeat(bank), read_drift(bank)
    pace = _pace(bank) if owner else _Pace()
    kept = _kept(bank)
    stands = standing(last_events(bank)) if owner else Standing(State.IDLE)
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
        "damaged_positions": broken,
        "median_snr_db": snr_db,
        "state": stands.state,
        "state_since": stands.since,
        "state_reason": stands.reason,
        "recovering": stands.recovering,
        "owner": {"host": owner.host, "pid": owner.pid} if owner else None,
        "last_sign_of_life": _life_facts(beat),
        "silent": owner is not None and _is_silent(beat),
        "positions_per_hour": pace.progress.get("positions_per_hour"),
        "remaining_s": pace.progress.get("remaining_s", pace.planned_s),
        "wall_positions_per_hour": pace.progress.get("wall_positions_per_hour"),
        "wall_remaining_s": pace.progress.get("wall_remaining_s"),
        "record": pace.record,
        "last_event_at": next((event.get("at") for event in last_events(bank)), None),
        "suspect_positions": suspect_rows(drift),
        "moved_positions": moved,
        "kept_positions": [{"position": position, "reason": reason} for position, reason in kept.items()],
        "plan_sha256": plan_sha256,
    }
    if as_json:
        print(json.dumps(facts))
        return
    words = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    answer(f"{bank}: {done} of {total} positions measured ({words})")
    if broken:
        answer(
            f"the checksums of positions {row_ranges(broken)} do not hold; measure them again with: "
            f"wavefocus resume {bank}"
        )
    if snr_db is not None:
        answer(f"median signal-to-noise ratio {snr_db:.1f} dB over all pairs")
    if moved:
        answer(f"measured up to {np.nanmax(moved_mm):.2g} mm beside their position, where there was light: {moved}")
    for position, reason in list(kept.items())[:MOST_LINES]:
        answer(f"position {position} stayed as the bank had it: {reason}")
    if len(kept) > MOST_LINES:
        answer(f"and {len(kept) - MOST_LINES} more stayed as the bank had them: {row_ranges(list(kept))}")
    if suspect := suspect_rows(drift):
        answer(
            f"the sentinel position had changed after positions {suspect} were measured: put it right, then "
            f"wavefocus remeasure {bank} --positions {suspect}"
        )
    if owner is None:
        if beat is not None and beat.state not in ("finished", "idle"):
            # A process that was killed has not said good-bye.
            answer(f"last heard {hours(beat.age_s())} ago: {beat.state}: {beat.reason}")
        left = f"; go on with: {resume_line(bank, None)}" if done < total else ""
        if left and _names_rig_file(run_json):
            left += " (with --rig RIG.toml where the rig file was corrected)"
        answer(f"no process owns the bank: no process is measuring{left}")
        return
    _tell_running(owner, stands, beat, pace, total - done)


def _kept(bank: Path) -> dict[int, str]:
    """Positions that the latest session measured and left as they were, and why."""
    kept: dict[int, str] = {}
    for event in last_events(bank):
        if event.get("event") == "session_started":
            break
        if event.get("event") == "position_kept":
            kept[int(str(event["position"]))] = str(event["reason"])
    return dict(sorted(kept.items()))


def _names_rig_file(run_json: str | None) -> bool:
    """Whether a bank's run was measured with a rig file; False where it cannot be understood."""
    try:
        run = json.loads(run_json or "{}")
    except (ValueError, RecursionError):
        return False
    return isinstance(run, dict) and run.get("rig", "virtual") != "virtual"


@dataclass(frozen=True, slots=True)
class _Pace:
    """What the log of the session under way says of its pace: its latest progress, its plan, its latest record."""

    progress: dict[str, object] = field(default_factory=dict)
    planned_s: object = None
    record: dict[str, object] | None = None


def _pace(bank: Path) -> _Pace:
    progress: dict[str, object] = {}
    record: dict[str, object] | None = None
    under_way = True
    for event in last_events(bank):
        match event.get("event"):
            case "record_taken" if under_way and record is None:
                record = {"position": event.get("position"), "number": event.get("record"), "of": event.get("records")}
            case "position_started" | "session_ended":
                under_way = False
            case "progress" if not progress:
                progress = event
            case "session_started":  # what came before was another session's
                return _Pace(progress, None if progress else event.get("planned_s"), record)
            case _:
                pass
        if progress and (record is not None or not under_way):
            break
    return _Pace(progress, None, record)


def _tell_pace(pace: _Pace, state: State, to_go: int) -> None:
    """Tell what is left, all by one clock; a finish only where the session goes on."""
    if not pace.progress:
        if isinstance(pace.planned_s, int | float):
            answer(f"{to_go} positions to go, {a_while(pace.planned_s)} as planned")
        return
    wall_s, rig_s = (float(str(pace.progress.get(key, 0.0))) for key in ("wall_remaining_s", "remaining_s"))
    told = Progress(0.0, 0, 0, 0.0, rig_s, wall_s, 0.0)
    at = datetime.fromisoformat(str(pace.progress["at"])).astimezone()
    if state in (State.RUNNING, State.STOPPING):
        per_hour = float(str(pace.progress.get("wall_positions_per_hour") or pace.progress["positions_per_hour"]))
        answer(f"{per_hour:.0f} positions an hour, {remaining(told)} (last position {at:%H:%M:%S})")
    else:
        answer(f"{to_go} positions to go, about {a_while(wall_s)} once it goes on (last position {at:%H:%M:%S})")


def _tell_running(owner: Owner, stands: Standing, beat: Heartbeat | None, pace: _Pace, to_go: int) -> None:
    who = f"process {owner.pid} on {owner.host}"
    if _is_silent(beat) and beat is not None:
        answer(
            f"{who} owns the bank but has been silent for {hours(beat.age_s())}: it is held, or its machine is asleep "
            f"or hung; it last said {beat.state}: {beat.reason}"
        )
        return
    if stands.state is State.RECOVERING:
        since = datetime.fromisoformat(str(stands.since)).astimezone()
        tries = (stands.recovering or {}).get("tries") or "no"
        answer(
            f"{who} is recovering since {since:%H:%M:%S}: {stands.reason} "
            f"({tries} tries so far); it goes on by itself when the instrument is back"
        )
    elif stands.state is State.RUNNING:
        answer(f"{who} is measuring")
    else:
        answer(f"{who} is {stands.state}: {stands.reason}")
    if beat is not None:
        at = "" if beat.position is None else f", at position {beat.position}"
        if pace.record is not None and beat.position == pace.record["position"]:
            at += f", record {pace.record['number']} of {pace.record['of']}"
        answer(f"last sign of life {hours(beat.age_s())} ago{at}")
        if beat.fault:
            answer(f"last fault: {beat.fault}")
    _tell_pace(pace, stands.state, to_go)


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
    from acquisition.quality.limits import DriftLimits
    from rendering.report.figures import drift_over_time  # the configuration is read for a picture alone
    from wavefocus.campaign.blueprint import bank_configuration

    with open_bank(bank) as view:
        limits = DriftLimits(**bank_configuration(view).run.drift.model_dump())
    write_whole(plot, drift_over_time(drift, limits).png)
    say(f"{plot}: drift of the sentinel position, {len(drift)} measurements")


# The states in which an order is carried out, and those in which it will be, in words.
CARRIED_OUT = {"pause": ("paused",), "go-on": ("running",), "stop": ("stopped", "finished", "failed")}
LOOKS_EVERY_S = 0.1


def order(bank: Path, word: str, wait_s: float, *, as_json: bool) -> Exit:
    """Give an order and wait until it is carried out, or at least heard.

    Raises InputError: no process owns the bank.
    """
    owner = _owner(bank, word)
    given = give_order(bank, word)
    until_s = time.monotonic() + wait_s
    heard, carried_out = None, False
    while not carried_out:
        beat = read_heartbeat(bank)
        if beat is not None and beat.order == given.number:
            heard = beat
            carried_out = beat.state in CARRIED_OUT[word]
        gone = bank_owner(bank) is None
        if gone:
            carried_out = carried_out or (word == "stop" and heard is not None)
            break
        if time.monotonic() >= until_s:
            break
        if not carried_out:
            time.sleep(LOOKS_EVERY_S)
    if heard is None:
        withdraw(bank, given)
    line = _line(bank, owner, heard, wait_s, carried_out=carried_out)
    say(line)
    if as_json:
        state = None if heard is None else heard.state
        print(json.dumps({"order": word, "heard": heard is not None, "carried_out": carried_out, "state": state}))
    return Exit.DONE if heard is not None else Exit.NOT_GOOD_ENOUGH


def _owner(bank: Path, word: str) -> Owner:
    owner = bank_owner(bank)
    if owner is None:
        raise InputError(
            f"{bank}: no process owns the bank, so there is nothing to {word.replace('go-on', 'go on with')}"
        )
    return owner


def _line(bank: Path, owner: Owner, heard: Heartbeat | None, wait_s: float, *, carried_out: bool) -> str:
    who = f"process {owner.pid} on {owner.host}"
    if heard is None:
        beat = read_heartbeat(bank)
        silent = "" if beat is None else f"; its last sign of life is {hours(beat.age_s())} old"
        return f"{bank}: {who} does not answer within {wait_s:g} s{silent}; the order is withdrawn"
    if carried_out:
        return f"{bank}: {who}: {heard.state}: {heard.reason}"
    return f"{bank}: {who} has heard it and is {heard.state}: {heard.reason}; wavefocus status tells when it is done"
