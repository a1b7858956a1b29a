"""Staggered campaigns, compared with sequential capture before their bank is made; schedules that a bank settled."""

from dataclasses import replace

from wavefocus.campaign.blueprint import Blueprint
from wavefocus.config.messages.campaign import Event, Fault, ScheduleSettled
from wavefocus.configuration import Configuration
from wavefocus.console import say
from wavefocus.rig.setup import open_setup
from wavefocus.storage.errors import InputError


def compared_schedules(blueprint: Blueprint, source: str) -> tuple[ScheduleSettled, ...]:
    """Measure one position of a staggered run by its schedule and sequentially, and say what the difference is.

    Returns events to report; none for sequential runs. Raises InputError: the responses are longer than the taps.
    InstrumentError: an instrument failed.
    """
    if blueprint.plan.staggered is None:
        return ()
    from wavefocus.acquisition.engine.station import compare_schedules  # slow to load, and most runs are sequential

    say("one position is measured by both schedules first, to state what staggered capture loses")
    try:
        with open_setup(blueprint.configuration.rig, blueprint.configuration.run) as setup:
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
