"""``wavefocus capture``, ``resume`` and ``remeasure``: sessions of a campaign."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from acquisition.engine import Campaign
from acquisition.events import Event, State, Subscriber
from acquisition.quality import STATUS_WORDS, Status
from acquisition.stopping import StopRequest, stop_on_signals
from calibration.bank import open_bank
from calibration.bank_creation import create_bank
from calibration.bank_writer import BankWriter
from calibration.errors import InputError
from calibration.network_mount import is_network_mount
from drivers.errors import InstrumentError
from wavefocus.campaign_view import CampaignView
from wavefocus.compose import Blueprint, blueprint_from_bank, blueprint_from_files, open_setup
from wavefocus.console import progress, say
from wavefocus.event_log import EventLines, EventLog, print_line
from wavefocus.exits import Exit
from wavefocus.positions import parse_positions


def capture(run_file: Path, bank: Path, *, as_json: bool, accept_drift: bool) -> Exit:
    """Start a campaign in a new bank, or go on with it in the bank that is there."""
    blueprint = blueprint_from_files(run_file)
    if not bank.exists():
        if is_network_mount(bank.absolute().parent):
            say(f"{bank} is on a network drive, where locks and syncs are unreliable: measure to a local disk")
        create_bank(bank, blueprint.bank_header())
    return _session(blueprint, bank, None, as_json=as_json, accept_drift=accept_drift)


def resume(bank: Path, *, as_json: bool, accept_drift: bool) -> Exit:
    """Go on with a campaign from the configuration that its bank holds."""
    return _session(blueprint_from_bank(bank), bank, None, as_json=as_json, accept_drift=accept_drift)


def remeasure(bank: Path, words: str, positions: str, *, as_json: bool, accept_drift: bool) -> Exit:
    """Measure again the positions of some status, or those named."""
    blueprint = blueprint_from_bank(bank)
    rows = parse_positions(positions, blueprint.plan.positions) if positions else []
    wanted = _status_bits(words) if words or not positions else Status.NOT_MEASURED
    with open_bank(bank) as view:
        marked = {int(row) for row in blueprint.plan.order if view.status[row] & wanted}
    chosen = [int(row) for row in blueprint.plan.order if row in marked or row in set(rows)]
    if not chosen:
        say("no position of that status: nothing to measure again")
        return Exit.DONE
    return _session(blueprint, bank, chosen, as_json=as_json, accept_drift=accept_drift)


def _status_bits(words: str) -> Status:
    """Status bits from words with commas between; all that is not good when none is given."""
    bits = Status.NOT_MEASURED
    for word in (words or "poor,over-range,failed").split(","):
        if word.strip() not in ("poor", "over-range", "failed", "valid"):
            raise InputError(f"--status: {word.strip()!r} is not known; allowed: poor, over-range, failed, valid")
        bits |= STATUS_WORDS[word.strip()]
    return bits


def _session(
    blueprint: Blueprint, bank: Path, rows: Sequence[int] | None, *, as_json: bool, accept_drift: bool
) -> Exit:
    """Carry out one session with log, progress and signals around it."""
    stop = StopRequest()
    plan = blueprint.plan
    with (
        _told_how_to_go_on(bank),
        BankWriter.open(bank, plan_sha256=plan.sha256) as writer,
        # Outside of the instruments, so that no impatient Ctrl-C keeps them from being put to rest.
        stop_on_signals(stop),
        open_setup(blueprint.configuration.rig, blueprint.configuration.run) as setup,
        EventLog(bank) as log,
        progress("capture", plan.positions) as report,
    ):
        subscribers: list[Subscriber] = [log, CampaignView(report)]
        if as_json:
            subscribers.append(EventLines(print_line, "standard output"))

        def publish(event: Event) -> None:
            for subscriber in subscribers:
                subscriber(event)

        ended = Campaign(plan, setup, writer, publish, stop).run(rows, accept_drift=accept_drift)
        if ended.state is State.STOPPED:
            say(f"nothing measured is lost; go on with: wavefocus resume {bank}")
            # From in here, so that an instrument that cannot be put to rest is told and does not hide the stop.
            raise KeyboardInterrupt
    if poor := sum(ended.counts[word] for word in ("poor", "over-range", "failed")):
        say(f"{poor} positions are not valid; measure them again with: wavefocus remeasure {bank}")
    return Exit.DONE


@contextmanager
def _told_how_to_go_on(bank: Path) -> Iterator[None]:
    """Let an instrument's last word end with the command that goes on with the campaign."""
    try:
        yield
    except InstrumentError as failure:
        remedy = f"{failure.remedy}; nothing measured is lost; then go on with: wavefocus resume {bank}"
        raise type(failure)(failure.instrument, failure.operation, failure.cause, remedy) from failure
