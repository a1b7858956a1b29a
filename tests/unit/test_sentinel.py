"""The sentinel position against itself: drift, steps, and a mirror that is off.

``python -m pytest -s -m nightly tests/unit/test_sentinel.py -k ten_places`` prints the table of
docs/reference/point-quality.md.
"""

import sys
from types import SimpleNamespace

import numpy as np
import pytest

from tests.unit import analytic_plates
from tests.unit.analytic_plates import Medium
from wavefocus.acquisition.limits import DriftFigures, Look, compare_looks, compare_sentinel, step_of
from wavefocus.calibration.estimator.noise_error import noise_share
from wavefocus.config.run import DriftLimits
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.rendering.verify.mirror_error import sentinel_shift_mm
from wavefocus.rendering.verify.results import Sentinel

LIMITS = DriftLimits()


def responses():
    random = np.random.default_rng(1)
    envelope = np.exp(-np.arange(400) / 60.0) * (np.arange(400) > 20)
    noise = random.standard_normal((4, 400))
    smooth = np.apply_along_axis(lambda row: np.convolve(row, np.hanning(15), "same"), 1, noise)
    return (smooth * envelope).astype(np.float32)


def test_the_same_plate_is_steady_and_what_changed_is_measured_with_its_sign():
    then = responses()
    noise = 1e-3 * np.abs(then).max() * np.random.default_rng(2).standard_normal(then.shape)
    same = compare_sentinel(then, then + noise.astype(np.float32))
    assert same.verdict(LIMITS) == "steady"
    assert max(abs(same.level_db), abs(same.delay_samples)) < 0.05
    assert same.correlation > 0.999
    louder = compare_sentinel(then, then * np.float32(1.1))
    assert louder.level_db == pytest.approx(20 * np.log10(1.1), abs=1e-4)
    assert louder.verdict(LIMITS) == "warn"
    later = np.roll(then, 3, axis=1)
    assert compare_sentinel(then, later).delay_samples == pytest.approx(3.0, abs=0.2)
    assert compare_sentinel(later, then).delay_samples == pytest.approx(-3.0, abs=0.2)
    for pair in ((np.zeros_like(then), then), (then, np.zeros_like(then))):
        silent = compare_sentinel(*pair)
        assert (silent.verdict(LIMITS), silent.correlation) == ("stop", 0.0)


@pytest.mark.parametrize(
    ("figures", "limits", "verdict", "against"),
    [
        (DriftFigures(0.1, 0.0, 0.9995), {}, "steady", False),
        (DriftFigures(-0.6, 0.0, 0.9995), {}, "warn", True),
        (DriftFigures(-6.0, 0.0, 0.9995), {}, "stop", True),
        (DriftFigures(0.0, 0.7, 0.999), {}, "warn", False),
        (DriftFigures(0.0, -6.0, 0.95), {}, "stop", True),
        (DriftFigures(0.2, 0.1, 0.96), {}, "warn", False),
        (DriftFigures(-4.0, 0.1, 0.7), {}, "stop", True),
        (DriftFigures(1.0, 0.0, 0.999), {"stop_level_db": 0.9, "warn_level_db": 0.1}, "stop", True),
        (DriftFigures(1.0, 0.0, 0.999), {"warn_level_db": 1.1}, "steady", False),
        (DriftFigures(0.9, 1.5, 0.97, step=0.4), {}, "steady", False),
        (DriftFigures(0.1, 0.4, 0.999, step=1.5), {}, "warn", True),
        (DriftFigures(3.5, 0.0, 0.99, step=0.4), {}, "stop", True),
    ],
)
def test_figures_say_how_far_it_has_changed(figures, limits, verdict, against):
    limits = DriftLimits(**limits)
    assert (figures.verdict(limits), figures.speaks_against(limits)) == (verdict, against)


@pytest.mark.parametrize(
    ("positions", "position_s", "passes"),
    [(0, 10.0, 0), (1, 10.0, 0), (50, 1.0, 1), (51, 1.0, 2), (101, 1.0, 3), (1500, 74.5, 31), (10, 7200.0, 10)],
)
def test_a_campaign_s_measurements_of_the_sentinel_are_counted(positions, position_s, passes):
    assert LIMITS.passes(positions, position_s) == passes


# One clear actuator as of the campaign that stopped at +3.15 dB, the others mostly noise; all of them clear.
@pytest.mark.parametrize("snr_db", [(14.7, 3.0, 0.0, -3.0), (20.0, 15.0, 12.0, 11.0), (12.0, 2.0, 0.0, -6.0)])
def test_known_noise_is_no_drift_and_a_gain_is_still_seen(snr_db):
    chance, ratios_db = np.random.default_rng(4), np.array(snr_db, np.float32)
    response = responses() / np.linalg.norm(responses(), axis=1, keepdims=True)
    response[1:] *= 0.3  # far actuators: their noise is as loud as the clear one's, and little of it is response
    scale = np.linalg.norm(response, axis=1, keepdims=True) * 10 ** (-ratios_db[:, None] / 20) / np.sqrt(400)

    def measured(gain):
        return (gain * response + scale * chance.standard_normal(response.shape)).astype(np.float32)

    noise = ratios_db, (noise_share(-ratios_db),) * 2
    steady = [compare_sentinel(measured(1.0), measured(1.0), *noise) for _ in range(60)]
    assert {(one.verdict(LIMITS), one.speaks_against(LIMITS)) for one in steady} == {("steady", False)}
    louder = [compare_sentinel(measured(1.0), measured(10 ** (2.2 / 20)), *noise) for _ in range(20)]
    assert all(one.speaks_against(LIMITS) for one in louder)


@pytest.mark.parametrize(
    ("heard_before", "gain", "noisier", "found", "change"),
    [(False, 10 ** (1 / 20), 1, True, 0.122), (False, 1.0, 3, False, 0.0), (True, 1.0, 1, True, 0.5)],
    ids=["all louder", "noisier", "one has gone"],
)
def test_a_row_of_nothing_but_noise_hides_no_step_and_is_none(heard_before, gain, noisier, found, change):
    chance, rows = np.random.default_rng(5), responses() / np.linalg.norm(responses(), axis=1, keepdims=True)

    def look(heard, gain, noisier):  # with records of 20 dB the rows have 35 dB: the fit keeps 3 % of the noise
        noise = np.where(heard, 1, noisier)[:, None] * chance.standard_normal(rows.shape) * 10 ** (-35 / 20) / 20
        return (gain * heard[:, None] * rows + noise).astype(np.float32), np.where(heard, 20.0, -225.5)

    heard = np.array([True, True, True, heard_before])
    first, now = look(heard, 1.0, 1), look(np.array([True, True, True, False]), gain, noisier)
    sweep = SimpleNamespace(sample_rate_hz=1e4, band_hz=(0.0, 5e3), period_samples=13_000)
    places = {"actuator_mm": np.outer((60.0, 20.0, 40.0, 80.0), (1.0, 0.0)), "position_mm": np.zeros((1, 2))}
    plan = SimpleNamespace(excitation=sweep, staggered=None, taps=400, **places)
    figures = compare_looks(plan, 0, Look(*first), Look(*now))
    assert (figures.step > 1.0) == found
    assert figures.change == pytest.approx(change, abs=0.02)


RATE_HZ, TAPS, BAND_HZ = 10_000.0, 1000, (20.0, 500.0)
NOISE_SHARE = 10**-5.5


def truth(place_mm, warmer_k=0.0):
    """Green's functions of the soft plate, whose waves slow down and fade by half a percent and 2 % per kelvin."""
    keys = (("speed_per_k", -0.005), ("loss_per_k", 0.02))
    return VirtualRig(VirtualSettings(seed=3, plate_keys=keys, room_c=((0.0, 21.0 + warmer_k),))).truth(*place_mm, TAPS)


def step(then, now, place_mm, chance):
    """The figure of a change, with the noise of both looks."""
    return step_in(then, now, VirtualSettings().actuator_mm - np.array(place_mm), chance, NOISE_SHARE, RATE_HZ, BAND_HZ)


def step_in(then, now, actuators_mm, chance, noise_share, rate_hz, band_hz):
    """The same of any plate, its actuators as seen from the place."""
    rows, taps = [], then.shape[1]
    for green in (then, now):
        white = np.fft.rfft(chance.standard_normal(green.shape))
        hertz = np.fft.rfftfreq(taps, 1 / rate_hz)
        noise = np.fft.irfft(white * ((hertz >= band_hz[0]) & (hertz <= band_hz[1])), taps)
        norm = np.linalg.norm(green, axis=1, keepdims=True) / np.linalg.norm(noise, axis=1, keepdims=True)
        rows.append((green + np.sqrt(noise_share) * norm * noise).astype(np.float32))
    share = np.full((2, len(then)), noise_share)
    return step_of(*rows, share, np.hypot(*actuators_mm.T), band_hz=band_hz, sample_rate_hz=rate_hz)


def delayed(green, samples):
    taps = green.shape[1]
    turn = np.exp(-2j * np.pi * np.fft.rfftfreq(2 * taps) * samples)
    return np.fft.irfft(np.fft.rfft(green, 2 * taps) * turn)[:, :taps]


WAYS_MM = ((0.0, -0.3), (0.3, 0.0), (0.21, 0.21))
WARMER_K = (0.5, -0.5, 0.0, 0.25, -0.25)


@pytest.mark.parametrize(
    ("place_mm", "ways_mm", "warmer_k"),
    [
        ((-70.0, -40.0), WAYS_MM[:1], WARMER_K[:2]),
        *(pytest.param(at, WAYS_MM, WARMER_K, marks=pytest.mark.nightly) for at in ((-70.0, -40.0), (10.0, 5.0))),
    ],
    ids=["rim", "rim, every way", "middle, every way"],
)
def test_a_change_at_once_of_any_cause_then_it_is_a_step_and_slow_drift_is_none(place_mm, ways_mm, warmer_k):
    chance, then = np.random.default_rng(7), truth(place_mm)
    later, earlier = delayed(then, 0.3), delayed(then, -0.3)
    aside = [truth((place_mm[0] + x, place_mm[1] + y)) for x, y in ways_mm]
    louder, fainter = then * 10 ** (0.5 / 20), then * 10 ** (-0.5 / 20)
    swapped = then[[1, 0, *range(2, len(then))]]
    silent = np.where(np.arange(len(then))[:, None] == np.argmax(np.linalg.norm(then, axis=1)), 0.0, then)
    changes = [later, earlier, *aside, louder, fainter, -then, swapped, silent]
    assert all(step(then, now, place_mm, chance) > 1.0 for now in changes)
    warmer = [truth(place_mm, kelvin) for kelvin in warmer_k]
    assert all(step(then, now, place_mm, chance) < 1.0 for now in warmer)


ASIDE_MM = np.array([(0.0, 0.0), (0.3, 0.0), (-0.3, 0.0), (0.0, 0.3), (0.0, -0.3)])


@pytest.mark.parametrize(
    ("plate", "every"),
    [("gel", 30), *(pytest.param(plate, 6, marks=pytest.mark.nightly) for plate in analytic_plates.PLATES)],
)
def test_steps_of_the_limits_size_at_ten_places_are_found_and_noise_is_none(plate, every):
    chance, found = np.random.default_rng(11), {}
    for place_mm in analytic_plates.places_mm(plate)[3::every]:
        actuators_mm = analytic_plates.actuators_mm(plate) - place_mm
        then, *aside = analytic_plates.green(plate, place_mm=place_mm + ASIDE_MM)
        loudest = np.argmax(np.linalg.norm(then, axis=1))
        polarity = [-then, np.where(np.arange(len(then))[:, None] == loudest, -then, then)]
        media = [Medium(1 - 0.005 * kelvin, 1 + 0.02 * kelvin) for kelvin in (0.1, -0.1, 0.5)]
        *slow, sudden = (analytic_plates.green(plate, medium, place_mm[None])[0] for medium in media)
        changes = {
            "level": [10 ** (level_db / 20) * then for level_db in (0.5, -0.5)],
            "timing": [delayed(then, 0.3), delayed(then, -0.3)],
            "mirror": aside,
            "polarity": polarity,
            "0.1 K": slow,
            "0.5 K": [sudden],
            "none": [then, then],
        }
        for noise_db in (-48.0, -60.0):
            sweep = 10 ** (noise_db / 10), analytic_plates.RATE_HZ, analytic_plates.BAND_HZ
            for name, after in changes.items():
                marks = [step_in(then, now, actuators_mm, chance, *sweep) > 1.0 for now in after]
                found.setdefault(name, []).extend(marks)
    sys.stdout.write(f"\n| {plate} | {' | '.join(f'{sum(one)} of {len(one)}' for one in found.values())} |")
    assert all(found["level"] + found["timing"] + found["polarity"])
    assert all(found["mirror"]) or plate == "bending"
    assert not any(found["none"] + found["0.1 K"])


SNR_DB = 50.0
MIRROR_MM = ((0.0, -1.0), (-0.4, 0.3), (0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.7, 0.7))


@pytest.mark.parametrize(
    ("plate", "row", "ways_mm"),
    [
        ("gel", 31, MIRROR_MM[:3]),
        *(pytest.param(*at, MIRROR_MM, marks=pytest.mark.nightly) for at in (("mirrors", 14), ("disk", 48))),
    ],
    ids=["gel", "mirrors", "disk"],
)
def test_a_mirror_off_by_half_a_millimetre_or_one_is_found_in_every_direction(plate, row, ways_mm):
    rng, (bank, _) = np.random.default_rng(3), analytic_plates.lab(plate)
    places_mm = analytic_plates.places_mm(plate)[row] + np.array(ways_mm)
    for way_mm, green in zip(ways_mm, analytic_plates.green(plate, place_mm=places_mm), strict=True):
        level = 10 ** (-SNR_DB / 20) * np.linalg.norm(green, axis=1, keepdims=True) / np.sqrt(green.shape[1])
        seen = (green + level * rng.standard_normal(green.shape)).astype(np.float32)
        shift_mm = sentinel_shift_mm(Sentinel(row, seen, np.full(len(green), SNR_DB, np.float32)), bank)
        if any(way_mm):
            assert np.hypot(*(shift_mm - way_mm)) < 0.1
        else:
            assert shift_mm is None
