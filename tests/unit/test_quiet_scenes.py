"""Quiet places: filters of least energy, drives, levels, files and stiff cases."""

import json
import re
import threading
import time
from dataclasses import replace

import h5py
import numpy as np
import pytest
import scipy.fft

from tests.unit.line_verification import scan_of
from tests.unit.plate_banks import BAND_HZ, RATE_HZ, SPACING_MM, SQUARE_MM, TAPS, plate_bank, plate_greens
from wavefocus import Circle, GreenArray, Impulse, InputError, Line, Noise, Point, Sine, predict, quiet_levels
from wavefocus.config.scene import Output, Regularisation
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.scene.model import QuietPlace, Scene, Source
from wavefocus.rendering.scene.scene_rows import scene_rows
from wavefocus.rendering.scene.trajectory import TrajectoryPath
from wavefocus.rendering.verify.correction import control_rows
from wavefocus.rendering.verify.verdict import compare
from wavefocus.storage.drive_file import read_drive, write_drive

NOISE = Noise((60.0, 450.0), 0.5, 3)
SHORT = replace(NOISE, duration_s=0.2)
FOCUS = (-8.0, 0.0)
TAIL = round(0.05 * RATE_HZ)


@pytest.fixture(scope="module")
def bank():
    return plate_bank()


NEAREST = Output(interpolation="nearest")


def scene_of(*places, signal=NOISE, at=FOCUS, path=None, speed=0.0, level_db=-30.0, radius_mm=0.0, **keys):
    source = Source(path or Point(at), signal, 0.0, speed, 2.0)
    quiet = tuple(QuietPlace(Point(place), radius_mm=radius_mm, level_db=level_db) for place in places)
    return Scene("scene", (source,), quiet=quiet, **keys)


def plain_of(scene):
    return replace(scene, quiet=(), regularisation=Regularisation())


def row_at(bank, point):
    return int(np.argmin(np.hypot(*(bank.position_mm - point).T)))


def level_db(drive, bank, place):
    field = predict(drive, bank, [row_at(bank, place), row_at(bank, FOCUS)]).field
    return 10 * np.log10(np.divide(*np.square(field).sum(axis=1)))


def true_field(drive, points_mm):
    return predict(drive, GreenArray(plate_greens(points_mm), points_mm, RATE_HZ)).field


def energy(drive):
    return float(np.square(drive.drive_v).sum())


def test_a_quiet_place_then_its_level_is_met_and_the_response_at_the_focus_stays(bank):
    scene = scene_of((16.0, 8.0), (8.0, -16.0))
    plain, _ = render_with_report(plain_of(scene), bank)
    same = replace(plain_of(scene), output=Output(most_energy=2.0), regularisation=Regularisation(independent=True))
    assert render_with_report(same, bank)[0].drive_v.tobytes() == plain.drive_v.tobytes()
    drive, report = render_with_report(scene, bank)
    assert drive.start_s == plain.start_s
    assert drive.drive_v.shape[1] == plain.drive_v.shape[1] + TAIL
    for place in ((16.0, 8.0), (8.0, -16.0)):
        assert level_db(plain, bank, place) > -20
        assert level_db(drive, bank, place) == pytest.approx(-30, abs=0.3)
    assert energy(drive) / energy(plain) == pytest.approx(report.quiet.energy, rel=0.02)
    responses = [predict(one, bank, [row_at(bank, FOCUS)]).field[0] for one in (plain, drive)]
    off = responses[1][: len(responses[0])] - responses[0]
    assert np.linalg.norm(off) < 0.03 * np.linalg.norm(responses[0])
    found = quiet_levels(drive, bank)
    assert [one.reached_db for one in found] == pytest.approx([-30, -30], abs=0.3)
    assert [one.track.rendered_db for one in found] == pytest.approx([one.reached_db for one in found], abs=0.1)
    impulse = replace(scene.sources[0], signal=Impulse(), amplitude=3.0)
    drive, _ = render_with_report(replace(scene, sources=(impulse,)), bank)
    response = predict(drive, bank, [row_at(bank, FOCUS)]).field[0]
    assert response[TAPS - 1] == pytest.approx(3.0, rel=1e-9)


@pytest.mark.parametrize(("places", "saturation"), [(2, 0.0), (12, 0.8)])
def test_drives_agree_with_the_equations_solved_densely_at_each_frequency(bank, places, saturation):
    """w = A^-1 h* a / (h A^-1 h*) with the reported multipliers, by transforms of twice the filters' length.

    All multipliers are positive and all levels met exactly, so no other filters need less energy (Karush-Kuhn-Tucker).
    """
    at = [(16.0 - 4.0 * (k % 4), 8.0 + 4.0 * (k // 4)) for k in range(places)]
    scene = scene_of(*at, level_db=-20.0, regularisation=Regularisation(saturation=saturation))
    drive, report = render_with_report(scene, bank)
    green = bank.values[row_at(bank, FOCUS)]
    rms = np.sqrt(np.square(bank.values).mean(axis=2))
    own = np.sqrt(np.square(green).mean(axis=1))
    sigma = np.minimum(1.0, saturation * np.median(rms) / own) if saturation else np.ones(len(green))
    length = scipy.fft.next_fast_len(2 * (TAPS + TAIL), real=True)  # no other factors than 2, 3 and 5
    h = np.fft.rfft(green, length, axis=1).T
    q = np.stack([np.fft.rfft(bank.values[row_at(bank, one)], length, axis=1).T for one in at], axis=1)
    w = np.empty_like(h)
    for bin_ in range(len(h)):
        one, some = h[bin_] * np.sqrt(sigma), q[bin_] * np.sqrt(sigma)
        normal = np.eye(len(one)) + some.conj().T @ np.diag(report.quiet.multiplier) @ some
        z = np.linalg.inv(normal) @ one.conj()
        a = np.square(np.abs(one)).sum()
        w[bin_] = np.sqrt(sigma) * z * (a / (one @ z) if a > 0 else 1.0)
    in_time = np.fft.irfft(w, length, axis=0).T
    filters = np.concatenate([in_time[:, length - TAPS + 1 :], in_time[:, : TAIL + 1]], axis=1)
    gain = 1.0 / (sigma @ np.square(green).sum(axis=1))
    signal = NOISE.samples(RATE_HZ)
    expected = gain * np.stack([np.convolve(signal, one) for one in filters])
    assert drive.drive_v.shape == expected.shape
    assert np.linalg.norm(drive.drive_v - expected) < 1e-9 * np.linalg.norm(expected)
    assert (report.quiet.multiplier > 0).all()
    assert [track.rendered_db for track in report.quiet_tracks] == pytest.approx([-20.0] * places, abs=0.03)


@pytest.mark.parametrize(("seeds", "seconds", "apart_s"), [((1, 1, 1), 0.5, 0.0), ((0, 1, 2), 0.2, 0.15)])
def test_independent_sources_are_quiet_at_each_other_while_both_sound(bank, seeds, seconds, apart_s):
    at = [(-16.0, 0.0), (8.0, 12.0), (12.0, -16.0)]
    sources = tuple(
        Source(Point(one), Noise((60.0, 450.0), seconds, seed), apart_s * number)
        for number, (one, seed) in enumerate(zip(at, seeds, strict=True))
    )
    drive, report = render_with_report(Scene("three", sources, Regularisation(independent=True)), bank)
    assert max(one.reached_db for one in quiet_levels(drive, bank)) == pytest.approx(-30, abs=0.5)
    assert [one.source for one in report.quiet_tracks] == [0, 1, 2]
    if len(set(seeds)) == 1:  # of two at one place no level is stated
        sources = (*sources[:2], replace(sources[0], signal=SHORT))
        _, report = render_with_report(Scene("three", sources, Regularisation(independent=True)), bank)
        assert [one.source for one in report.quiet_tracks] == [0, 1, 2]
        _, report = render_with_report(Scene("two", sources[::2], Regularisation(independent=True)), bank)
        assert report.quiet_tracks == ()
        assert any(text.startswith("source 0 is at source 1") for text in report.warnings)


def test_independent_rests_between_jumps_are_each_quiet_and_one_thread_asks_a_bank(bank):
    asking, time_s = threading.Lock(), np.add.outer(0.04 * np.arange(12), (0.0, 0.02, 0.0395)).ravel()

    class Asked:
        def __getattr__(self, name):
            return getattr(bank, name)

        def green(self, position):
            assert asking.acquire(blocking=False)
            time.sleep(0.001)
            asking.release()
            return bank.green(position)

    taps_mm = [np.repeat(np.stack([4.0 * np.arange(12) - 20.0, np.full(12, y)], 1), 3, axis=0) for y in (0.0, 16.0)]
    sources = tuple(Source(TrajectoryPath(time_s, one, [0, 1, 0] * 12), NOISE) for one in taps_mm)
    _, report = render_with_report(Scene("taps", sources, Regularisation(independent=True), NEAREST), Asked())
    assert {*map(tuple, report.quiet_tracks[1].at_mm.tolist())} == {*map(tuple, taps_mm[1].tolist())}


def test_a_disc_between_positions_is_quiet_in_truth(bank):
    centre = np.array((14.0, 6.7))
    scene = scene_of(tuple(centre), radius_mm=4.0, level_db=-20.0)
    drive, _ = render_with_report(scene, bank)
    angle = 2 * np.pi * np.arange(12) / 12
    points = centre + np.concatenate([r * np.stack([np.cos(angle), np.sin(angle)], axis=1) for r in (1.5, 3.0, 4.0)])
    power = np.square(true_field(drive, np.vstack([points, FOCUS]))).sum(axis=1)
    assert 10 * np.log10(power[:-1].mean() / power[-1]) == pytest.approx(-20, abs=2.0)
    (level,) = quiet_levels(drive, bank)
    assert level.reached_db == pytest.approx(-20, abs=1.0)
    assert level.worst_db > level.reached_db


def test_resting_place_stays_quiet_while_source_moves_and_its_level_is_true_one(bank):
    place_mm, path, speed = (16.0, 8.0), Circle((-6.0, 0.0), 8.0, 0.5), 100.0
    scene = scene_of(place_mm, path=path, speed=speed, output=Output(interpolation="kernel"))
    drive, _ = render_with_report(scene, bank)
    points_mm = path.point_at(np.arange(0.0, path.length_mm, 0.25))
    field = true_field(drive, np.vstack([points_mm, place_mm]))
    sample = np.arange(int(path.length_mm / speed * RATE_HZ))
    now = sample - round(drive.start_s * RATE_HZ)
    focus = field[np.minimum((sample * speed / RATE_HZ / 0.25).astype(int), len(points_mm) - 1), now]
    true_db = 10 * np.log10(np.square(field[-1]).sum() / np.square(focus).sum())
    (level,) = quiet_levels(drive, bank)
    assert level.reached_db == pytest.approx(true_db, abs=0.5)
    assert true_db < -29


def test_a_place_that_moves_is_followed(bank):
    path = Line((8.0, -12.0), (20.0, 12.0))
    scene = replace(scene_of(signal=SHORT), quiet=(QuietPlace(path, speed_mm_s=120.0),))
    plain, _ = render_with_report(plain_of(scene), bank)
    drive, report = render_with_report(scene, bank)
    (track,) = report.quiet_tracks
    assert len(track.sample) > 2
    (before,), (after,) = quiet_levels(replace(plain, quiet=(track,)), bank), quiet_levels(drive, bank)
    assert before.reached_db > -15
    assert after.reached_db < -25
    assert energy(drive) < 4 * energy(plain)


def test_a_drive_file_keeps_its_quiet_places(bank, tmp_path):
    drive, _ = render_with_report(scene_of((16.0, 8.0)), bank)
    write_drive(tmp_path / "drive.h5", drive)
    (track,) = read_drive(tmp_path / "drive.h5").quiet
    assert track.plain() == drive.quiet[0].plain()
    write_drive(tmp_path / "plain.h5", replace(drive, quiet=()))
    assert read_drive(tmp_path / "plain.h5").quiet == ()
    good = drive.quiet[0].plain()
    wrong = ({"radius_mm": -1}, {"at_mm": [[float("nan"), 0]]}, {"sample": []})
    for content in ({}, [1], *([{**good, **one}] for one in wrong)):
        with h5py.File(tmp_path / "drive.h5", "r+") as file:
            file.attrs["quiet"] = json.dumps(content)
        with pytest.raises(InputError, match=r"attribute quiet|is damaged"):
            read_drive(tmp_path / "drive.h5")


def test_a_verification_states_the_levels_of_prediction_and_scan(bank):
    places = (16.0, 8.0), (8.0, -16.0)
    drive, _ = render_with_report(scene_of(*places, radius_mm=4.5, level_db=-20.0, signal=SHORT), bank)
    rows = control_rows(drive, bank.position_mm)
    prediction = predict(drive, bank, rows)
    at_focus = prediction.field[rows.tolist().index(row_at(bank, FOCUS))]
    heard, there = prediction.field + 0.1 * at_focus, prediction.position_index
    louder = scan_of(heard, prediction.start_s, RATE_HZ, position_index=there)
    verification = compare(prediction, louder, drive, bank)
    levels = [one for one in verification.figures if one.name.startswith("level at quiet")]
    assert [one.name for one in levels] == ["level at quiet[0]", "level at quiet[1]"]
    assert [one.predicted for one in levels] == pytest.approx([-20, -20], abs=1.5)
    assert all(-20 < one.scanned < -14 for one in levels)
    apart_mm = np.hypot(*(bank.position_mm[rows] - (16.0, 8.0)).T)
    assert set(rows) >= set(drive.focus_position)
    assert (apart_mm < 4.5).sum() == 5


def test_a_scene_needs_the_positions_around_its_quiet_places_and_independent_sources(bank):
    def needed(scene, position_mm=bank.position_mm, *, coarse=False):
        return set(scene_rows(scene, position_mm, coarse=coarse).path)

    added = needed(scene_of((16.5, 8.5))) - needed(scene_of())
    assert row_at(bank, (16.5, 8.5)) in added
    assert len(added) >= 36
    sources = tuple(Source(Point(at_mm), NOISE) for at_mm in ((-14.5, 0.5), (16.5, 8.5)))
    alone, independent = (
        needed(Scene("two", sources, Regularisation(independent=one), NEAREST)) for one in (False, True)
    )
    assert len(alone) < 10
    assert len(independent - alone) >= 2 * 36 - 10
    between, at_position = (
        needed(scene_of(one, output=NEAREST), 4.0 * SQUARE_MM, coarse=True) for one in ((24.0, 24.0), (32.0, 32.0))
    )
    assert len(at_position) < len(between) == len(SQUARE_MM)


def test_on_a_coarse_grid_it_is_said_how_quiet_a_place_between_positions_is_in_truth():
    coarse = GreenArray(plate_greens(4.0 * SQUARE_MM), 4.0 * SQUARE_MM, RATE_HZ, band_hz=BAND_HZ)
    for place, said in (((24.0, 24.0), 1), ((32.0, 32.0), 0)):
        _, report = render_with_report(scene_of(place, at=(0.0, 0.0), signal=SHORT), coarse)
        assert len([text for text in report.warnings if "between the grid's positions" in text]) == said


MOVING = scene_of(path=Line((-8.0, 0.0), (8.0, 0.0)), speed=50.0)
BESIDE = QuietPlace(Line((-8.0, 1.0), (8.0, 1.0)), speed_mm_s=50.0)
REFUSED = {
    "at the focus": (scene_of(FOCUS), "quiet[0]"),
    "disc around the focus": (scene_of((0.0, 0.0), FOCUS, radius_mm=4.0), "quiet[1]"),
    "outside the grid": (scene_of((90.0, 0.0)), "quiet[0]"),
    "goes with the source": (replace(MOVING, quiet=(BESIDE,)), "quiet[0]"),
}


@pytest.mark.parametrize("case", REFUSED)
def test_a_place_that_cannot_be_quiet_is_refused_by_name(bank, case):
    scene, name = REFUSED[case]
    with pytest.raises(InputError, match=f"^{re.escape(name)}"):
        render_with_report(scene, bank)


STIFF = {
    "a tenth of a millimetre from the focus": scene_of((-7.9, 0.05), (16.0, 8.0), signal=SHORT),
    "two at one place": scene_of((16.0, 8.0), (16.0, 8.0), signal=SHORT),
    "thirty": scene_of(*[(x, y) for x in range(0, 22, 4) for y in range(-20, 20, 8)], signal=SHORT),
    "a level beyond reach": scene_of((16.0, 8.0), level_db=-300.0, signal=SHORT),
    "a source that runs through it": scene_of(
        (4.0, 0.0), path=Line((-12.0, 0.0), (12.0, 0.0)), speed=160.0, output=NEAREST
    ),
    "a sine": scene_of((16.0, 8.0), signal=Sine(250.0, 0.2)),
    "hardly moves": scene_of((16.0, 8.0), signal=SHORT),
    "does not move": scene_of((16.0, 8.0), signal=SHORT),
}
STILL = {"hardly moves": 1e-60, "does not move": 0.0}
MISSED = {"a tenth of a millimetre from the focus": ["quiet[0]"], "a level beyond reach": ["quiet[0]"]}


@pytest.mark.parametrize("case", STIFF)
def test_stiff_scenes_are_finite_within_the_energy_and_say_what_is_not_reached(bank, case):
    scene = STIFF[case]
    bank = replace(bank, values=bank.values.copy())
    bank.values[row_at(bank, (16.0, 8.0))] *= STILL.get(case, 1.0)
    plain, _ = render_with_report(plain_of(scene), bank)
    drive, report = render_with_report(scene, bank)
    assert np.isfinite(drive.drive_v).all()
    assert energy(drive) <= 10.5 * energy(plain)
    missed = [track.name for track in report.quiet_tracks if track.rendered_db > track.level_db + 0.5]
    assert all(any(name in text for text in report.warnings) for name in missed)
    if case == "thirty":
        assert missed
    elif "through" in case:
        assert any("source 0 is at quiet[0]" in text for text in report.warnings)
    else:
        assert missed == MISSED.get(case, [])


def test_banks_of_one_actuator_on_one_line_or_without_a_band():
    place, line_mm = (16.0, 0.0), SPACING_MM * np.stack([np.arange(-4.0, 8), np.zeros(12)], 1)
    one = GreenArray(plate_bank().values[:, :1], plate_bank().position_mm, RATE_HZ, band_hz=BAND_HZ)
    drive, report = render_with_report(scene_of(place), one)
    assert any("quiet[0] reaches" in text for text in report.warnings)
    plain, _ = render_with_report(plain_of(scene_of()), one)
    assert level_db(drive, one, place) == pytest.approx(level_db(plain, one, place), abs=0.01)
    on_a_line = GreenArray(plate_greens(line_mm), line_mm, RATE_HZ, band_hz=BAND_HZ)
    for some in (on_a_line, GreenArray(plate_bank().values, plate_bank().position_mm, RATE_HZ)):
        drive, _ = render_with_report(scene_of(place), some)
        assert level_db(drive, some, place) == pytest.approx(-30, abs=0.5)
    apart_mm = np.concatenate([line_mm, np.add(line_mm, (0.0, 40.0))])
    with pytest.raises(InputError, match=r"quiet\[0\] lies at \(16, 20\) mm, 20 mm"):
        render_with_report(scene_of((16.0, 20.0)), GreenArray(plate_greens(apart_mm), apart_mm, RATE_HZ))
