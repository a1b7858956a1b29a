"""Bank and raw file of a session, made or found to be of its plan; staggered runs are compared with sequential ones."""

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from wavefocus.acquisition.attempt import raw_header, require_same
from wavefocus.acquisition.engine.campaign import Campaign
from wavefocus.acquisition.engine.session import LOG, EventPublisher, StopRequest
from wavefocus.acquisition.setup import Setup
from wavefocus.campaign.blueprint import (
    Blueprint,
    bank_configuration,
    blueprint_from_bank,
    blueprint_of,
    listed_differences,
    refuse_differences,
)
from wavefocus.campaign.sidecar_files import EventLog, drift_path, log_path, raw_path, unvouched_rows
from wavefocus.config.messages.campaign import CrosstalkMeasured, Drift, Event, Fault, ScheduleSettled, Subscriber
from wavefocus.configuration import DEFAULT_CHECKS, Configuration, check_rows, named_rig, plan_differences, with_rig
from wavefocus.console import say, spinner
from wavefocus.rig.calibration_validity import with_one_calibration
from wavefocus.rig.setup import open_setup, with_stated_delay
from wavefocus.storage.bank.layout import create_bank
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.durable import is_network_mount
from wavefocus.storage.errors import ExistsError, InputError
from wavefocus.storage.raw.header import create_raw
from wavefocus.storage.raw.writer import RawWriter


def with_bank(
    blueprint: Blueprint, bank: Path, run_file: Path, *, accept_calibration: bool = False
) -> tuple[Blueprint, tuple[Event, ...]]:
    """Make the bank unless it is there; return the campaign as the bank has it, and what happened on the way."""
    if not bank.exists():
        earlier = _compared_schedules(blueprint, str(run_file))
        if is_network_mount(bank.absolute().parent):
            say(f"{bank} is on a network drive, where locks and syncs are unreliable: measure to a local disk")
        with suppress(ExistsError):  # another capture was quicker: go on as one that came later
            create_bank(bank, with_stated_delay(blueprint.bank_header(), blueprint.configuration.rig))
            return blueprint, earlier
    return _as_begun(blueprint, bank, run_file, accept_calibration=accept_calibration), ()


def _as_begun(blueprint: Blueprint, bank: Path, run_file: Path, *, accept_calibration: bool) -> Blueprint:
    """The campaign of a run file as its bank has begun it.

    Raises InputError: the bank is of another plan or calibration.
    """
    with open_bank(bank) as view:
        if view.rig_json is None or view.run_json is None:
            return blueprint  # made by other means; refused in its own words when it is opened
        own, sha256 = bank_configuration(view), view.plan_sha256
    asked = blueprint.configuration
    configuration = with_chosen_schedule(_with_begun_checks(asked, own, bank), own)
    if configuration is not asked:
        blueprint = blueprint_of(configuration)
    blueprint = with_one_calibration(blueprint, bank, run_file, own.rig, sha256, accept=accept_calibration)
    if blueprint.plan.sha256 != sha256:
        refuse_differences(bank, own, blueprint.configuration)
    return blueprint


def resumed_campaign(bank: Path, rig_file: Path | None, *, accept_calibration: bool) -> Blueprint:
    """The campaign of a bank; with another rig file other ports, names and limits, but rows of the same kind.

    Raises InputError: the rig file is wrong, or its rows would differ in kind from the bank's; the message names the
    keys.
    """
    own = blueprint_from_bank(bank)
    if rig_file is None:
        return own
    rig, own_rig = named_rig(rig_file), own.configuration.rig
    changed = blueprint_of(with_rig(own.configuration, rig, str(rig_file)))
    calibrated = rig.calibration.measured != own_rig.calibration.measured
    if changed.plan.sha256 != own.plan.sha256 and not calibrated:  # another calibration has words of its own
        keys = listed_differences(plan_differences(own.configuration, changed.configuration))
        raise InputError(
            f"{rig_file}: differs from the rig that {bank} was measured with in {keys}; ports, addresses, device "
            "names, limits and time-outs may change, these may not: undo the change, or start a new bank"
        )
    return with_one_calibration(changed, bank, rig_file, own_rig, own.plan.sha256, accept=accept_calibration)


def _with_begun_checks(asked: Configuration, own: Configuration, bank: Path) -> Configuration:
    """The configuration with the bank's check positions, where an earlier version began it with none, or with fewer."""
    checks, begun_with = len(check_rows(asked)), own.run.grid.check_positions
    # Check positions of banks that earlier versions began where the run states none.
    if checks != DEFAULT_CHECKS or begun_with not in (None, 12):
        return asked
    own_mm = np.asarray(own.position_mm)
    if not np.array_equal(own_mm[: len(own_mm) - (begun_with or 0)], asked.position_mm[:-checks]):
        return asked
    say(
        f"{bank} was begun by an earlier version, with {begun_with or 'no'} check positions: it goes on with its own"
        f" positions, and the {checks} check positions that the run asks for now are left out (wavefocus extend adds"
        " them)"
    )
    run = asked.run.model_copy(update={"grid": asked.run.grid.model_copy(update={"check_positions": begun_with})})
    return replace(asked, run=run, position_mm=own_mm)


@contextmanager
def opened_campaign(
    blueprint: Blueprint,
    setup: Setup,
    bank: BankWriter,
    stop: StopRequest,
    subscribers: Mapping[str, Subscriber],
    earlier: Sequence[Event] = (),
    report: Callable[[str], object] = LOG.error,
) -> Iterator[tuple[Campaign, RawWriter | None]]:
    """A campaign that logs next to its bank, and its raw file where it keeps recordings; `earlier` happened before.

    report: Receives what a subscriber cannot take.

    Raises InputError: see `_opened_raw`.
    """
    path = bank.path
    with (
        _opened_raw(blueprint, setup, bank) as raw,
        EventLog(log_path(path)) as log,
        EventLog(drift_path(path), Drift, CrosstalkMeasured) as drift,
    ):
        publish = EventPublisher({"the event log": log, "the drift history": drift, **subscribers}, report)
        for event in earlier:
            publish(event)
        unvouched = unvouched_rows(path, bank.header.positions)
        yield Campaign(blueprint.plan, setup, bank, publish, stop, raw=raw, unvouched=unvouched), raw


def _opened_raw(
    blueprint: Blueprint, setup: Setup, bank: BankWriter
) -> AbstractContextManager[RawWriter] | AbstractContextManager[None]:
    """Own the raw file of a campaign that keeps its recordings; it is made while the bank is still empty.

    Raises InputError: the file is missing though the bank holds positions, of another plan, or recorded with another
    scale.
    """
    if not blueprint.configuration.run.capture.keep_raw:
        return nullcontext()
    path = raw_path(bank.path)
    header = blueprint.bank_header()
    wanted = raw_header(
        blueprint.plan, setup, rig_json=header.rig_json, run_json=header.run_json, software=header.software
    )
    if not path.exists():
        if np.any(bank.status):
            raise InputError(
                f"{path} is missing, and {bank.path} holds positions whose recordings it kept; put it back, or start a "
                "new bank"
            )
        create_raw(path, wanted)
    raw = RawWriter.open(path, plan_sha256=blueprint.plan.sha256)
    try:
        require_same(raw, wanted)
    except BaseException:
        raw.close()
        raise
    return raw


def _compared_schedules(blueprint: Blueprint, source: str) -> tuple[ScheduleSettled, ...]:
    """Measure one position of a staggered run by its schedule and sequentially, and say what the difference is.

    Returns events to report; none for sequential runs. Raises InputError: the responses are longer than the taps.
    InstrumentError: an instrument failed.
    """
    if blueprint.plan.staggered is None:
        return ()
    from wavefocus.acquisition.engine.station import compare_schedules

    try:
        with (
            open_setup(blueprint.configuration.rig, blueprint.configuration.run) as setup,
            spinner("measuring one position by both schedules, to state what staggered capture loses"),
        ):
            found = compare_schedules(blueprint.plan, setup, _say_fault)
    except InputError as error:
        raise InputError(f"{source}: capture: {error}") from None
    say(found.reason)
    return (found,)


def _say_fault(event: Event) -> None:
    if isinstance(event, Fault):
        say(f"{event.instrument}: {event.operation}: {event.cause}" + ("; repeated" if event.retried else ""))


def with_chosen_schedule(asked: Configuration, own: Configuration) -> Configuration:
    """Use the schedule that a bank of an earlier version has settled, where the run file still asks for the same."""
    run, held = asked.run, own.run
    if run.settled is not None or held.settled is None or run.capture.excitation != "staggered":
        return asked
    without = {"keep_raw"}
    if held.settled.asked.model_dump(exclude=without) != run.capture.model_dump(exclude=without):
        return asked
    capture = held.capture.model_copy(update={"keep_raw": run.capture.keep_raw})
    return replace(asked, run=run.with_schedule(capture, held.settled.reason))
