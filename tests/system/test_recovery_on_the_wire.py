"""A campaign whose mirror hangs on a real serial line that is pulled in the middle of it."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import pytest

from tests.wire.serial_bench import MirrorBench, mirror_bench
from wavefocus.acquisition.engine.campaign import Campaign
from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.acquisition.setup import Setup
from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.campaign.blueprint import blueprint_from_files
from wavefocus.config.messages.campaign import Event, PositionStarted, ReconnectTried, State, StateChanged, Subscriber
from wavefocus.config.run import Virtual
from wavefocus.drivers.errors import InstrumentLostError
from wavefocus.drivers.protocols import DeviceIdentity, Instruments, Mirror, WallClock
from wavefocus.rig.virtual_bench import virtual_rig
from wavefocus.storage.bank.writer import BankWriter, create_bank


class TwoMirrors(Mirror):
    """The mirror on the wire, and the virtual one that the virtual recorder looks through, moved as one."""

    def __init__(self, wired: Mirror, virtual: Mirror) -> None:
        self._wired, self._virtual = wired, virtual

    @property
    def identity(self) -> DeviceIdentity:
        return self._wired.identity

    def identify(self) -> str:
        return self._wired.identify()

    def move_to(self, x_mrad: float, y_mrad: float) -> None:
        self._wired.move_to(x_mrad, y_mrad)
        self._virtual.move_to(x_mrad, y_mrad)

    def wait_settled(self, timeout_s: float) -> None:
        self._wired.wait_settled(timeout_s)
        self._virtual.wait_settled(timeout_s)

    def park(self) -> None:
        self._virtual.park()
        self._wired.park()

    def reconnect(self) -> None:
        self._wired.reconnect()

    def close(self) -> None:
        self._virtual.close()
        self._wired.close()


def _measure(lab: Path, name: str, bench: MirrorBench, publish: Subscriber, recovery_s: float = 600.0) -> bytes:
    """A campaign of the lab with the mirror of a bench, on the wall's clock; the bank's bytes."""
    blueprint = blueprint_from_files(lab / "run.toml")
    rig = blueprint.configuration.rig
    roles = virtual_rig(rig, blueprint.configuration.run.virtual or Virtual()).instruments
    setup = Setup(
        instruments=Instruments(TwoMirrors(bench.mirror(), roles.mirror), roles.recorder, roles.player, WallClock()),
        mirror_map=MirrorMap(rig.mirror.matrix),
        actuator_channels=rig.player.channels,
        loopback_channel=rig.player.loopback_channel,
        range_v=(10.0, 10.0),
        response_per_volt=0.125,
        recovery_s=recovery_s,
    )
    create_bank(lab / name, blueprint.bank_header())
    with BankWriter.open(lab / name, plan_sha256=blueprint.plan.sha256) as writer:
        try:
            Campaign(blueprint.plan, setup, writer, publish, StopRequest()).run()
        finally:
            with contextlib.suppress(ExceptionGroup):
                setup.close()
    return (lab / name).read_bytes()


@pytest.mark.may_skip("only POSIX has pseudo-terminals")
@pytest.mark.parametrize(
    ("kind", "dialect"),
    [
        pytest.param("pty", "generic", marks=pytest.mark.skipif(os.name != "posix", reason="needs pseudo-terminals")),
        ("tcp", "asi-tiger"),
    ],
)
def test_a_mirror_replugged_during_a_capture_leaves_the_bank_of_a_quiet_night(
    lab: Path, kind: str, dialect: str
) -> None:
    with mirror_bench(dialect, kind, lab) as bench:
        quiet = _measure(lab, "quiet.h5", bench, lambda event: None)
    events: list[Event] = []
    folder = lab / "again"
    folder.mkdir()
    with mirror_bench(dialect, kind, folder) as bench:

        def pull_and_plug(event: Event) -> None:
            events.append(event)
            if isinstance(event, PositionStarted) and event.position == 3:
                bench.far.unplug()
            elif isinstance(event, ReconnectTried) and event.number == 2:
                bench.far.plug()

        assert _measure(lab, "disturbed.h5", bench, pull_and_plug) == quiet
    tries = [event for event in events if isinstance(event, ReconnectTried)]
    assert [event.connected for event in tries] == [False, False, True]
    states = [event.state for event in events if isinstance(event, StateChanged)]
    assert states == [State.RUNNING, State.RECOVERING, State.RUNNING, State.FINISHED]


def test_given_a_mirror_pulled_for_good_then_the_capture_gives_up_and_names_it(lab: Path) -> None:
    with mirror_bench("generic", "tcp", lab) as bench:

        def pull(event: Event) -> None:
            if isinstance(event, PositionStarted) and event.position == 1:
                bench.far.unplug()

        with pytest.raises(InstrumentLostError, match="not back within") as caught:
            _measure(lab, "plate.h5", bench, pull, recovery_s=1.0)
    assert "mirror" in caught.value.instrument
    assert caught.value.role == "mirror"
    assert caught.value.remedy
