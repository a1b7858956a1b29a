"""The schedules that a run could be measured by, side by side."""

from __future__ import annotations

from dataclasses import replace

from acquisition.schedule.expectation import Expectation, expect
from acquisition.schedule.plan import GROUP
from storage.errors import InputError
from wavefocus.campaign.blueprint import Blueprint, blueprint_of


def compared(blueprint: Blueprint) -> list[Expectation]:
    """What may be expected of sequential capture, of staggered capture and of groups, the run's own values kept.

    Parameters
    ----------
    blueprint : Blueprint
        The run; what cannot be played (too short a period) is left out.
    """
    configuration = blueprint.configuration
    actuators = blueprint.plan.actuators
    wanted: list[dict[str, object]] = [{"excitation": "sequential"}, {"excitation": "staggered", "groups": 1}]
    groups = {-(-actuators // GROUP), configuration.run.capture.groups} - {1}
    wanted += [{"excitation": "staggered", "groups": count} for count in sorted(groups)]
    found = []
    for changes in wanted:
        capture = configuration.run.capture.model_copy(update=changes)
        run = configuration.run.model_copy(update={"capture": capture})
        try:
            plan = blueprint_of(replace(configuration, run=run)).plan
        except InputError:
            continue
        found.append(expect(plan, configuration.rig.recorder))
    return found
