"""The virtual rig's cables: what is plugged into the response input is what it hears."""

from __future__ import annotations

import numpy as np
import pytest

from wavefocus.drivers.protocols import Recording, RecordLabel, RecordRequest
from wavefocus.mocks.virtual.laboratory import PatchBay
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings

RATE_HZ = 10_000.0
QUIET = VirtualSettings(
    noise_v=0.0, reference_noise_v=0.0, clock_ppm=0.0, inter_channel_delay_s=0.0, latency_s=(0.01, 0.01)
)
SIGNAL_V = np.sin(2 * np.pi * 500 * np.arange(800) / RATE_HZ) * np.hanning(800)


def record(rig: VirtualRig, *channels: int) -> Recording:
    roles = rig.instruments
    roles.recorder.start(RecordRequest(2000, RATE_HZ, (10.0, 10.0), RecordLabel(0, 1, 0)))
    roles.player.play(dict.fromkeys(channels, SIGNAL_V), RATE_HZ)
    roles.player.wait(10.0)
    return roles.recorder.read(10.0)


@pytest.mark.parametrize("word", ["", "output", "output 21", "output -1", "loopback", "output 3 "])
def test_given_a_word_that_is_no_cable_then_it_is_refused_and_nothing_changes(word: str) -> None:
    bay = PatchBay(range(20), 20)
    bay.connect("sum")
    with pytest.raises(ValueError, match="allowed: vibrometer, sum, both, or output K"):
        bay.connect(word)
    assert bay.word == "sum"


@pytest.mark.parametrize(
    ("word", "played", "times"),
    [("output 3", (3, 20), 1), ("output 3", (4, 20), 0), ("sum", (3, 4, 20), 2), ("both", (3, 20), 1)],
)
def test_given_a_cable_then_the_response_is_the_voltage_of_what_is_plugged_in(
    word: str, played: tuple[int, ...], times: int
) -> None:
    rig = VirtualRig(QUIET)
    rig.patch_bay.connect(word)
    reference_v, response_v = record(rig, *played).volts.astype(np.float64)
    step_v = 10 / 32768
    assert np.abs(reference_v).max() > 0.9
    assert np.abs(response_v - times * reference_v).max() < (1 + times) * step_v
