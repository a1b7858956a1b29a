"""``[grid] check_positions``: in the plan, in a bank, in what a resume reads."""

from dataclasses import replace

import numpy as np
import pytest

import wavefocus as wf
from tests.lab_files import write_bank
from tests.unit.plate_banks import SQUARE_MM, plate_bank
from wavefocus import InputError, Point, Scene, Sine, Source
from wavefocus.acquisition.judgement import in_band
from wavefocus.campaign.blueprint import blueprint_from_bank, blueprint_of
from wavefocus.campaign.session_files import with_bank
from wavefocus.config.scene import Output
from wavefocus.configuration import check_rows, load_run
from wavefocus.rendering.greens.interpolation.base import scene_interpolation
from wavefocus.rendering.scene.scene_rows import scene_rows
from wavefocus.storage.bank.writer import create_bank


def loaded(folder, grid, sweep=""):
    path = folder / "run.toml"
    path.write_text(f'rig = "virtual"\n[grid]\n{grid}\n[sweep]\n{sweep}\n', encoding="utf-8")
    return load_run(path)


@pytest.mark.parametrize(
    ("grid", "sweep", "count"),
    [
        ("spacing_mm = 4.0", "", 0),
        ("spacing_mm = 10.0", "", 24),
        ("spacing_mm = 10.0", "stop_hz = 200.0", 0),  # half a wavelength is 12 mm
        ("spacing_mm = 10.0\ncheck_positions = 0", "", 0),
        ("spacing_mm = 4.0\ncheck_positions = 5", "", 5),
        ('lattice = "hexagonal"\nspacing_mm = 20.0', "", 24),
    ],
)
def test_check_positions_follow_the_grid_where_it_is_coarser_than_half_a_wavelength(tmp_path, grid, sweep, count):
    configuration = loaded(tmp_path, grid, sweep)
    rows = check_rows(configuration)
    total = len(configuration.position_mm)
    assert rows.tolist() == list(range(total - count, total))
    assert blueprint_of(configuration).bank_header().check_rows == tuple(rows.tolist())


def test_check_positions_beside_the_grid_then_a_cell_s_middle_is_still_on_it():
    place_mm = np.vstack([SQUARE_MM, SQUARE_MM + np.array([0.5, 0.0])])
    check = np.arange(len(place_mm)) >= len(SQUARE_MM)
    bank = replace(plate_bank(place_mm), check=check)
    scene = Scene("middle", (Source(Point((2.0, 2.0)), Sine(200.0, 0.1)),), output=Output(interpolation="auto"))
    assert scene_interpolation(scene, bank).name == "kernel"
    rows = scene_rows(scene, place_mm, check).path
    corners = np.flatnonzero(np.hypot(*(SQUARE_MM - 2.0).T) < 3.0)
    assert (len(corners), set(corners) <= set(rows)) == (4, True)


def test_a_netcdf_export_then_has_the_check_positions_and_the_report_of_its_rows(tmp_path):
    path = write_bank(tmp_path / "a.h5", np.ones((4, 2, 16)), check_rows=(1, 3))
    with wf.open_bank(path) as bank:
        imported = replace(bank, import_report='{"caution": "a projection"}')
        wf.export_bank(imported, tmp_path / "a.nc", "netcdf", positions=[0, 2, 3])
    with wf.open_bank(tmp_path / "a.nc") as copy:
        assert (copy.check_rows, copy.import_facts) == ((2,), {"caution": "a projection"})


def begun_earlier(folder, grid, checks=None):
    """A bank as versions without check positions, or with 12 of them, began it."""
    earlier = loaded(folder, f"{grid}\ncheck_positions = {checks or 0}")
    run = earlier.run.model_copy(update={"grid": earlier.run.grid.model_copy(update={"check_positions": checks})})
    create_bank(folder / "plate.h5", blueprint_of(replace(earlier, run=run)).bank_header())
    return folder / "plate.h5"


@pytest.mark.parametrize(("lattice", "checks"), [("square", None), ("hexagonal", 12)])
def test_a_coarse_bank_begun_with_fewer_check_positions_goes_on_with_its_own(tmp_path, lattice, checks, capsys):
    grid = f'lattice = "{lattice}"\nspacing_mm = 40.0'
    bank = begun_earlier(tmp_path, grid, checks)
    own = blueprint_from_bank(bank)
    blueprint, _ = with_bank(blueprint_of(loaded(tmp_path, grid)), bank, tmp_path / "run.toml")
    assert blueprint.plan.sha256 == own.plan.sha256
    assert len(blueprint.bank_header().check_rows) == (checks or 0)
    assert "24 check positions" in capsys.readouterr().err


@pytest.mark.parametrize("asked", ["spacing_mm = 40.0\ncheck_positions = 5", "spacing_mm = 30.0"])
def test_other_positions_than_those_of_an_earlier_bank_are_refused(tmp_path, asked):
    bank = begun_earlier(tmp_path, "spacing_mm = 40.0")
    with pytest.raises(InputError, match="position_mm"):
        with_bank(blueprint_of(loaded(tmp_path, asked)), bank, tmp_path / "run.toml")
    (tmp_path / "grid.csv").write_text("x_mm,y_mm\n0,0\n1,0\n", encoding="utf-8")
    with pytest.raises(InputError, match=r"grid\.check_positions"):
        loaded(tmp_path, 'positions_file = "grid.csv"\ncheck_positions = 3')


@pytest.mark.long
def test_check_positions_are_measured_four_times_and_averaged(tmp_path):
    run = {
        "grid": {"margin_mm": 10.0, "check_positions": 3}, "sweep": {"duration_s": 0.2},
        "capture": {"averages": 1, "decay_s": 0.1, "keep_raw": True},
    }  # fmt: skip
    rig = wf.virtual_rig(actuators=3, spacing_mm=110.0, seed=2, noise_v=2e-3, run=run)
    with rig.measure(tmp_path / "a.h5") as four, wf.estimate(tmp_path / "a.raw.h5", tmp_path / "once.h5") as once:
        check = four.check
        assert check.sum() == 3
        louder_db = four.quality["snr_db"] - once.quality["snr_db"]
        assert np.allclose(louder_db[~check], 0.0)
        assert abs(louder_db[check].mean() - 6.0) < 0.5
        rows = np.flatnonzero(check).tolist()
        missed = [[bank.green(row) - rig.truth(row) for row in rows] for bank in (four, once)]
        averaged, single = (np.linalg.norm(in_band(np.concatenate(part), 10_000.0, (20.0, 500.0))) for part in missed)
        assert averaged < 0.63 * single  # a half, but for chance
