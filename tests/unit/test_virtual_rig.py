import time
from dataclasses import replace

import numpy as np
import pytest

from wavefocus.benchmarks.rig_bank import compare_with_truth
from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.drivers.protocols import RecordLabel, RecordRequest
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.rendering.greens.source import GreenArray

RATE_HZ = 10_000.0
PRE_ROLL_S = 0.02
PLACE_MM = (60.0, 40.0)
ACTUATOR = 2
TAKE = RecordLabel(0, 1, 0)

QUIET = VirtualSettings(
    noise_v=0.0, reference_noise_v=0.0, clock_ppm=0.0, inter_channel_delay_s=0.0, latency_s=(0.01, 0.01),
    dropout_probability=0.0,
)  # fmt: skip


@pytest.fixture(scope="module")
def quiet_rig():
    """A rig without noise, on one clock; its plate is made once."""
    return VirtualRig(QUIET)


def point(rig):
    rig.mirror.move_to(*rig.settings.mirror.angles_mrad(*PLACE_MM))
    rig.mirror.wait_settled(1.0)


def record(rig, drive_v, label=TAKE, *, channels=(ACTUATOR,), range_v=(2.0, 1.0), play_hz=RATE_HZ):
    point(rig)
    rig.recorder.start(RecordRequest(4000, RATE_HZ, range_v, label))
    rig.clock.sleep(PRE_ROLL_S)
    signals = dict.fromkeys((*channels, rig.settings.channel_of_loopback), drive_v)
    rig.player.play(signals, play_hz)
    rig.player.wait(10.0)
    return rig.recorder.read(10.0)


def drive(samples=800, seed=3):
    """An arbitrary signal, its values on the steps of the player's converter."""
    return on_steps(np.random.default_rng(seed).uniform(-1, 1, samples))


def on_steps(volts):
    step_v = QUIET.full_scale_v / 32768
    return np.rint(volts / step_v) * step_v


def response_volts(rig, drive_v, actuator=ACTUATOR):
    green = rig.truth(*PLACE_MM, 6000)[actuator] / rig.settings.sensitivity_m_s_per_v
    return np.convolve(drive_v, green)


def at_instants(signal, instants):
    """Band-limited value of a sampled signal at fractional sample instants, by its definition."""
    return np.sinc(np.asarray(instants)[:, None] - np.arange(len(signal))) @ signal


# Responses of low frequencies take a shorter way through the transforms.
LOW = on_steps(np.sin(2 * np.pi * (20 + 0.3 * np.arange(800)) * np.arange(800) / RATE_HZ) * np.hanning(800))


@pytest.mark.parametrize(("drive_v", "range_v"), [(drive(), 1.0), (LOW, 2.0)], ids=["white", "low"])
def test_with_one_clock_and_no_noise_the_response_is_drive_convolved_with_truth(quiet_rig, drive_v, range_v):
    rig = quiet_rig
    heard = record(rig, drive_v, range_v=(2.0, range_v))
    expected = np.zeros((2, 4000))
    expected[0, 300:1100] = drive_v
    expected[1, 300:] = response_volts(rig, drive_v)[:3700]
    assert np.abs(expected[1]).max() > 0.02
    for row in (0, 1):
        assert np.abs(heard.volts[row] - expected[row]).max() < 0.6 * heard.volts_per_count[row]


def test_given_two_clocks_then_sample_k_arrives_at_offset_plus_k_times_ratio():
    settings = replace(QUIET, clock_ppm=400.0, latency_s=(0.0123456, 0.0123456), inter_channel_delay_s=2e-5)
    # A smooth signal: white noise cut off sharply would ring on for ever, and a transform repeats that.
    rig, drive_v = VirtualRig(settings), on_steps(np.convolve(drive(), np.hanning(30) / 15))
    heard = record(rig, drive_v)
    ratio = 1 + 400e-6
    offset = (PRE_ROLL_S + 0.0123456) * RATE_HZ * ratio
    instants = np.arange(0, 4000, 29)
    reference = at_instants(drive_v, (instants - offset) / ratio)
    response = at_instants(response_volts(rig, drive_v), (instants + 0.2 * ratio - offset) / ratio)
    assert np.abs(heard.volts[0, instants] - reference).max() < 0.7 * heard.volts_per_count[0]
    assert np.abs(heard.volts[1, instants] - response).max() < 0.6 * heard.volts_per_count[1]


def test_channels_in_another_wiring_drive_their_actuators_and_responses_add():
    channels = tuple(range(20, 0, -1))
    rig, drive_v = VirtualRig(replace(QUIET, actuator_channels=channels, loopback_channel=0)), drive()
    together = record(rig, drive_v, channels=[channels[actuator] for actuator in (0, 5, 11)]).volts[1]
    assert rig.player.channels == 21
    expected = sum(response_volts(rig, drive_v, actuator=actuator)[:3000] for actuator in (0, 5, 11))
    assert np.abs(together[300:3300] - expected).max() < 0.6 / 32768


def test_given_a_player_at_48_khz_then_the_response_is_that_of_the_same_waveform(quiet_rig):
    tone = np.sin(2 * np.pi * 200 * np.arange(4800) / 48_000) * np.hanning(4800)
    slow = np.sin(2 * np.pi * 200 * np.arange(1000) / 10_000) * np.hanning(1001)[:-1]
    heard = [record(quiet_rig, volts, play_hz=hz).volts[1] for volts, hz in ((tone, 48_000.0), (slow, RATE_HZ))]
    assert np.abs(heard[0]).max() > 0.01
    assert np.abs(heard[0] - heard[1]).max() < 2e-3 * np.abs(heard[0]).max()


def test_given_a_play_that_began_before_then_its_rest_is_recorded(quiet_rig):
    rig, drive_v = quiet_rig, drive(3000)
    point(rig)
    rig.player.play({ACTUATOR: drive_v, 20: drive_v}, RATE_HZ)
    rig.clock.sleep(0.11)
    rig.recorder.start(RecordRequest(1500, RATE_HZ, (2.0, 1.0), TAKE))
    heard = rig.recorder.read(1.0)
    assert np.abs(heard.volts[0] - drive_v[1000:2500]).max() < 0.6 * heard.volts_per_count[0]
    expected = response_volts(rig, drive_v)[1000:2500]
    assert np.abs(heard.volts[1] - expected).max() < 0.6 * heard.volts_per_count[1]


def test_clock_that_is_walls_then_piece_that_comes_too_late_finds_player_dry():
    player = VirtualRig(replace(QUIET, realtime=True)).player
    player.begin_pieces([0], 48_000.0, 0.01)
    before_s = time.monotonic()
    player.add_piece(np.zeros((1, 480)))
    assert before_s <= player.written_s <= time.monotonic()
    time.sleep(0.03)
    with pytest.raises(TransientInstrumentError, match="underflow"):
        player.add_piece(np.zeros((1, 480)))
    player.begin_pieces([0], 48_000.0, 0.01)
    assert player.add_piece(np.zeros((1, 960))) == 0.0


@pytest.mark.parametrize(
    ("word", "played", "times"), [("output 3", (3,), 1), ("output 3", (4,), 0), ("sum", (3, 4), 2), ("both", (3,), 1)]
)
def test_given_a_cable_then_the_response_is_the_voltage_of_what_is_plugged_in(word, played, times):
    rig = VirtualRig(QUIET)
    rig.patch_bay.connect(word)
    for wrong in ("", "output", "output 21", "output -1", "loopback", "output 3 "):
        with pytest.raises(ValueError, match="allowed: vibrometer, sum, both, or output K"):
            rig.patch_bay.connect(wrong)
    assert rig.patch_bay.word == word
    reference_v, response_v = record(rig, LOW, channels=played, range_v=(10.0, 10.0)).volts.astype(np.float64)
    assert np.abs(reference_v).max() > 0.9
    assert np.abs(response_v - times * reference_v).max() < (1 + times) * 10 / 32768


def test_the_demo_states_the_known_error_of_some_places():
    rig, places_mm = VirtualRig(VirtualSettings()), np.array([[3.0, 4.0], [-21.0, 7.5], [40.0, -12.0]])
    true = np.stack([rig.truth(x_mm, y_mm, 2000) for x_mm, y_mm in places_mm])
    green = true * np.array([1.0, 1.1, 0.99])[:, None, None]
    bank = GreenArray(green, places_mm, RATE_HZ, status=np.ones(3, np.uint8), band_hz=(20.0, 500.0))
    first, *others = compare_with_truth(bank, rig)
    assert first.shape == (20,)
    assert (first < -100.0).all()
    assert [one.tolist() for one in others] == [pytest.approx([one] * 20, abs=0.01) for one in (-20.0, -40.0)]
