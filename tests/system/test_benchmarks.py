"""The benchmarks of rendering run in small, and what they claim of themselves holds."""

from __future__ import annotations

import pytest

from benchmarks import bank, cluster, focusing, interpolation, paper

pytestmark = [pytest.mark.timeout(900), pytest.mark.long]


def test_the_paper_s_figures_are_drawn_and_its_numbers_stand_beside_ours(tmp_path):
    figures = paper.run(tmp_path, quick=True)
    for name in ("3A", "3B", "3C", "3D", "4A", "4B", "4C", "4D"):
        png = (tmp_path / f"{name}.png").read_bytes()
        assert png.startswith(b"\x89PNG")
        assert len(png) > 10_000
    rows = {row["what"]: row for row in figures["rows"]}
    for what in ("group velocity", "attenuation", "focal width", "measured and predicted field"):
        assert rows[what]["met"] is True
        assert rows[what]["definition"]
    # A miss is told, not left out: without saturation n(x) ranges further on a plate whose rim does not reflect.
    assert rows["range of n(x) without"]["met"] is False
    table = (tmp_path / "paper.md").read_text(encoding="utf-8")
    assert "**not** as the paper" in table
    assert not (tmp_path / "plate.h5").exists()


def test_the_interpolation_benchmark_reaches_its_marks(capsys):
    figures = interpolation.run(quick=True)
    assert figures["marks"] == {"wanted": 4, "reached": 4}
    assert "hexagonal" in capsys.readouterr().out


def test_the_focusing_benchmark_compares_methods_on_one_scene(capsys):
    results = focusing.run(quick=True)["results"]
    plain = next(one for one in results if one["method"] == "time reversal")
    assert plain["energy"] == plain["peak"] == 1.0
    assert plain["at_focus"] == pytest.approx(1.0, abs=1e-3)
    assert {one["scene"] for one in results} == {"one point in the middle", "two points 12 mm apart"}
    two = [one for one in results if one["scene"].startswith("two") and one["method"].startswith("inverse")]
    assert all(one["condition"] > 1.0 for one in two)
    assert "artefacts" in capsys.readouterr().out


def test_the_bank_s_benchmark_commits_every_position_and_reads_it_back(tmp_path, capsys):
    figures = bank.run(tmp_path, quick=True)
    assert figures["positions"] == 40
    assert 0 < figures["commit_ms"]["median"] <= figures["commit_ms"]["worst"]
    assert "every row's checksum verified" in capsys.readouterr().out
    assert not list(tmp_path.iterdir())


def test_the_cluster_s_benchmark_writes_the_same_bytes_within_its_limit(tmp_path, capsys):
    pytest.importorskip("distributed")
    figures = cluster.run(tmp_path, quick=True)
    assert figures["same_bytes"] == {"predict": True, "estimate": True}
    for found in figures["rows"].values():
        assert all(0 < one["peak_mb"] < cluster.LIMIT_MB for one in found.values())
        assert found["2 workers"]["starting_s"] > 0
    assert "10,000 x 10,000" in capsys.readouterr().out
    assert [path.name for path in tmp_path.iterdir()] == ["cluster.md"]
