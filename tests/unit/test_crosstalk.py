"""Crosstalk: what of the loopback leaks into the response input, on virtual rigs and in the estimator."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from wavefocus.drivers.protocols import RecordRequest, Take
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings

RATE_HZ = 10_000.0
QUIET = VirtualSettings(
    noise_v=0.0, reference_noise_v=0.0, clock_ppm=0.0, inter_channel_delay_s=0.0, dropout_probability=0.0,
    lost_signal_v=0.0,
)  # fmt: skip


def recorded(settings: VirtualSettings) -> np.ndarray:
    """Both inputs while the loopback alone plays noise, the beam parked."""
    rig = VirtualRig(settings).instruments
    signal_v = 0.5 * np.random.default_rng(1).standard_normal(4000).clip(-2, 2)
    rig.recorder.start(RecordRequest(6000, RATE_HZ, (5.0, 0.2), Take(0, 1, 0, "test")))
    rig.player.play({settings.channel_of_loopback: signal_v}, RATE_HZ)
    rig.player.wait(5.0)
    return rig.recorder.read(5.0).volts


def test_share_of_the_loopback_comes_late_at_the_response_input() -> None:
    reference_v, response_v = recorded(replace(QUIET, crosstalk=0.05, crosstalk_delay_s=0.0003))
    lagged = np.array([reference_v[: 5900 - lag] @ response_v[lag:5900] for lag in range(10)])
    assert int(np.argmax(lagged)) == 3
    assert lagged[3] / (reference_v @ reference_v) == pytest.approx(0.05, rel=1e-3)
