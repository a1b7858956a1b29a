"""The raw file beside a bank: its name, when it is made and when its absence is refused."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext

import numpy as np

from acquisition.engine.raw_keeping import raw_header, require_same
from acquisition.engine.setup import Setup
from storage.bank.writer import BankWriter
from storage.errors import InputError
from storage.raw.writer import RawWriter, create_raw
from wavefocus.campaign.blueprint import Blueprint
from wavefocus.campaign.sidecar_files import raw_path


def opened_raw(
    blueprint: Blueprint, setup: Setup, bank: BankWriter
) -> AbstractContextManager[RawWriter] | AbstractContextManager[None]:
    """Own the raw file of a campaign that keeps its recordings; it is made while the bank is still empty.

    Parameters
    ----------
    blueprint : Blueprint
        What is measured, and whether recordings are kept.
    setup : Setup
        With what.
    bank : BankWriter
        Where the Green's functions go.

    Raises
    ------
    InputError
        The file is missing though the bank holds positions, of another plan, or recorded with another scale.
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
