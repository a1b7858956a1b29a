"""Which schedule a staggered campaign takes: tried before its bank is made, and found again in the bank."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from wavefocus.acquisition.wording import hours
from wavefocus.campaign.blueprint import Blueprint, bank_configuration, blueprint_of
from wavefocus.config.messages.campaign import Event, Fault, ScheduleSettled
from wavefocus.config.run import Capture, RunConfig
from wavefocus.console import say
from wavefocus.rig.setup import open_setup
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.acquisition.trial import ScheduleTest

# Taps that are so many times what the responses need are worth a word.
GENEROUS = 1.3


def choose_schedule(blueprint: Blueprint, source: str) -> tuple[Blueprint, tuple[ScheduleSettled, ...]]:
    """Try a staggered run's schedules at one position and choose one; other runs stay as they are.

    Returns the blueprint that the bank is to be made of, and events to report. Raises InputError: the responses
    are longer than the taps, or staggered capture does not pay and the run says to refuse then. Raises InstrumentError:
    an instrument failed.
    """
    run = blueprint.configuration.run
    if not run.awaits_trial:
        return blueprint, ()
    from wavefocus.acquisition.trial import run_trial  # most runs need no trial, and it is slow to load

    say("one position is measured by every schedule first, to see whether staggered capture pays")
    try:
        with open_setup(blueprint.configuration.rig, run) as setup:
            trial = run_trial(blueprint.plan, setup, run.capture.allowed_loss_db, _say_fault)
    except InputError as error:
        raise InputError(f"{source}: capture: {error}") from None
    chosen, reason = trial.verdict.chosen, trial.verdict.reason
    if chosen is not trial.candidates[0] and run.capture.when_staggered_does_not_pay == "refuse":
        raise InputError(f'{source}: capture.excitation = "staggered": {reason}; nothing was measured')
    changes: dict[str, object] = {"level_db": run.capture.level_db + chosen.level_db}
    changes |= {"groups": chosen.groups} if chosen.groups else {"excitation": "sequential"}
    settled = _with_run(blueprint, run.with_schedule(run.capture.model_copy(update=changes), reason))
    event = ScheduleSettled(
        trial.took_s,
        trial.position,
        chosen.name,
        reason,
        chosen.campaign_s / 3600,
        tuple(asdict(one) for one in trial.candidates),
    )
    say(reason)
    if advice := _advice(trial, run.capture):
        say(advice)
    return settled, (event,)


def _say_fault(event: Event) -> None:
    if isinstance(event, Fault):
        say(f"{event.instrument}: {event.operation}: {event.cause}" + ("; repeated" if event.retried else ""))


def with_chosen_schedule(blueprint: Blueprint, bank: Path) -> Blueprint:
    """Use the schedule that a trial chose for a bank, where the run file still asks for the same."""
    run = blueprint.configuration.run
    if not run.awaits_trial:
        return blueprint
    with open_bank(bank) as content:
        held = bank_configuration(content).run
    if held.settled is None or _trial_request(held.settled.asked) != _trial_request(run.capture):
        return blueprint
    capture = held.capture.model_copy(update={"keep_raw": run.capture.keep_raw})
    return _with_run(blueprint, run.with_schedule(capture, held.settled.reason))


def _trial_request(capture: Capture) -> dict[str, object]:
    """What a trial was asked: all but whether recordings are kept."""
    return capture.model_dump(exclude={"keep_raw"})


def _with_run(blueprint: Blueprint, run: RunConfig) -> Blueprint:
    return blueprint_of(replace(blueprint.configuration, run=run))


def _advice(trial: ScheduleTest, capture: Capture) -> str:
    if trial.decay is None:
        return "the decay of the responses cannot be measured at this position: noise hides it"
    needed = trial.decay.needed_taps
    if capture.taps < GENEROUS * needed:
        return ""
    stagger_s = trial.decay.needed_stagger_s
    saved_s = trial.verdict.chosen.campaign_s * max(1 - stagger_s / capture.stagger_s, 0)
    saves = f" and save up to {hours(saved_s)}" if trial.verdict.chosen.groups else ""
    return (
        f"the responses fall by {trial.decay.rate_db_s:.0f} dB a second: taps = {needed} and stagger_s = "
        f"{stagger_s:.3f} would do{saves}"
    )
