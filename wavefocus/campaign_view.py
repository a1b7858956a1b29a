"""A campaign for people: a progress bar, and a line for everything they should know of."""

from __future__ import annotations

from acquisition.durations import hours
from acquisition.events import (
    Drift,
    Event,
    Fault,
    PositionKept,
    PositionRepeated,
    Progress,
    ReconnectTried,
    SessionEnded,
    SessionStarted,
)
from wavefocus.console import Report, finish_clock, say

# A rig on a virtual clock lives through hours in seconds; then both clocks are told.
_SAME_CLOCK = 0.2


class CampaignView:
    """Subscribes to a campaign's events and shows them on standard error.

    Parameters
    ----------
    report : Report
        The progress bar.
    """

    def __init__(self, report: Report) -> None:
        self._report = report
        self._repeats = 0

    def __call__(self, event: Event) -> None:
        """Show one event."""
        match event:
            case SessionStarted():
                say(
                    f"{event.bank}: {event.done} of {event.positions} positions are in, {event.to_do} to do "
                    f"with {event.actuators} actuators; planned: {hours(event.planned_s)}"
                )
                for instrument in event.instruments:
                    say(f"  {instrument}")
            case Progress():
                self._report(event.done, event.total, self._note(event))
            case PositionRepeated():
                self._repeats += 1
                say(f"position {event.position} is measured again: {event.reason}")
            case PositionKept():
                say(f"position {event.position} stays as the bank has it: {event.reason}")
            case Fault():
                then = "trying again" if event.retried else "not tried again"
                say(f"{event.instrument}: {event.operation}: {event.cause}; {event.remedy} ({then})")
            case ReconnectTried():
                say(_reconnect_line(event))
            case Drift():
                say(
                    f"sentinel position {event.position}: level {event.level_db:+.2f} dB, "
                    f"delay {event.delay_samples:+.3f} samples, correlation {event.correlation:.5f}: "
                    f"{event.verdict}"
                )
            case SessionEnded():
                counts = ", ".join(f"{count} {word}" for word, count in event.counts.items() if count)
                say(
                    f"{event.state}: {event.done} of {event.total} positions ({counts}); "
                    f"{hours(event.time_s)} on the rig's clock, {self._repeats} repeats"
                )
            case _:
                pass

    @staticmethod
    def _note(event: Progress) -> str:
        """The rig's own clock, where it is not the wall's."""
        wall_s, rig_s = event.wall_remaining_s, event.remaining_s
        if rig_s <= 0 or abs(rig_s - wall_s) < _SAME_CLOCK * rig_s:
            return ""
        return f"(rig's clock: {hours(rig_s)} left, finished {finish_clock(rig_s)})"


def _reconnect_line(event: ReconnectTried) -> str:
    """One try for a fresh connection, and when the next one is."""
    if event.connected:
        return f"{event.instrument}: connected again (try {event.number})"
    line = f"{event.instrument}: try {event.number} to connect again failed: {event.outcome}"
    if event.next_try_s is None or event.gives_up_s is None:
        return line
    return f"{line}; next try in {hours(event.next_try_s)}, {hours(event.gives_up_s)} until giving up"
