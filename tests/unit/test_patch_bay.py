"""The virtual rig's cables: what is plugged into the response input is what it hears."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from wavefocus.drivers.protocols import Recording, RecordLabel, RecordRequest
from wavefocus.mocks.virtual.laboratory import PatchBay
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.mocks.virtual.synthesis import output_errors

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


def test_given_the_vibrometer_then_no_output_is_plugged_in() -> None:
    bay = PatchBay(range(20), 20)
    assert (bay.word, bay.outputs) == ("vibrometer", None)
    bay.connect("output 7")
    assert bay.outputs == (7,)
    bay.connect("vibrometer")
    assert bay.outputs is None


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


def test_given_another_cable_and_back_then_the_vibrometer_hears_what_it_heard() -> None:
    rig, other = VirtualRig(), VirtualRig()
    other.patch_bay.connect("output 3")
    record(other, 3, 20)
    other.patch_bay.connect("vibrometer")
    for one in (rig, other):
        one.instruments.mirror.move_to(40.0, 20.0)
        one.instruments.mirror.wait_settled(1.0)
    assert record(rig, 3, 20).volts.tobytes() == record(other, 3, 20).volts.tobytes()


def test_outputs_of_their_own_latency_and_gain_then_that_is_what_is_heard_of_them() -> None:
    late_s, gain = [0.0] * 21, [1.0] * 21
    late_s[3], gain[3], gain[20] = 3e-4, -0.5, 2.0
    rig = VirtualRig(dataclasses.replace(QUIET, output_latency_s=tuple(late_s), output_gain=tuple(gain)))
    rig.patch_bay.connect("output 3")
    reference_v, response_v = record(rig, 3, 20).volts.astype(np.float64)
    assert np.abs(response_v[3:] + 0.25 * reference_v[:-3]).max() < 1e-3
    assert np.abs(reference_v).max() == pytest.approx(2.0, abs=0.01)


def test_an_output_of_its_own_latency_and_gain_then_the_surface_answers_accordingly() -> None:
    late_s, gain = [0.0] * 21, [1.0] * 21
    late_s[3], gain[3] = 3e-4, -0.5
    heard = []
    for settings in (QUIET, dataclasses.replace(QUIET, output_latency_s=tuple(late_s), output_gain=tuple(gain))):
        rig = VirtualRig(dataclasses.replace(settings, dropout_probability=0.0))
        rig.instruments.mirror.move_to(60.0, 40.0)
        rig.instruments.mirror.wait_settled(1.0)
        heard.append(record(rig, 3, 20).volts[1].astype(np.float64))
    assert np.abs(heard[0]).max() > 0.01
    assert np.abs(heard[1][3:] + 0.5 * heard[0][:-3]).max() < 3 * 10 / 32768


def test_given_a_dead_and_a_reversed_actuator_then_the_truth_knows_of_them() -> None:
    strength = (1.0, 0.0, -1.0, *[1.0] * 17)
    sound, flawed = VirtualRig(QUIET), VirtualRig(dataclasses.replace(QUIET, actuator_strength=strength))
    true, changed = (rig.truth(10.0, 5.0, 500) for rig in (sound, flawed))
    np.testing.assert_allclose(changed, np.array(strength)[:, None] * true)


def test_given_spreads_then_errors_stay_within_them_and_depend_on_the_seed() -> None:
    late_s, gain = output_errors(200, 1e-5, 1.0, seed=3)
    assert 0.9e-5 < np.abs(late_s).max() <= 1e-5
    assert 0.9 < np.abs(20 * np.log10(gain)).max() <= 1.0
    assert output_errors(200, 1e-5, 1.0, seed=4)[0][0] != late_s[0]
    assert output_errors(3, 0.0, 0.0, seed=3)[1].tolist() == [1.0, 1.0, 1.0]
