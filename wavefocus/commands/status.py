"""``wavefocus status``: how a campaign stands, also while it runs."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

from acquisition.durations import hours
from acquisition.events import State
from acquisition.quality import median_snr_db, status_counts
from calibration.bank import open_bank
from calibration.bank_owner import bank_owner
from wavefocus.console import finish_clock, say
from wavefocus.event_log import last_events


@dataclass(frozen=True, slots=True)
class Standing:
    """What a session's log says of its state, since when, why, and of the instrument it waits for."""

    state: State
    since: str | None = None
    reason: str | None = None
    recovering: dict[str, object] | None = None


def status(bank: Path, *, as_json: bool) -> None:
    """Tell counts per status, who writes, rate and finish time; reads only."""
    with open_bank(bank) as view:
        counts = status_counts(view.status)
        total = view.positions
        done = total - counts["not-measured"]
        snr_db = median_snr_db(view.quality.get("snr_db"), view.status)
        plan_sha256 = view.plan_sha256
    owner = bank_owner(bank)
    newest = next((event for event in last_events(bank) if event.get("event") == "progress"), None)
    stands = _standing(last_events(bank)) if owner else Standing(State.IDLE)
    running = owner is not None and newest is not None
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
        "positions_per_hour": newest["positions_per_hour"] if running and newest else None,
        "remaining_s": newest["remaining_s"] if running and newest else None,
        "last_event_at": newest["at"] if newest else None,
        "plan_sha256": plan_sha256,
    }
    if as_json:
        print(json.dumps(facts))
        return
    words = ", ".join(f"{count} {word}" for word, count in counts.items() if count)
    say(f"{bank}: {done} of {total} positions measured ({words})")
    if snr_db is not None:
        say(f"median signal-to-noise ratio {snr_db:.1f} dB over all pairs")
    if owner is None:
        left = f"; go on with: wavefocus resume {bank}" if done < total else ""
        say(f"no process is measuring{left}")
        return
    if stands.state is State.RECOVERING:
        since = datetime.fromisoformat(str(stands.since)).astimezone()
        tries = (stands.recovering or {}).get("tries") or "no"
        say(
            f"process {owner.pid} on {owner.host} is recovering since {since:%H:%M:%S}: {stands.reason} "
            f"({tries} tries so far); it goes on by itself when the instrument is back"
        )
    else:
        say(f"process {owner.pid} on {owner.host} is measuring")
    if newest is not None:
        remaining_s = float(str(newest["wall_remaining_s"]))
        at = datetime.fromisoformat(str(newest["at"])).astimezone()
        say(
            f"{float(str(newest['positions_per_hour'])):.0f} positions an hour, {hours(remaining_s)} left, "
            f"finished at {finish_clock(remaining_s)} (last position {at:%H:%M:%S})"
        )


def _standing(events: Iterator[dict[str, object]]) -> Standing:
    """The state that a running process logged last; idle while it has not begun its session.

    Parameters
    ----------
    events : iterator of mapping
        From the log, newest first.
    """
    last_try: dict[str, object] | None = None
    for event in events:
        match event:
            case {"event": "reconnect_tried"} if last_try is None:
                last_try = event
            case {"event": "state_changed", "state": State.RUNNING, "at": str(at), "reason": str(reason)}:
                return Standing(State.RUNNING, at, reason)
            case {"event": "state_changed", "state": State.RECOVERING, "at": str(at), "reason": str(reason)}:
                # Before the first try has ended, the fault that came before tells which instrument it is.
                fault = last_try or next((event for event in events if event.get("event") == "fault"), {})
                keys = {"instrument": "instrument", "number": "tries", "outcome": "outcome",
                        "next_try_s": "next_try_s", "gives_up_s": "gives_up_s"}  # fmt: skip
                return Standing(State.RECOVERING, at, reason, {new: fault.get(key) for key, new in keys.items()})
            case {"event": "state_changed" | "session_ended"}:
                break
            case _:
                pass
    return Standing(State.IDLE)
