"""From configuration to the campaign that it asks for: plan, header, estimator, needed positions, resume command."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.acquisition.plan import Plan
from wavefocus.calibration.excitation import PlayedExcitation, StaggeredSignal
from wavefocus.configuration import (
    Configuration,
    Difference,
    check_rows,
    configuration_from_json,
    load_run,
    plan_differences,
    plate_behind,
)
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.calibration.estimator.estimate import PositionEstimator
    from wavefocus.storage.raw.header import RawHeader
    from wavefocus.storage.raw.writer import RawFile


@dataclass(frozen=True, slots=True)
class Blueprint:
    """A configuration with the plan that follows from it."""

    configuration: Configuration
    plan: Plan

    def bank_header(self) -> BankHeader:
        """What a new bank says of itself."""
        configuration, plan = self.configuration, self.plan
        return BankHeader(
            sample_rate_hz=plan.excitation.sample_rate_hz, taps=plan.taps, band_hz=plan.excitation.band_hz,
            position_mm=plan.position_mm, actuator_mm=plan.actuator_mm,
            rig_json=configuration.rig.model_dump_json(), run_json=configuration.run.model_dump_json(),
            plan_sha256=plan.sha256, software=f"wavefocus {version('wavefocus')}",
            directions_deg=plate_behind(configuration.rig, configuration.run).directions_deg,
            check_rows=tuple(sorted(plan.check_rows)),
        )  # fmt: skip


def blueprint_from_files(run_file: Path) -> Blueprint:
    """Read and check a run file with all that it names.

    Raises InputError: anything in the files is wrong.
    """
    return blueprint_of(load_run(run_file))


def blueprint_from_bank(path: Path) -> Blueprint:
    """Read the configuration that a bank carries, checked against the bank's own hash.

    Raises InputError: the file is no bank, or one that this suite did not measure.
    """
    with open_bank(path) as bank:
        blueprint = blueprint_of(bank_configuration(bank))
        if bank.plan_sha256 != blueprint.plan.sha256:
            raise InputError(
                f"{path}: the attributes rig, run and plan_sha256 do not belong together; the bank cannot be "
                "resumed, but what it holds can be rendered"
            )
    return blueprint


_MAX_DIFFERENCES = 5
"""Differences of two plans that are named one by one."""


def require_same_plan(bank: Path, configuration: Configuration, plan_sha256: str) -> None:
    """Refuse to go on in a bank of another plan; a bank that does not carry its configuration is not judged here.

    Raises InputError: the plans differ; the message names the keys and both values.
    """
    with open_bank(bank) as view:
        if view.plan_sha256 == plan_sha256 or view.rig_json is None or view.run_json is None:
            return
        own = bank_configuration(view)
    refuse_differences(bank, own, configuration)


def refuse_differences(bank: Path, own: Configuration, configuration: Configuration) -> None:
    """Refuse a configuration whose plan is not the bank's own; one of another version is refused by its hash."""
    if differences := plan_differences(own, configuration):
        raise InputError(
            f"{bank} belongs to another plan; it differs in {listed_differences(differences)}; resume it from the bank "
            "alone, undo the change, or name a new bank"
        )


def listed_differences(differences: Sequence[Difference]) -> str:
    """Keys and values of the first differences, and how many more there are."""
    more = len(differences) - _MAX_DIFFERENCES
    return ", ".join(map(str, differences[:_MAX_DIFFERENCES])) + (f" and {more} more" if more > 0 else "")


def bank_configuration(bank: Bank) -> Configuration:
    """The configuration that an open bank carries.

    Raises InputError: the bank was made by other means and carries none.
    """
    if bank.rig_json is None or bank.run_json is None:
        raise InputError(
            f"{bank.path}: has no attributes rig and run: it was made by other means and cannot be measured on"
        )
    return configuration_from_json(bank.rig_json, bank.run_json, bank.position_mm, str(bank.path))


def blueprint_of(configuration: Configuration) -> Blueprint:
    """A checked configuration with the plan that follows from it.

    Raises InputError: rig and run ask for records that cannot be.
    """
    run, rig = configuration.run, configuration.rig
    capture = run.capture
    excitation = PlayedExcitation(
        capture.sample_rate_hz, run.sweep.start_hz, run.sweep.stop_hz, run.sweep.duration_s, capture.decay_s,
        run.sweep.amplitude_v * 10 ** (capture.level_db / 20), capture.averages, waveform=run.sweep.waveform,
    )  # fmt: skip
    staggered = None
    if capture.excitation == "staggered":
        staggered = StaggeredSignal(
            excitation, len(rig.actuators.position_mm), capture.taps, capture.stagger_samples, capture.groups,
            capture.periods,
        )  # fmt: skip
    plan = Plan(
        position_mm=configuration.position_mm, actuator_mm=rig.actuator_mm, excitation=excitation, taps=capture.taps,
        sha256=configuration.plan_sha256, quality=run.quality, drift=run.drift, staggered=staggered,
        check_rows=frozenset(check_rows(configuration).tolist()),
    )  # fmt: skip
    return Blueprint(configuration, plan)


def needed_by(scene_files: Sequence[Path], blueprint: Blueprint) -> frozenset[int]:
    """Rows of a plan that scenes are rendered from, and those that `verify` looks at.

    Raises InputError: A scene file is wrong, or its paths leave the grid; the message names the file.
    """
    from wavefocus.rendering.scene.model import load_scene  # most campaigns are for no scene
    from wavefocus.rendering.scene.scene_rows import scene_rows

    plan = blueprint.plan
    position_mm, check = plan.position_mm, np.isin(np.arange(len(plan.position_mm)), list(plan.check_rows))
    needed: set[int] = set()
    for file in scene_files:
        scene = load_scene(file)
        try:
            rows = scene_rows(scene, position_mm, check, coarse=bool(check.any()))
        except InputError as wrong:
            raise InputError(f"{file}: {wrong}") from None
        needed.update(rows.all.tolist())
    return frozenset(needed)


def own_plan(header: RawHeader, raw: Path) -> Plan | None:
    """The plan that the recordings were made by; None where the file does not carry one that this version reads."""
    configuration = carried_configuration(header, raw)
    if configuration is None:
        return None
    try:
        plan = blueprint_of(configuration).plan
    except InputError:
        return None
    return plan if plan.sha256 == header.plan_sha256 else None


def carried_configuration(header: RawHeader, raw: Path) -> Configuration | None:
    """The configuration that recordings carry; None where there is none that this version reads."""
    if not (header.rig_json and header.run_json):
        return None
    try:
        return configuration_from_json(header.rig_json, header.run_json, header.position_mm, str(raw))
    except InputError:
        return None


def estimator_for(
    recordings: RawFile, plan: Plan | None, report: Callable[[str], None] = lambda line: None
) -> PositionEstimator:
    """The campaign's own estimator, which gives its bank again; else one that is found from the reference channels."""
    from wavefocus.acquisition.attempt import position_estimator  # of kept recordings alone
    from wavefocus.calibration.estimator.raw_estimation import estimator_of, records_of

    if plan is None:
        return estimator_of(recordings, report)
    return position_estimator(plan, records_of(recordings.header).channels)
