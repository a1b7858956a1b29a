"""The benchmarks run in small."""

import pytest

from wavefocus.benchmarks import bank, commands, interpolation, paper, plate

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


def test_the_commands_benchmark_times_whole_commands():
    points = commands.run(quick=True).points
    assert all(one.timing.wall_s > 0 and one.timing.peak_mb > 10 for one in points)
