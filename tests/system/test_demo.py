"""The benchmarks run in small, and the errors that the demo states."""

import numpy as np
import pytest

from wavefocus.benchmarks import bank, commands, interpolation, paper, plate
from wavefocus.commands.demo import compare_with_truth
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.rendering.greens.source import GreenArray


def test_given_a_known_error_of_some_places_then_it_is_stated():
    rig = VirtualRig(VirtualSettings())
    places_mm = np.array([[3.0, 4.0], [-21.0, 7.5], [40.0, -12.0]])
    true = np.stack([rig.truth(x_mm, y_mm, 2000) for x_mm, y_mm in places_mm])
    green = true * np.array([1.0, 1.1, 0.99])[:, None, None]
    bank = GreenArray(green, places_mm, 10_000.0, status=np.ones(3, np.uint8), band_hz=(20.0, 500.0))
    error_db = compare_with_truth(bank, rig)
    assert error_db.shape == (3, 20)
    assert (error_db[0] < -100.0).all()
    assert error_db[1] == pytest.approx(-20.0, abs=0.01)
    assert error_db[2] == pytest.approx(-40.0, abs=0.01)


pytestmark = [pytest.mark.timeout(900), pytest.mark.nightly]


def test_the_paper_s_figures_are_drawn_and_its_numbers_compared_misses_included(tmp_path):
    points = {one.method: one for one in paper.run(tmp_path, quick=True).points}
    for name in ("3A", "3B", "3C", "3D", "4A", "4B", "4C", "4D"):
        png = (tmp_path / f"{name}.png").read_bytes()
        assert png.startswith(b"\x89PNG")
        assert len(png) > 10_000
    for what in ("group velocity", "attenuation", "focal width", "measured and predicted field"):
        assert all(points[what].figures[f"{plate}_as_the_paper"] is True for plate in ("soft", "stadium"))
        assert points[what].remark
    assert points["range of n(x) without"].figures["stadium_as_the_paper"] is False
    assert not list(tmp_path.glob("*.h5"))


def test_the_interpolation_benchmark_reaches_its_marks():
    points = interpolation.run(quick=True).points
    marked = [one for one in points if one.marks]
    assert len(marked) == 4
    assert all(one.met for one in marked)


def test_the_bank_s_benchmark_commits_every_position_and_reads_it_back(tmp_path):
    commit = bank.run(tmp_path, quick=True).points[0]
    assert 0 < commit.figures["median_ms"] <= commit.figures["worst_ms"]
    assert not list(tmp_path.iterdir())


def test_the_plates_benchmark_converges():
    points = plate.run(quick=True).points
    for method in ("elements of fourth order", "leapfrog at its limit"):
        error = [one.error for one in points if one.method == method]
        assert len(error) >= 2
        assert error == sorted(error)
    assert all(one.error < 1e-6 for one in points if one.method.startswith("table"))


def test_the_commands_benchmark_times_whole_commands_and_a_tolerance_s_error():
    points = commands.run(quick=True).points
    assert all(one.timing.wall_s > 0 and one.timing.peak_mb > 10 for one in points)
    found = {one.parameters.get("tolerance_db"): one.error for one in points if one.parameters}
    assert set(found) == {-80.0, -60.0, -40.0}
    assert all(error <= 10 ** (db / 20) for db, error in found.items())
