"""From configuration to instruments that are open, bounded in time, and put to rest at the end."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from acquisition.engine.setup import Setup
from acquisition.engine.timeouts import RECONNECTING, bounded
from calibration.rig.mirror_map import MirrorMap
from config.calibration_merge import calibrated
from config.rig import RigConfig
from config.run import RunConfig
from drivers.errors import InstrumentError
from drivers.protocols import OffersRanges
from wavefocus.console import say
from wavefocus.rig.calibration_care import calibration_warnings, identities_of
from wavefocus.rig.instruments import OpenedRig, in_time, open_rig, openers
from wavefocus.rig.sensors import watch_of


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
            for warning in calibration_warnings(rig, identities_of(setup.instruments)):
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
