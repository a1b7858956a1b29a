"""One sentence for each event of a campaign: what the terminal, the window and messages to people show."""

import math

from wavefocus.acquisition.wording import hours
from wavefocus.calibration.evidence import SIGMAS
from wavefocus.config.messages import campaign, tag
from wavefocus.storage.bank.ledger import row_ranges, status_words


def sentence(event: campaign.Event) -> str:
    """An event in words, without a full stop; its name where there is nothing to add, as for progress."""
    match event:
        case campaign.SessionStarted():
            return (
                f"{event.bank}: {event.done} of {event.positions} positions are in, {event.to_do} to do "
                f"with {event.actuators} actuators; planned: {hours(event.planned_s)}"
            )
        case campaign.ScheduleSettled():
            return f"schedule: {event.chosen}: {event.reason}"
        case campaign.StateChanged():
            return f"{event.state}: {event.reason}"
        case campaign.PositionStarted():
            again = f", attempt {event.attempt}" if event.attempt > 1 else ""
            return f"position {event.position} at ({event.x_mm:.1f}, {event.y_mm:.1f}) mm begins{again}"
        case campaign.PositionCommitted():
            figures = ("record's signal-to-noise ratio", event.snr_db), ("residual", event.residual_db)
            known = [f"{words} {value:.1f} dB" for words, value in figures if math.isfinite(value)]
            parts = ", ".join([status_words(event.status).replace("+", ", "), *known])
            return f"position {event.position} is measured: {parts}{f': {event.reason}' if event.reason else ''}"
        case campaign.PositionRepeated():
            return f"position {event.position} is measured again{_otherwise(event)}: {event.reason}"
        case campaign.PositionKept():
            return f"position {event.position} stays as the bank has it: {event.reason}"
        case campaign.PassStarted():
            rows_text = row_ranges(event.positions)
            return f"{len(event.positions)} positions that are not valid are measured again: {rows_text}"
        case campaign.Fault():
            then = "trying again" if event.retried else "not tried again"
            return f"{event.instrument}: {event.operation}: {event.cause}; {event.remedy} ({then})"
        case campaign.ReconnectTried():
            return _reconnect(event)
        case campaign.CrosstalkMeasured():
            if not event.named:
                word = "at" if event.sigmas >= SIGMAS else "below"
                return (
                    f"crosstalk: the loopback leaks into the response input {word} {event.level_db:.0f} dB of its level"
                )
            if not event.marked:
                return event.reason
            return f"{event.reason}; positions {row_ranges(event.marked)} are poor, and so are the next while it lasts"
        case campaign.Drift():
            cause = f" ({event.cause})" if event.cause else ""
            if math.isfinite(event.change):
                cause += f"; rows measured now differ by {100 * event.change:.1f} % from the first"
            return (
                f"sentinel position {event.position}: level {event.level_db:+.2f} dB, "
                f"delay {event.delay_samples:+.3f} samples, correlation {event.correlation:.5f}: "
                f"{event.verdict}{cause}"
            )
        case campaign.ConditionsSeen():
            return f"{'conditions are back' if event.back else 'still suspended'}: {event.reason}"
        case campaign.SessionEnded():
            counts = ", ".join(f"{count} {word}" for word, count in event.counts.items() if count)
            return (
                f"{event.state}: {event.done} of {event.total} positions ({counts}); "
                f"{hours(event.time_s)} on the rig's clock"
            )
    return tag(event)


def _otherwise(event: campaign.PositionRepeated) -> str:
    range_text = "" if event.response_range_v is None else f" with a range of {event.response_range_v:g} V"
    moved_mm = math.hypot(*event.moved_mm)
    return range_text + (f" {moved_mm:.2g} mm aside" if moved_mm else "")


def _reconnect(event: campaign.ReconnectTried) -> str:
    """One try for a fresh connection, and when the next one is."""
    if event.connected:
        return f"{event.instrument}: connected again (try {event.number})"
    line = f"{event.instrument}: try {event.number} to connect again failed: {event.outcome}"
    if event.next_try_s is None or event.gives_up_s is None:
        return line
    return f"{line}; next try in {hours(event.next_try_s)}, {hours(event.gives_up_s)} until giving up"
