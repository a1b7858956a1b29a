"""From configuration to what carries it out: the plan, the bank's header and the instruments."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from acquisition.bounded import RECONNECTING, bounded
from acquisition.plan import Plan
from acquisition.quality import QualityLimits
from acquisition.sentinel import DriftLimits
from acquisition.setup import Setup
from calibration.bank import Bank, open_bank
from calibration.bank_header import BankHeader
from calibration.errors import InputError
from calibration.mirror_map import MirrorMap
from calibration.staggered_signal import StaggeredSignal
from calibration.sweeps import Excitation
from drivers.errors import InstrumentError
from drivers.protocols import OffersRanges
from wavefocus.calibration_care import calibration_warnings, names_known
from wavefocus.config.calibration_merge import calibrated
from wavefocus.config.loading import Configuration, configuration_from_json, load_run
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.console import say
from wavefocus.instruments import OpenedRig, in_time, open_rig, openers
from wavefocus.sensors import watch_of
from wavefocus.virtual_bench import virtual_rig

__all__ = [
    "Blueprint",
    "bank_configuration",
    "blueprint_from_bank",
    "blueprint_from_files",
    "blueprint_of",
    "open_setup",
    "put_to_rest",
    "setup_of",
    "virtual_rig",
]


@dataclass(frozen=True, slots=True)
class Blueprint:
    """A configuration with the plan that follows from it."""

    configuration: Configuration
    plan: Plan

    def bank_header(self) -> BankHeader:
        """What a new bank says of itself."""
        configuration, plan = self.configuration, self.plan
        return BankHeader(
            sample_rate_hz=plan.excitation.sample_rate_hz,
            taps=plan.taps,
            band_hz=plan.excitation.band_hz,
            position_mm=plan.position_mm,
            actuator_mm=plan.actuator_mm,
            rig_json=configuration.rig.model_dump_json(),
            run_json=configuration.run.model_dump_json(),
            plan_sha256=plan.sha256,
            software=f"wavefocus {version('wavefocus')}",
        )


def blueprint_from_files(run_file: Path) -> Blueprint:
    """Read and check a run file with all that it names.

    Raises
    ------
    InputError
        Anything in the files is wrong.
    """
    return blueprint_of(load_run(run_file))


def blueprint_from_bank(path: Path) -> Blueprint:
    """Take up the configuration that a bank carries, checked against the bank's own hash.

    Raises
    ------
    InputError
        The file is no bank, or one that this suite did not measure.
    """
    with open_bank(path) as bank:
        blueprint = blueprint_of(bank_configuration(bank))
        if bank.plan_sha256 != blueprint.plan.sha256:
            raise InputError(
                f"{path}: the attributes rig, run and plan_sha256 do not belong together; the bank cannot be "
                "resumed, but what it holds can be rendered"
            )
    return blueprint


def bank_configuration(bank: Bank) -> Configuration:
    """The configuration that an open bank carries.

    Raises
    ------
    InputError
        The bank was made by other means and carries none.
    """
    if bank.rig_json is None or bank.run_json is None:
        raise InputError(
            f"{bank.path}: has no attributes rig and run: it was made by other means and cannot be measured on"
        )
    return configuration_from_json(bank.rig_json, bank.run_json, bank.position_mm, str(bank.path))


def blueprint_of(configuration: Configuration) -> Blueprint:
    """A checked configuration with the plan that follows from it.

    Raises
    ------
    InputError
        Rig and run ask for records that cannot be.
    """
    run, rig = configuration.run, configuration.rig
    capture = run.capture
    excitation = Excitation(
        sample_rate_hz=capture.sample_rate_hz,
        start_hz=run.sweep.start_hz,
        stop_hz=run.sweep.stop_hz,
        duration_s=run.sweep.duration_s,
        decay_s=capture.decay_s,
        amplitude_v=run.sweep.amplitude_v * 10 ** (capture.level_db / 20),
        averages=capture.averages,
    )
    staggered = None
    if capture.excitation == "staggered":
        staggered = StaggeredSignal(
            excitation, len(rig.actuators.position_mm), capture.taps, capture.stagger_samples, capture.groups,
            capture.periods,
        )  # fmt: skip
    plan = Plan(
        position_mm=configuration.position_mm,
        actuator_mm=rig.actuator_mm,
        order=np.arange(len(configuration.position_mm)),
        excitation=excitation,
        taps=capture.taps,
        sha256=configuration.plan_sha256,
        quality=QualityLimits(**run.quality.model_dump()),
        drift=DriftLimits(**run.drift.model_dump()),
        staggered=staggered,
    )
    return Blueprint(configuration, plan)


@contextmanager
def open_setup(rig: RigConfig, run: RunConfig) -> Iterator[Setup]:
    """Open the instruments of a rig; on the way out they are muted, parked and released.

    Raises
    ------
    InstrumentError
        An instrument cannot be opened, or could not be put to rest.
    """
    ways = in_time(openers(rig, run.virtual), RECONNECTING * rig.recovery.hung_after_s)
    setup = setup_of(rig, open_rig(ways))
    with put_to_rest(setup):
        if rig.calibration.measured is not None:
            say(f"{rig.calibration.file}: {calibrated(rig.calibration.measured)}, in place of the rig file's")
            for warning in calibration_warnings(rig, names_known(setup.instruments)):
                say(f"warning: {warning}")
        yield setup


def setup_of(rig: RigConfig, opened: OpenedRig) -> Setup:
    """Open instruments with the wiring and the calibration of their rig."""
    return Setup(
        instruments=bounded(opened.instruments, rig.recovery.hung_after_s),
        mirror_map=MirrorMap(rig.mirror.matrix),
        actuator_channels=rig.player.channels,
        loopback_channel=rig.player.loopback_channel,
        range_v=(rig.recorder.reference_range_v, rig.recorder.response_range_v),
        response_per_volt=opened.sensitivity_m_s_per_v,
        reference_gain=rig.recorder.reference_gain,
        inter_channel_delay_s=rig.recorder.inter_channel_delay_s,
        vibrometer_latency_s=opened.vibrometer_latency_s,
        pre_roll_s=rig.recorder.pre_roll_s,
        post_roll_s=rig.recorder.post_roll_s,
        recovery_s=rig.recovery.give_up_after_s,
        watch=watch_of(rig, opened),
        response_ranges_v=_response_ranges_v(rig, opened),
    )


def _response_ranges_v(rig: RigConfig, opened: OpenedRig) -> tuple[float, ...]:
    """Ranges that the response may step up to: the rig file's, or all that the recorder says it has."""
    recorder = opened.instruments.recorder
    if rig.recorder.response_ranges_v is not None:
        return rig.recorder.response_ranges_v
    return recorder.input_ranges_v if isinstance(recorder, OffersRanges) else ()


@contextmanager
def put_to_rest(setup: Setup) -> Iterator[None]:
    """Mute, park and release the instruments on the way out, whatever happens before.

    Raises
    ------
    InstrumentError
        One of them could not be put to rest, and nothing else had failed.
    """
    try:
        yield
    except BaseException:
        # The first failure is the one to act on; what else fails on the way out is told and does not hide it.
        try:
            setup.close()
        except* Exception as group:
            for one in group.exceptions:
                say(f"on the way out: {one}")
        raise
    try:
        setup.close()
    except* InstrumentError as group:
        causes = "; ".join(str(one) for one in group.exceptions)
        raise InstrumentError("rig", "putting the instruments to rest", causes, "check them by hand") from group
