"""A rig operated by hand: levels, single sweeps, and a gate that silences whoever is waiting."""

import threading
from dataclasses import replace

import msgspec
import numpy as np

from tests.unit.test_calibration import RATE_HZ, bench
from tests.unit.test_doctor import Stating
from wavefocus.acquisition.manual import ManualMeasurements
from wavefocus.acquisition.setup import point_at
from wavefocus.config.messages.operate import TakeSweep
from wavefocus.drivers.timeouts import BoundedPlayer, ShutError
from wavefocus.mocks.virtual.rig import VirtualRig

SWEEP = TakeSweep(actuator=0, level_v=1.0, start_hz=40.0, stop_hz=400.0, duration_s=0.3)


def pointed(**changes):
    _, setup, _ = bench(**changes)
    point_at(setup, 20.0, 10.0)
    return setup


def test_given_an_input_too_small_for_what_plays_then_the_level_says_over_range():
    meter = ManualMeasurements(replace(pointed(), range_v=(0.2, 10.0)), RATE_HZ)
    meter.sound(0, 0.5)
    assert meter.level().reference.over_range


def test_a_dead_actuator_or_a_response_cut_off_then_the_sweep_says_so():
    third = msgspec.structs.replace(SWEEP, actuator=2)
    figures = ManualMeasurements(pointed(actuator_strength=(1.0, 1.0, 0.0)), RATE_HZ).sweep(third).figures
    assert figures.snr_db < 6
    assert figures.defects
    assert not any("actuator 0" in one.sentence for one in figures.defects)
    figures = ManualMeasurements(replace(pointed(), range_v=(10.0, 5e-3)), RATE_HZ).sweep(SWEEP).figures
    assert "over-range" in [one.name for one in figures.defects]


def test_loopback_that_is_not_plugged_in_then_sweep_tells_that_in_place_of_figures():
    setup = pointed()
    result = ManualMeasurements(replace(setup, loopback_channel=setup.actuator_channels[1]), RATE_HZ).sweep(SWEEP)
    assert result.figures is None
    assert "no signal from the loopback" in result.trouble


def test_given_a_mute_while_a_signal_is_made_ready_then_it_never_sounds():
    converting, go_on, sounding, refused = threading.Event(), threading.Event(), [], []

    def convert(signals_v, _rate_hz):
        converting.set()
        assert go_on.wait(30)
        sounding.append(signals_v)

    def play():
        try:
            gate.play({0: np.zeros(4)}, RATE_HZ)
        except ShutError as shut:
            refused.append(shut)

    gate = BoundedPlayer(Stating(VirtualRig().player, play=convert, mute=sounding.clear), 30.0)
    owner = threading.Thread(target=play)
    owner.start()
    assert converting.wait(30)
    gate.shut()
    go_on.set()
    owner.join(30)
    assert refused
    assert not sounding
