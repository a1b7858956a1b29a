"""``wavefocus capture``, ``resume`` and ``remeasure``: sessions of a campaign."""

from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np

from wavefocus.acquisition.attempt import without_recordings
from wavefocus.acquisition.drift_watch import DriftError, SentinelUnusableError
from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.acquisition.setup import identities_of
from wavefocus.calibration.crosstalk import REMEDY
from wavefocus.campaign.blueprint import Blueprint, blueprint_from_files
from wavefocus.campaign.control import CampaignControl, command_line, resume_line
from wavefocus.campaign.session_files import opened_campaign, resumed_campaign, with_bank
from wavefocus.campaign.sidecar_files import EventLines, log_path, read_drift
from wavefocus.campaign.status import CampaignView
from wavefocus.commands.status import is_paused, order
from wavefocus.config.messages.campaign import Event, SessionEnded, State, Subscriber
from wavefocus.console import Exit, print_line, progress, say
from wavefocus.drivers.errors import InstrumentError
from wavefocus.ending import ending_at_once, stop_on_signals
from wavefocus.input_files import parse_positions
from wavefocus.options import SessionOptions
from wavefocus.rig.calibration_validity import refuse_other_devices
from wavefocus.rig.setup import open_setup
from wavefocus.rig.unattended import AliveSignal, kept_awake, messenger_for
from wavefocus.storage.bank.ledger import STATUS_WORDS, Status, not_valid, row_ranges, status_counts
from wavefocus.storage.bank.reading import open_bank, origins_of
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import InputError


def capture(run_file: Path, bank: Path, scene_files: Sequence[Path] = (), *, options: SessionOptions) -> Exit:
    """Start a campaign in a new bank, or go on with it in the bank that is there; only for some scenes if named."""
    asked = blueprint_from_files(run_file)
    if scene_files:
        from wavefocus.campaign.blueprint import needed_by  # with it comes what renders

        needed = needed_by(scene_files, asked)
    # A staggered run is compared with a sequential one first, before the session catches signals.
    with ending_at_once(), _naming_command(command_line("wavefocus", "capture", run_file, "--bank", bank)):
        blueprint, earlier = with_bank(asked, bank, run_file, accept_calibration=options.accept_calibration)
    rig_file = blueprint.configuration.run.rig_file(run_file)
    options = replace(options, rig_file=rig_file)
    if not scene_files:
        return _session(blueprint, bank, None, options, earlier)
    if blueprint.plan.positions != asked.plan.positions:  # a bank of an earlier version, without check positions
        needed = needed_by(scene_files, blueprint)
    with open_bank(bank) as view:
        left = blueprint.plan.to_do(view.status)
    rows = [int(row) for row in left if row in needed]
    done = _session(blueprint, bank, rows, options, earlier) if rows else _nothing_to_measure(bank, options)
    say(
        f"all {len(needed)} positions that are needed are in the bank; the other "
        f"{len(left) - len(rows)} are left, and measured by: {resume_line(bank, rig_file)}"
    )
    return done


def resume(bank: Path, *, options: SessionOptions) -> Exit:
    """Go on with a campaign from the configuration that its bank holds, or with a corrected rig file.

    A capture that is paused is let go on; one that measures is left alone, and BankBusyError says who.

    Raises InputError: options that a capture which is paused cannot take up.
    """
    if is_paused(bank):
        if options.rig_file is not None or options.accept_drift or options.accept_calibration:
            raise InputError(
                f"{bank}: is paused and goes on with the rig that it has open, without --rig, --accept-drift and "
                f"--accept-calibration; end it first: {command_line('wavefocus', 'stop', bank)}, then resume with them"
            )
        return order(bank, "go-on", as_json=options.as_json)
    blueprint = resumed_campaign(bank, options.rig_file, accept_calibration=options.accept_calibration)
    return _session(blueprint, bank, None, options)


def extend(old: Path, bank: Path, run_file: Path, *, options: SessionOptions) -> Exit:
    """Make a bank of the rows of another, with more positions, and measure those."""
    from wavefocus.campaign import extension  # not needed by other captures

    blueprint = extension.extend(old, bank, run_file)
    rig_file = blueprint.configuration.run.rig_file(run_file)
    with open_bank(bank) as view:
        for origin in origins_of(view):
            say(f"{bank}: positions {origin.rows} are taken over from {origin.bank}")
        left = int(np.count_nonzero(view.status == 0))
    if not left:
        say(f"{bank}: all {blueprint.plan.positions} positions are taken over, none is left to measure")
        return _nothing_to_measure(bank, options)
    say(f"{bank}: {left} positions are measured now, after the sentinel, which must be as it was")
    return _session(blueprint, bank, None, replace(options, rig_file=rig_file))


def remeasure(bank: Path, words: str, positions: str, *, replace: bool = False, options: SessionOptions) -> Exit:
    """Measure again the positions of some status, or those named.

    Valid rows are replaced by others only where `replace` says so, or where the latest measurement of the sentinel
    speaks against them.
    """
    blueprint = resumed_campaign(bank, options.rig_file, accept_calibration=options.accept_calibration)
    rows = parse_positions(positions, blueprint.plan.positions) if positions else []
    wanted = _status_bits(words) if words or not positions else Status.NOT_MEASURED
    with open_bank(bank) as view:
        marked = np.flatnonzero(view.status & wanted).tolist()
    chosen = sorted({*marked, *rows})
    if not chosen:
        say("no position of that status: nothing to measure again")
        return _nothing_to_measure(bank, options)
    history = read_drift(bank)
    suspect = history[-1][1].suspect if history else ()
    replaceable = chosen if replace or options.accept_drift or options.accept_calibration else suspect
    return _session(blueprint, bank, chosen, options, replaceable=replaceable)


def _status_bits(words: str) -> Status:
    bits = Status.NOT_MEASURED
    for word in (words or "poor,over-range,failed").split(","):
        if word.strip() not in ("poor", "over-range", "failed", "valid"):
            raise InputError(f"--status: {word.strip()!r} is not known; allowed: poor, over-range, failed, valid")
        bits |= STATUS_WORDS[word.strip()]
    return bits


def _nothing_to_measure(bank: Path, options: SessionOptions) -> Exit:
    """End where no instrument is needed; a program gets the event that ends every session."""
    if options.as_json:
        with open_bank(bank) as view:
            done, of, counts = np.count_nonzero(view.status), view.positions, status_counts(view.status)
        ended = SessionEnded(0.0, State.FINISHED, int(done), of, counts)
        EventLines(print_line, "standard output")(ended)
    return Exit.DONE


def _session(
    blueprint: Blueprint,
    bank: Path,
    rows: Sequence[int] | None,
    options: SessionOptions,
    earlier: Sequence[Event] = (),
    *,
    replaceable: Sequence[int] = (),
) -> Exit:
    """Carry out one session with log, progress and signals around it; `earlier` happened before it."""
    stop, rig_file = StopRequest(), options.rig_file
    plan, rig = blueprint.plan, blueprint.configuration.rig
    with (
        _naming_resume_command(bank, rig_file),
        messenger_for(bank, rig.messages, resume_line(bank, rig_file)) as messenger,
        AliveSignal(rig.messages),
        kept_awake(f"measuring {bank.name}"),
        BankWriter.open(bank, plan_sha256=plan.sha256) as writer,
        # Outside of the instruments, so that no second Ctrl-C keeps them from being put to rest.
        stop_on_signals(stop),
        CampaignControl(bank, stop) as control,
        open_setup(rig, blueprint.configuration.run, bank=writer) as setup,
        progress("capture", plan.positions, timed=False) as report,
        ExitStack() as opened,
    ):
        if writer.status.any():
            refuse_other_devices(rig, identities_of(setup), bank, accept=options.accept_calibration)
        subscribers: dict[str, Subscriber] = {
            "the heartbeat": control,
            "the progress display": CampaignView(report),
            "the sending of messages": messenger,
        }
        if options.as_json:
            subscribers["standard output"] = EventLines(print_line, "standard output")
        campaign, raw = opened.enter_context(opened_campaign(blueprint, setup, writer, stop, subscribers, earlier, say))
        if raw is not None and rows is None and (bare := without_recordings(writer.status, raw)):
            say(f"{raw.path} lacks the recordings of {len(bare)} measured position(s): measured again")
            rows = [*plan.to_do(writer.status).tolist(), *bare]
        ended = campaign.run(rows, accept_drift=options.accept_drift, replaceable=replaceable)
        if ended.state is State.STOPPED:
            say(f"nothing measured is lost; go on with: {resume_line(bank, rig_file)}")
            # From in here, so that an instrument that cannot be put to rest is reported and does not hide the stop.
            raise KeyboardInterrupt
        if writer.renamed:
            say(f"warning: {bank} was renamed while it was measured; it has its name again, next to the other")
        bad, leak = not_valid(writer.status), campaign.crosstalk
        suspects = [row for row in bad if writer.status[row] and writer.record(row).suspect]
    if bad:
        rows_text = row_ranges(bad)
        say(
            f"{len(bad)} of {plan.positions} positions are not valid: {rows_text}; {log_path(bank)} says why; measure "
            f"them again with: {resume_line(bank, rig_file, word='remeasure')}"
            + (f" once the crosstalk is gone ({leak}): {REMEDY}" if leak else "")
        )
    if suspects:
        say(
            f"{len(suspects)} of them are suspect, for the sentinel position had changed after they were measured (the "
            f"vibrometer's range, a gain or the plate): {row_ranges(suspects)}; put it right before that"
        )
    return Exit.DONE


@contextmanager
def _naming_resume_command(bank: Path, rig_file: Path | None) -> Iterator[None]:
    """Add the command that goes on to the message of an instrument that failed, or of a plate that has changed."""
    corrected = "" if rig_file is not None else "; a corrected rig file is taken by --rig RIG.toml"
    try:
        with _naming_command(resume_line(bank, rig_file), corrected):
            yield
    except SentinelUnusableError:
        raise
    except DriftError as changed:
        again = ""
        if changed.suspects:
            remeasure = resume_line(bank, None, word="remeasure")
            again = f"; {remeasure} --positions {row_ranges(changed.suspects)} and resume"
        anyway = f"{resume_line(bank, rig_file)} --accept-drift goes on all the same"
        raise DriftError(f"{changed}{again}; {anyway}", changed.suspects) from changed


@contextmanager
def _naming_command(command: str, corrected: str = "") -> Iterator[None]:
    """Add the command that goes on to the message of an instrument that failed."""
    try:
        yield
    except DriftError:
        raise
    except InstrumentError as failure:
        remedy = f"{failure.remedy}; nothing measured is lost{corrected}; then go on with: {command}"
        raise type(failure)(failure.instrument, failure.operation, failure.cause, remedy) from failure
