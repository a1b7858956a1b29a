"""Stimuli on the virtual rig: their onsets against its true latency, masking on its output alone, faults repeated."""

import time
from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import welch

from tests.lab_files import rig_fault, setup_of
from wavefocus.config.trials import MaskingTable
from wavefocus.drivers.errors import InstrumentError, TransientInstrumentError
from wavefocus.drivers.protocols import RecordLabel
from wavefocus.mocks.virtual import label_share
from wavefocus.mocks.virtual.player import VirtualPlayer
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.trials.presentation import MASKING_CREST, RigPresenter, Sound, pink_noise, presented_v

RATE_HZ = 10_000.0
MASKING = MaskingTable(output=5, rms_v=0.3, around_s=0.4)
SETTINGS = VirtualSettings(actuator_mm=((60.0, 0.0), (-60.0, 0.0), (0.0, 40.0)), outputs=6)
STIMULUS = Sound(np.vstack([np.sin(np.arange(4000) / 8.0), np.zeros(4000), np.cos(np.arange(4000) / 8.0)]), 1500, 2)


def presenter(*faults, masking=None):
    return presenter_on(VirtualRig(replace(SETTINGS, fault_plan=faults)), masking)


def presenter_on(rig, masking=None):
    return RigPresenter(setup_of(rig), lambda name: STIMULUS, RATE_HZ, 0.3, masking, 2)


def true_error_ms(label):
    """How much earlier than by the longest latency, which the virtual player states, it began."""
    shortest_s, longest_s = SETTINGS.latency_s
    return 1e3 * (shortest_s - longest_s) * (1 - label_share(SETTINGS.seed, label))


@pytest.mark.parametrize("masking", [None, MASKING], ids=["alone", "masked"])
def test_stimuli_then_their_onsets_are_those_of_the_rig_to_a_tenth_of_a_millisecond(masking):
    rig = presenter(masking=masking)
    for trial in range(1, 6):
        began_s = time.monotonic()
        onset = rig.present("any", trial, pytest.fail)
        # The clock of the recorder is 30 ppm off.
        assert onset.error_ms == pytest.approx(true_error_ms(RecordLabel(trial, 1, 0, "presentation")), abs=0.1)
        # Two plays of 0.4 s had sounded; the rig's seconds take no time.
        assert onset.at_s < began_s - 0.5
        assert (onset.within_ms, onset.attempts) == (0.0, 1)


def test_given_a_rig_in_the_walls_time_then_the_onset_is_that_of_the_machines_clock():
    rig = VirtualRig(replace(SETTINGS, realtime=True))
    clock, player = rig.clock, rig.player
    assert isinstance(player, VirtualPlayer)
    onset = presenter_on(rig).present("any", 1, pytest.fail)
    (play,) = player.plays_between(0, 2**62)
    ahead_s = max(time.monotonic() - clock.now_s() for _ in range(5))
    true_s = ahead_s + 1e-9 * play.requested_ns + (play.latency_s or 0.0) + STIMULUS.onset_samples / RATE_HZ
    assert onset.at_s == pytest.approx(true_s, abs=1e-3 * onset.within_ms + 1e-4)


def test_plays_then_the_onset_of_each_comes_a_pause_after_the_end_of_the_one_before():
    for pause_s in (1.0, 0.15, 0.05):
        whole = presented_v(STIMULUS, pause_s, RATE_HZ)
        second = whole.shape[1] - 4000
        assert second + STIMULUS.onset_samples - 4000 == max(round(pause_s * RATE_HZ), STIMULUS.onset_samples)
        assert np.array_equal(whole[:, :4000], whole[:, second:])
        assert not whole[:, 4000:second].any()


def test_masking_sounds_around_the_stimulus_and_the_marker_at_its_onset():
    rig = presenter(masking=MASKING)
    signals_v, onset = rig.signals_v(STIMULUS, RecordLabel(1, 1, 0, "presentation"))
    assert sorted(signals_v) == [0, 2, 3, 5]  # the second actuator has nothing to do
    around = round(MASKING.around_s * RATE_HZ)
    drive_v = presented_v(STIMULUS, 0.3, RATE_HZ)
    for channel in (0, 2):
        sounding = np.flatnonzero(signals_v[channel])
        assert sounding[0] >= around
        assert np.array_equal(signals_v[channel][around : around + drive_v.shape[1]], drive_v[channel])
    assert onset == around + STIMULUS.onset_samples
    marker = np.flatnonzero(signals_v[3])
    assert onset <= marker[0] < onset + 5
    assert marker[-1] < onset + 1000
    assert {one.size for one in signals_v.values()} == {drive_v.shape[1] + 2 * around}
    noise_v = signals_v[MASKING.output]
    assert np.abs(noise_v).max() <= MASKING_CREST * MASKING.rms_v
    assert np.abs(noise_v[[0, -1]]).max() < 1e-3 * MASKING.rms_v
    again = presenter(masking=MASKING).signals_v(STIMULUS, RecordLabel(1, 1, 0, "presentation"))[0][MASKING.output]
    other = rig.signals_v(STIMULUS, RecordLabel(2, 1, 0, "presentation"))[0][MASKING.output]
    assert np.array_equal(noise_v, again)
    assert not np.array_equal(noise_v, other)


def test_pink_noise_then_its_density_falls_by_3_db_per_octave_within_its_band_alone():
    noise_v = pink_noise(400_000, 48_000.0, 0.5, b"seed")
    hertz, density = welch(noise_v, 48_000.0, nperseg=8192)
    octaves = [density[(hertz >= low) & (hertz < 2 * low)].mean() for low in (125, 250, 500, 1000, 2000, 4000)]
    assert np.diff(10 * np.log10(octaves)) == pytest.approx(-10 * np.log10(2), abs=0.5)
    assert density[hertz > 8500].max() < 1e-6 * octaves[-1]
    assert noise_v.std() == pytest.approx(0.5, rel=0.02)


def test_a_fault_that_passes_is_repeated_and_one_that_stays_raised_with_its_cable():
    underflow = rig_fault("player", "wait", "underflow", position=2, purpose="presentation")
    rig = presenter(underflow)  # tests/system/test_trials.py has others that pass
    assert [rig.present("any", trial, lambda note: None).attempts for trial in (1, 2, 3)] == [1, 2, 1]
    for kind, raised, said in (
        ("missing_reference", InstrumentError, "loopback cable, from output 3"),
        ("short_read", TransientInstrumentError, "."),
    ):
        fault = rig_fault("recorder", "read", kind, position=1, count=9, purpose="presentation")
        with pytest.raises(raised, match=said):
            presenter(fault).present("any", 1, lambda note: None)
