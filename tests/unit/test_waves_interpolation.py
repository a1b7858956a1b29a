"""Interpolation "waves" and "auto" on a coarse bank of a disk with a free rim, and the model kept next to it."""

from dataclasses import replace
from functools import cache

import h5py
import numpy as np
import pytest

import wavefocus as wf
from tests.lab_files import write_bank
from tests.unit.independent_plates import free_disk, lattice
from wavefocus import Circle, GreenArray, InputError, Noise, Point, QuietPlace, Scene, Source, predict
from wavefocus.config.scene import Output
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.foci import predicted_focus_peak
from wavefocus.rendering.greens.interpolation import waves as waves_module
from wavefocus.rendering.greens.interpolation.base import interpolation_method
from wavefocus.rendering.greens.interpolation.errors import choose_interpolation
from wavefocus.rendering.greens.source import RowReader
from wavefocus.rendering.live.engine import LiveEngine
from wavefocus.rendering.live.finer import finer_rows
from wavefocus.storage.wave_file import wave_file, write_wave_file

RATE_HZ, TAPS, BAND_HZ, HZ = 2000.0, 80, (230.0, 340.0), (250.0, 330.0)
CHECKS = 24
RADIUS_MM, SPEED_MM_S, LOSS_PER_S = 50.0, 4750.0, 420.0
RNG = np.random.default_rng(4)
ANGLE = np.pi * np.arange(2) + 0.2
ACTUATOR_MM = 44.0 * np.stack([np.cos(ANGLE), np.sin(ANGLE)], axis=1)
SIGNAL = np.eye(1, 64)[0]


def inside(count, radius_mm=36.0):
    points = RNG.uniform(-radius_mm, radius_mm, (3 * count, 2))
    return points[np.hypot(*points.T) < radius_mm][:count]


def responses(points_mm):
    """Green's functions (points, actuators, taps) of point sources in a disk, by the addition theorem."""
    samples = 4 * TAPS
    hz = np.fft.rfftfreq(samples, 1 / RATE_HZ)
    outside = np.maximum(np.log2(BAND_HZ[0] / np.maximum(hz, 1e-9)), np.log2(np.maximum(hz, 1e-9) / BAND_HZ[1]))
    weight = 0.5 + 0.5 * np.cos(np.pi * np.clip(outside / 0.25, 0, 1))
    spectra = np.zeros((len(points_mm), len(ACTUATOR_MM), len(hz)), complex)
    for number in np.flatnonzero(weight > 0):
        omega = 2 * np.pi * hz[number]
        k = np.sqrt(omega**2 - 1j * omega * LOSS_PER_S) / SPEED_MM_S
        spectra[..., number] = weight[number] * free_disk(k, points_mm, ACTUATOR_MM, RADIUS_MM, 40)
    return np.fft.irfft(spectra, samples)[..., :TAPS]


def at_frequencies(green, hz=HZ):
    return green @ np.exp(-2j * np.pi * np.outer(np.arange(green.shape[-1]), np.array(hz) / RATE_HZ))


POINTS_MM = inside(40)


@cache
def truth():
    """Green's functions at the points, (points, actuators, taps)."""
    return responses(POINTS_MM)


@pytest.fixture(scope="module")
def coarse():
    """Positions 11 mm apart (wave number times spacing up to 5), and 24 more that judge."""
    position_mm = np.vstack([lattice(11.0, 40.0), inside(CHECKS)])
    green = responses(position_mm)
    green += 1e-3 * np.sqrt(np.square(green).mean(axis=2, keepdims=True)) * RNG.standard_normal(green.shape)
    check = np.arange(len(position_mm)) >= len(position_mm) - CHECKS
    return GreenArray(green, position_mm, RATE_HZ, actuator_mm=ACTUATOR_MM, band_hz=BAND_HZ, check=check)


@pytest.fixture(scope="module")
def small(coarse):
    """The same with 11 positions that judge, one actuator and a band of 20 Hz: fitted in a second."""
    left = slice(11 - CHECKS)
    green, position_mm, check = coarse.values[left, :1], coarse.position_mm[left], coarse.check[left]
    return GreenArray(green, position_mm, RATE_HZ, actuator_mm=ACTUATOR_MM[:1], band_hz=(240.0, 260.0), check=check)


def test_auto_takes_waves_where_the_kernel_cannot_and_states_error_and_bound(coarse):
    right = at_frequencies(truth())
    missed, found = {}, {}
    for name in ("auto", "kernel"):
        found[name] = wf.interpolate(coarse, POINTS_MM, method=name, frequency_hz=HZ)
        missed[name] = np.abs(at_frequencies(found[name].green - truth()))
    by_waves, by_kernel = (np.linalg.norm(wrong, axis=1) / np.linalg.norm(right, axis=1) for wrong in missed.values())
    assert (np.median(by_waves, axis=0) < 0.08).all()
    assert (np.median(by_kernel, axis=0) > 0.4).all()
    auto = found["auto"]
    assert (auto.method, auto.bound.shape) == ("waves", (len(POINTS_MM), 2, 2))
    assert 0.8 < (missed["auto"] <= auto.bound).mean() <= 1.0
    assert 0.4 < np.median(auto.expected_error) / np.sqrt(np.median(np.square(missed["auto"])) / np.log(2)) < 2.5
    assert "95%" in auto.bound_words
    choice = choose_interpolation(coarse, POINTS_MM, [SIGNAL]).choice
    assert choice.judged_by == "check positions"
    assert choice.errors["waves"] < 0.1
    assert choice.errors["kernel"] > 0.4
    at = wf.interpolate(coarse, coarse.position_mm[:2])
    assert at.method == "nearest"
    np.testing.assert_array_equal(at.green, coarse.values[:2])


def test_live_sources_take_rows_between_the_positions_of_a_coarse_grid(coarse):
    engine = LiveEngine(coarse, block_samples=10, look_ahead_samples=0, interpolation="auto")
    name, finer = finer_rows(coarse, "auto", SIGNAL)
    assert name == "waves"
    places_mm = np.array([[-13.0, 6.0], [17.0, -20.0], [5.0, 16.0]])
    rows = finer.nearest(places_mm)
    assert (rows >= coarse.positions).all()
    assert np.hypot(*(finer._grid.nearest(places_mm)[1], 0.0)).max() < 1.5
    hz = np.arange(0, 401) * 1.0
    filters = finer.filters(lambda row: np.zeros(0), hz)[rows - coarse.positions][..., 250:331:40]
    at_mm = finer._grid.position_mm[finer._grid.nearest(places_mm)[0]]
    right = at_frequencies(responses(at_mm), hz[250:331:40]).conj()
    assert np.linalg.norm(filters - right) < 0.1 * np.linalg.norm(right)
    engine.move("finger", (5.0, 16.0))
    assert np.abs(engine.next_block()).max() > 0


def test_auto_with_11_check_positions_judges_left_out_ones_and_states_no_bound(small):
    method = choose_interpolation(small, POINTS_MM, [SIGNAL])
    assert (method.name, method.choice.judged_by) == ("waves", "left-out positions")
    found = wf.interpolate(small, POINTS_MM[:3], frequency_hz=[250.0])
    assert (found.method, found.green.shape, found.expected_error.shape) == ("waves", (3, 1, TAPS), (3, 1, 1))
    assert np.isfinite(found.expected_error).all()
    assert np.isnan(found.bound).all()
    assert "fewer than 12" in found.bound_words


def test_wrong_places_methods_and_frequencies_are_refused(coarse):
    for wrong, words in (
        ({"places_mm": [1.0, 2.0]}, "places_mm has shape"),
        ({"places_mm": [(np.nan, 0.0)]}, "places_mm holds NaN"),
        ({"places_mm": [(500.0, 0.0)], "method": "nearest"}, "nearest position"),
        ({"places_mm": [(1e200, 0.0)]}, "nearest position"),
        ({"method": "cubic"}, "interpolation is 'cubic'"),
        ({"frequency_hz": [-1.0]}, "frequency_hz is"),
    ):
        with pytest.raises(InputError, match=words):
            wf.interpolate(coarse, **{"places_mm": [(1.0, 2.0)], **wrong})


def test_a_scene_with_auto_states_what_was_chosen_and_its_error(coarse):
    source = Source(Circle((1.0, 0.5), 20.0), Noise((240.0, 330.0), 0.5, 1), 0.0, 80.0, 4.0)
    scene = Scene("circle", (source,), output=Output(interpolation="auto"))
    _, report = render_with_report(scene, coarse, method="exact")
    errors = report.interpolation_errors
    assert (errors.kind, errors.found_by, errors.choice.judged_by) == ("waves", "check positions", "check positions")
    assert 1e-3 < errors.overall < 0.15


def test_response_and_levels_are_stated_at_the_focus_not_the_nearest_position(coarse, tmp_path):
    focus_mm, place_mm = (4.8, 5.6), (-13.0, 6.0)
    source = Source(Point(focus_mm), Noise((240.0, 330.0), 0.5, 1))
    quiet = (QuietPlace(Point(place_mm), level_db=-20.0),)
    scene = Scene("between", (source,), output=Output(interpolation="waves"), quiet=quiet)
    wf.write_drive(tmp_path / "drive.h5", render_with_report(scene, coarse)[0])
    drive = wf.read_drive(tmp_path / "drive.h5")
    np.testing.assert_array_equal(drive.focus_mm, [focus_mm])
    at_focus = GreenArray(responses(np.array([focus_mm])), np.array([focus_mm]), RATE_HZ)
    largest = np.abs(predict(drive, at_focus).field).max()
    nearest = np.abs(predict(drive, coarse, drive.focus_position.tolist()).field).max()
    assert nearest < 0.85 * largest
    assert predicted_focus_peak(drive, coarse) == pytest.approx(largest, rel=0.1)
    (level,) = wf.quiet_levels(drive, coarse)
    assert level.reached_db == pytest.approx(-20, abs=0.5)


def test_a_bank_that_waves_cannot_be_fitted_to_is_refused():
    line_mm, unknown_mm = np.stack([np.linspace(-30, 30, 20), np.zeros(20)], axis=1), ACTUATOR_MM.copy()
    unknown_mm[1] = np.nan
    for position_mm, actuator_mm, message in (
        (lattice(11.0, 40.0), unknown_mm, "does not say where actuator 1 is"),
        (line_mm, ACTUATOR_MM, "on one line"),
        (lattice(11.0, 40.0)[:8], ACTUATOR_MM, "8 measured positions are too few"),
    ):
        green = np.ones((len(position_mm), 2, TAPS))
        bank = GreenArray(green, position_mm, RATE_HZ, actuator_mm=actuator_mm, band_hz=BAND_HZ)
        with pytest.raises(InputError, match=message):
            interpolation_method("waves").over(bank, POINTS_MM)


def test_a_check_row_of_nothing_but_noise_has_no_more_noise_than_energy(tmp_path):
    run = '{"sweep": {"duration_s": 1.0}, "capture": {"excitation": "sequential", "decay_s": 0.3}}'
    with wf.open_bank(write_bank(tmp_path / "a.h5", np.ones((1, 2, TAPS)))) as written:
        bank = replace(written, run_json=run, quality={"snr_db": np.array([[-225.5, 40.0]])})
        silent, heard = waves_module._spectral_noise(bank, RowReader(bank), np.array([0]))[0] ** 2
    assert silent == pytest.approx(TAPS * 1e4 / (2 * 480))  # white in a band of 480 Hz at 10 kHz
    assert heard < 1e-4 * silent


def test_check_positions_are_not_on_the_grid_of_any_method(coarse):
    for name in ("nearest", "bilinear", "kernel", "waves"):
        method = interpolation_method(name).over(coarse, POINTS_MM)
        assert not coarse.check[method.nodes(lattice(11.0, 25.0)).nearest].any()
        assert not coarse.check[method.nodes(coarse.position_mm[coarse.check][:3] * 0.5).nearest].any()


@pytest.fixture
def bank_file(small, tmp_path):
    path = tmp_path / "disk.h5"
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate_hz"], file.attrs["band_hz"] = RATE_HZ, small.band_hz
        file["green"], file["position_mm"] = small.values[~small.check], small.position_mm[~small.check]
        file["actuator_mm"] = small.actuator_mm
    return path


def values_of(path):
    waves_module._models.clear()  # as in another process
    with wf.open_bank(path) as bank:
        return interpolation_method("waves").over(bank, POINTS_MM).waves.model.values(POINTS_MM[:5])


@pytest.mark.long
def test_the_model_is_kept_next_to_the_bank_and_never_used_for_other_contents(bank_file):
    kept, first = wave_file(bank_file), values_of(bank_file)
    content, written = kept.read_bytes(), kept.stat()
    np.testing.assert_array_equal(values_of(bank_file), first)
    assert (kept.stat().st_mtime_ns, kept.stat().st_ino) == (written.st_mtime_ns, written.st_ino)  # read, not made anew
    kept.write_bytes(content[: len(content) // 2])
    np.testing.assert_array_equal(values_of(bank_file), first)
    assert kept.read_bytes() == content
    with h5py.File(bank_file, "r+") as file:
        file["green"][3] *= 1.01
    assert not np.array_equal(values_of(bank_file), first)
    assert kept.read_bytes() != content


@pytest.mark.long
def test_a_kept_model_of_no_use_is_made_anew_and_another_file_of_its_name_stays(bank_file):
    kept, first = wave_file(bank_file), values_of(bank_file)
    for name, wrong in (("strength", np.zeros((2, 2))), ("power", np.full((3, 1), np.nan)), ("samples", np.array(-5))):
        # Sealed as sound, under the right key, and of no use: a file that another program wrote.
        arrays = waves_module._arrays(waves_module._models[next(iter(waves_module._models))]) | {name: wrong}
        assert write_wave_file(kept, next(iter(waves_module._models)), arrays)
        np.testing.assert_array_equal(values_of(bank_file), first)
    kept.write_text("notes of mine", encoding="utf-8")
    np.testing.assert_array_equal(values_of(bank_file), first)
    assert kept.read_text(encoding="utf-8") == "notes of mine"
