"""``wavefocus status``, ``pause`` and ``stop``: how a campaign stands, and orders to it."""

import json
import time
from collections.abc import Iterator, Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from wavefocus.acquisition.event_wording import sentence
from wavefocus.acquisition.wording import a_while, hours
from wavefocus.calibration.estimator.noise_error import median_noise_error_db
from wavefocus.campaign.control import Word, give_order, read_heartbeat, resume_line, withdraw
from wavefocus.campaign.sidecar_files import read_crosstalk, read_drift, suspect_rows
from wavefocus.campaign.status import CampaignStatus, Heartbeat, campaign_status, instant, remaining
from wavefocus.config.messages import to_record
from wavefocus.config.messages.campaign import State
from wavefocus.console import Exit, answer, say
from wavefocus.storage.bank.ledger import median_of_pairs, row_ranges, status_counts
from wavefocus.storage.bank.reading import open_bank, origins_of
from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.owner import Owner, bank_owner

# So many positions that stayed as they were are listed one by one.
MAX_LINES = 5
MAX_NOTES = 10


def status(bank: Path, *, as_json: bool) -> None:
    """Print counts per status, who writes, how it stands and when it will have finished; reads only.

    Raises InputError: the bank cannot be read.
    """
    facts, owner, beat = _bank_facts(bank), bank_owner(bank), read_heartbeat(bank)
    stands = campaign_status(bank, owner, beat)
    facts |= _campaign_facts(bank, owner, beat, stands)
    if as_json:
        print(json.dumps(facts))
        return
    for line in [*_bank_sentences(facts), *_campaign_sentences(facts, beat, stands)]:
        answer(line)


def _bank_facts(bank: Path) -> dict[str, Any]:
    with open_bank(bank) as view:
        counts, broken = status_counts(view.status), np.flatnonzero(view.broken).tolist()
        counts["damaged"] = len(broken)
        counts["not-measured"] -= len(broken)
        moved_mm = view.quality["moved_mm"]
        moved = np.flatnonzero(moved_mm > 0).tolist()
        return {
            "bank": str(bank),
            "positions": view.positions,
            "check_positions": list(view.check_rows),
            "done": view.positions - counts["not-measured"] - len(broken),
            "counts": counts,
            "damaged_positions": broken,
            "median_snr_db": median_of_pairs(view.quality.get("snr_db"), view.status),
            "median_noise_error_db": median_noise_error_db(view),
            "moved_positions": row_ranges(moved),
            "moved_mm": float(np.nanmax(moved_mm)) if moved else 0.0,
            "plan_sha256": view.plan_sha256,
            "inter_channel_delay_s": view.inter_channel_delay_s,
            "origins": [asdict(origin) for origin in origins_of(view)],
            "import_report": view.import_facts or None,
            "notes": [asdict(note) for note in view.notes],
            "unknown_attributes": list(view.unknown_attributes),
        }


def _campaign_facts(
    bank: Path, owner: Owner | None, beat: Heartbeat | None, stands: CampaignStatus
) -> dict[str, object]:
    progress, record, leak = stands.progress, stands.record, read_crosstalk(bank)
    return {
        "state": stands.state,
        "state_since": stands.since and instant(stands.since),
        "state_reason": stands.reason if stands.since else None,
        "recovering": recovery(stands),
        "owner": {"host": owner.host, "pid": owner.pid} if owner else None,
        "last_sign_of_life": beat and {
            "at": beat.at.isoformat(), "age_s": round(beat.age_s(), 1), "state": beat.state, "reason": beat.reason,
            "position": beat.position, "remaining_s": beat.remaining_s, "fault": beat.fault or None,
            "finish_at": beat.finish_at and beat.finish_at.isoformat(),
        },
        "silent": owner is not None and beat is not None and beat.is_silent(),
        "positions_per_hour": progress and progress.positions_per_hour,
        "remaining_s": progress.remaining_s if progress else stands.planned_s,
        "wall_positions_per_hour": progress and progress.wall_positions_per_hour,
        "wall_remaining_s": progress and progress.wall_remaining_s,
        "record": record and {"position": record.position, "number": record.record, "of": record.records},
        "last_event_at": stands.last_event_at and instant(stands.last_event_at),
        "suspect_positions": suspect_rows(read_drift(bank)),
        "crosstalk": None if leak is None else to_record(leak) | {"sentence": leak.reason or sentence(leak)},
        "kept_positions": [{"position": position, "reason": reason} for position, reason in stands.kept.items()],
    }  # fmt: skip


def recovery(stands: CampaignStatus) -> dict[str, object] | None:
    """The instrument that a campaign waits for, and the latest try to connect to it again; None where it does not."""
    if stands.state is not State.RECOVERING:
        return None
    tried, waits_for = stands.tried, stands.tried or stands.fault
    return {
        "instrument": waits_for and waits_for.instrument,
        "tries": tried and tried.number,
        "outcome": tried and tried.outcome,
        "next_try_s": tried and tried.next_try_s,
        "gives_up_s": tried and tried.gives_up_s,
    }


def _bank_sentences(facts: Mapping[str, Any]) -> Iterator[str]:
    bank, notes, imported = facts["bank"], facts["notes"], facts["import_report"]
    words = ", ".join(f"{count} {word}" for word, count in facts["counts"].items() if count)
    yield f"{bank}: {facts['done']} of {facts['positions']} positions measured ({words})"
    if rows := facts["check_positions"]:
        yield f"positions {row_ranges(rows)} lie off the grid and only judge what is interpolated between it"
    if imported:
        yield str(imported.get("paragraph", ""))
    for origin in facts["origins"]:
        source = "an earlier plan of this bank" if origin["bank"] == Path(bank).name else origin["bank"]
        yield f"positions {origin['rows']} were taken over from {source} ({origin['plan_sha256'][:8]})"
    for note in notes[-MAX_NOTES:]:
        yield f"note {note['at'][:16].replace('T', ' ')}: {note['text']}"
    if len(notes) > MAX_NOTES:
        yield f"and {len(notes) - MAX_NOTES} earlier notes; --json has all"
    if unknown := facts["unknown_attributes"]:
        yield f"attributes that somebody has added: {', '.join(unknown)}"
    if (delay_s := facts["inter_channel_delay_s"]) is not None:
        yield f"the response is sampled {1e6 * delay_s:.2f} us after the reference, as the recorder stated"
    if broken := facts["damaged_positions"]:
        yield (
            f"the checksums of positions {row_ranges(broken)} do not hold; measure them again with: "
            f"wavefocus resume {bank}"
        )
    if (snr_db := facts["median_snr_db"]) is not None:
        error_db = facts["median_noise_error_db"]
        follows = "" if error_db is None else f"; error from white noise, which follows from it, {error_db:.1f} dB"
        yield f"medians over all pairs: signal-to-noise ratio of the records {snr_db:.1f} dB{follows}"
    if moved := facts["moved_positions"]:
        yield f"measured up to {facts['moved_mm']:.2g} mm off their position, where there was light: {moved}"


def _campaign_sentences(facts: Mapping[str, Any], beat: Heartbeat | None, stands: CampaignStatus) -> Iterator[str]:
    bank, kept, owner = facts["bank"], facts["kept_positions"], facts["owner"]
    to_go = facts["positions"] - facts["done"]
    for one in kept[:MAX_LINES]:
        yield f"position {one['position']} stayed as the bank had it: {one['reason']}"
    if len(kept) > MAX_LINES:
        rows = row_ranges([one["position"] for one in kept])
        yield f"and {len(kept) - MAX_LINES} more stayed as the bank had them: {rows}"
    if suspect := facts["suspect_positions"]:
        yield (
            f"the sentinel position had changed after positions {suspect} were measured: put it right, then "
            f"wavefocus remeasure {bank} --positions {suspect}"
        )
    if facts["crosstalk"]:
        yield facts["crosstalk"]["sentence"]
    if owner is not None:
        yield from _running_sentences(f"process {owner['pid']} on {owner['host']}", stands, beat, to_go)
        return
    last = ""
    if beat is not None and beat.state not in ("finished", "idle"):
        # The heartbeat of a process that was killed keeps its last state.
        last = f" (last sign of life {beat.age_words()}: {beat.state}: {beat.reason})"
    if last or not facts["import_report"]:
        left = f"; go on with: {resume_line(Path(bank), None)}" if to_go else ""
        yield f"no process owns the bank and none is measuring{last}{left}"


def _running_sentences(who: str, stands: CampaignStatus, beat: Heartbeat | None, to_go: int) -> Iterator[str]:
    if beat is not None and beat.is_silent():
        silence = hours(beat.age_s())
        if beat.age_s() < 0:
            silence = f"an unknown time (its last sign of life is {beat.age_words()})"
        yield (
            f"{who} owns the bank but has been silent for {silence}: it is held, or its machine is asleep "
            f"or hung; it last said {beat.state}: {beat.reason}"
        )
        return
    if stands.state is State.RECOVERING and stands.since is not None:
        since = stands.since.astimezone()
        tries = stands.tried.number if stands.tried else "no"
        yield (
            f"{who} is recovering since {since:%H:%M:%S}: {stands.reason} "
            f"({tries} tries so far); it goes on by itself when the instrument is back"
        )
    elif stands.state is State.RUNNING:
        yield f"{who} is measuring"
    else:
        yield f"{who} is {stands.state}: {stands.reason}"
    if beat is not None:
        at = "" if beat.position is None else f", at position {beat.position}"
        if stands.record is not None and beat.position == stands.record.position:
            at += f", record {stands.record.record} of {stands.record.records}"
        yield f"last sign of life {beat.age_words()}{at}"
        if beat.fault:
            yield f"last fault: {beat.fault}"
    yield from _pace_sentences(stands, to_go)


def _pace_sentences(stands: CampaignStatus, to_go: int) -> Iterator[str]:
    """The time left; a finish only where the session goes on."""
    progress = stands.progress
    if progress is None or stands.progress_at is None:
        if stands.planned_s is not None:
            yield f"{to_go} positions to go, {a_while(stands.planned_s)} as planned"
        return
    at = stands.progress_at.astimezone()
    if stands.state in (State.RUNNING, State.STOPPING):
        left = f", {time_left}" if (time_left := remaining(progress)) else ""
        yield f"{progress.per_hour:.0f} positions an hour{left} (last position {at:%H:%M:%S})"
    else:
        wall = a_while(progress.wall_remaining_s)
        yield f"{to_go} positions to go, about {wall} once it goes on (last position {at:%H:%M:%S})"


# The states in which an order is carried out, and those in which it will be, in words.
_CARRIED_OUT = {"pause": ("paused",), "go-on": ("running",), "stop": ("stopped", "finished", "failed")}
WAITS_S = 15.0


def is_paused(bank: Path) -> bool:
    """Whether a process measures into a bank and is paused, or about to be."""
    if (owner := bank_owner(bank)) is None:
        return False
    beat = read_heartbeat(bank)
    # While an instrument is reconnected, or the conditions are waited for, no state says that a pause follows.
    if beat is not None and beat.pid == owner.pid and beat.pause_asked:
        return True
    return campaign_status(bank, owner, beat).state in (State.PAUSED, State.PAUSING)


def order(bank: Path, word: Word, *, as_json: bool) -> Exit:
    """Give an order and wait until it is carried out, or at least received.

    Raises InputError: no process owns the bank.
    """
    if (owner := bank_owner(bank)) is None:
        raise InputError(f"{bank}: no process owns the bank, so there is nothing to {word}")
    given, until_s = give_order(bank, word), time.monotonic() + WAITS_S
    received, carried_out = None, False
    while True:
        beat = read_heartbeat(bank)
        if beat is not None and beat.order == given.number:
            received, carried_out = beat, beat.state in _CARRIED_OUT[word]
        gone = bank_owner(bank) is None
        if carried_out or gone or time.monotonic() >= until_s:
            break
        time.sleep(0.1)
    carried_out = carried_out or (gone and word == "stop" and received is not None)
    if received is None:
        withdraw(bank, given)
        silent = "" if beat is None else f"; its last sign of life: {beat.age_words()}"
        fate = f"does not answer within {WAITS_S:g} s{silent}; the order is withdrawn"
    elif carried_out:
        fate = f"{received.state}: {received.reason}"
    else:
        fate = f"has received it and is {received.state}: {received.reason}; see wavefocus status"
    say(f"{bank}: process {owner.pid} on {owner.host}{':' if carried_out else ''} {fate}")
    if as_json:
        state = None if received is None else received.state
        print(json.dumps({"order": word, "heard": received is not None, "carried_out": carried_out, "state": state}))
    return Exit.DONE if received is not None else Exit.NOT_GOOD_ENOUGH
