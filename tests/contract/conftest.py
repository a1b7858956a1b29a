"""One bench per kind of rig; every suite in this folder runs on each of them unchanged."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import pytest

from drivers.protocols import Instruments
from mocks.virtual_rig import VirtualRig, VirtualSettings


@dataclass(frozen=True)
class Bench:
    """A rig and what a person knows about it."""

    instruments: Instruments
    reachable_mrad: tuple[float, float]
    unreachable_mrad: tuple[float, float]
    settle_timeout_s: float
    loopback_channel: int
    actuator_channel: int
    sample_rate_hz: float
    range_v: tuple[float, float]
    unknown_range_v: tuple[float, float]
    start_tolerance_s: float


def virtual_bench() -> Bench:
    rig = VirtualRig(VirtualSettings(seed=11))
    return Bench(
        instruments=rig.instruments,
        reachable_mrad=(40.0, -25.0),
        unreachable_mrad=(2000.0, 0.0),
        settle_timeout_s=1.0,
        loopback_channel=rig.settings.channel_of_loopback,
        actuator_channel=0,
        sample_rate_hz=10_000.0,
        range_v=(2.0, 10.0),
        unknown_range_v=(2.0, 1000.0),
        start_tolerance_s=0.05,
    )


BENCHES = {"virtual": virtual_bench}


@pytest.fixture(params=BENCHES)
def bench(request: pytest.FixtureRequest) -> Iterator[Bench]:
    bench = BENCHES[request.param]()
    yield bench
    bench.instruments.player.close()
    bench.instruments.recorder.close()
    bench.instruments.mirror.close()
