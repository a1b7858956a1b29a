"""How a session stands, from its log alone."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from acquisition.engine.events import State

GOING_ON = frozenset({State.RUNNING, State.PAUSING, State.PAUSED, State.SUSPENDED, State.STOPPING})


@dataclass(frozen=True, slots=True)
class Standing:
    """What a session's log says of its state, since when, why, and of the instrument it waits for."""

    state: State
    since: str | None = None
    reason: str | None = None
    recovering: dict[str, object] | None = None


def standing(events: Iterator[dict[str, object]]) -> Standing:
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
            case {"event": "state_changed", "state": State.RECOVERING, "at": str(at), "reason": str(reason)}:
                # Before the first try has ended, the fault that came before tells which instrument it is.
                fault = last_try or next((event for event in events if event.get("event") == "fault"), {})
                keys = {"instrument": "instrument", "number": "tries", "outcome": "outcome",
                        "next_try_s": "next_try_s", "gives_up_s": "gives_up_s"}  # fmt: skip
                return Standing(State.RECOVERING, at, reason, {new: fault.get(key) for key, new in keys.items()})
            case {"event": "state_changed", "state": str(state), "at": str(at), "reason": str(reason)} if (
                state in GOING_ON
            ):
                return Standing(State(state), at, reason)
            case {"event": "state_changed" | "session_ended"}:
                break
            case _:
                pass
    return Standing(State.IDLE)
