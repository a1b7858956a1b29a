"""Bank and raw file of a session: made where there are none, else found to be of its plan."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np

from wavefocus.acquisition.plays import raw_header, require_same
from wavefocus.acquisition.setup import Setup
from wavefocus.campaign.blueprint import (
    Blueprint,
    bank_configuration,
    blueprint_of,
    require_same_plan,
)
from wavefocus.campaign.schedule_choice import compared_schedules, with_chosen_schedule
from wavefocus.campaign.sidecar_files import raw_path
from wavefocus.config.messages.campaign import Event
from wavefocus.configuration import DEFAULT_CHECKS, check_rows
from wavefocus.console import say
from wavefocus.rig.calibration_validity import with_one_calibration
from wavefocus.rig.input_delay import with_stated_delay
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter, create_bank
from wavefocus.storage.durable import is_network_mount
from wavefocus.storage.errors import ExistsError, InputError
from wavefocus.storage.raw.writer import RawWriter, create_raw


def with_bank(
    blueprint: Blueprint, bank: Path, run_file: Path, *, accept_calibration: bool = False
) -> tuple[Blueprint, tuple[Event, ...]]:
    """Make the bank unless it is there; return the campaign as the bank has it, and what happened on the way."""
    if not bank.exists():
        earlier = compared_schedules(blueprint, str(run_file))
        if is_network_mount(bank.absolute().parent):
            say(f"{bank} is on a network drive, where locks and syncs are unreliable: measure to a local disk")
        with suppress(ExistsError):  # another capture was quicker: go on as one that came later
            create_bank(bank, with_stated_delay(blueprint.bank_header(), blueprint.configuration.rig))
            return blueprint, earlier
    blueprint = with_chosen_schedule(_without_later_checks(blueprint, bank), bank)
    blueprint = with_one_calibration(blueprint, bank, run_file, accept=accept_calibration)
    require_same_plan(bank, blueprint.configuration, blueprint.plan.sha256)
    return blueprint, ()


EARLIER_CHECKS = (None, 12)
"""Check positions of banks that earlier versions began where the run states none."""


def _without_later_checks(blueprint: Blueprint, bank: Path) -> Blueprint:
    """The campaign with the bank's check positions, where an earlier version began it with none, or with fewer."""
    checks = len(check_rows(blueprint.configuration))
    if checks != DEFAULT_CHECKS:
        return blueprint
    with open_bank(bank) as view:
        if view.run_json is None:
            return blueprint
        begun_with = bank_configuration(view).run.grid.check_positions
        regular_mm, own_mm = blueprint.plan.position_mm[:-checks], np.asarray(view.position_mm)
        if begun_with not in EARLIER_CHECKS or not np.array_equal(
            own_mm[: len(own_mm) - (begun_with or 0)], regular_mm
        ):
            return blueprint
    say(
        f"{bank} was begun by an earlier version, with {begun_with or 'no'} check positions: it goes on with its own"
        f" positions, and the {checks} check positions that the run asks for now are left out (wavefocus extend adds"
        " them)"
    )
    run = blueprint.configuration.run
    run = run.model_copy(update={"grid": run.grid.model_copy(update={"check_positions": begun_with})})
    return blueprint_of(replace(blueprint.configuration, run=run, position_mm=own_mm))


def opened_raw(
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
