"""What a check of a bank finds."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from calibration.check import Finding, check_bank
from storage.bank.layout import BankHeader
from storage.bank.ledger import PointRecord
from storage.bank.reading import open_bank
from storage.bank.writer import BankWriter, create_bank
from storage.errors import InputError
from tests.unit.plate_banks import ACTUATOR_MM, BAND_HZ, RATE_HZ, plate_bank
from tests.unit.plate_banks import TAPS as TAPS_OF_PLATE
from wavefocus.__main__ import run

POSITIONS, ACTUATORS, TAPS = 6, 3, 200


def responses() -> np.ndarray:
    """Responses that have died away by the last tenth of the taps."""
    noise = np.random.default_rng(0).normal(size=(POSITIONS, ACTUATORS, TAPS))
    return (noise * np.exp(-np.arange(TAPS) / 15)).astype(np.float32)


def measured(path: Path, green: np.ndarray, grid: np.ndarray | None = None) -> Path:
    if grid is None:
        grid = np.stack([np.arange(POSITIONS) * 4.0, np.zeros(POSITIONS)], axis=1)
    unknown = np.full((ACTUATORS, 2), np.nan)
    create_bank(path, BankHeader(10_000.0, TAPS, (20.0, 500.0), grid, unknown, "{}", "{}", "ab" * 32, "test"))
    figures = np.ones(ACTUATORS, np.float32)
    with BankWriter.open(path) as writer:
        for position, row in enumerate(green):
            writer.commit(position, row, PointRecord(1, 1, figures, figures, figures, figures))
    return path


def flip(path: Path, offset: int) -> None:
    with path.open("r+b") as file:
        file.seek(offset)
        byte = file.read(1)[0]
        file.seek(offset)
        file.write(bytes([byte ^ 4]))


def only(findings: list[Finding]) -> Finding:
    assert len(findings) == 1, findings
    return findings[0]


def test_a_sound_bank_then_has_no_findings(tmp_path: Path) -> None:
    assert check_bank(measured(tmp_path / "bank.h5", responses())) == []


def test_a_half_measured_bank_then_has_no_findings(tmp_path: Path) -> None:
    assert check_bank(measured(tmp_path / "bank.h5", responses()[:2])) == []


def test_a_flipped_byte_in_the_data_then_is_an_error_at_its_position(tmp_path: Path) -> None:
    path = measured(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r") as file:
        offset = file["green"].id.get_chunk_info(4).byte_offset
    flip(path, offset + 9)
    finding = only(check_bank(path))
    assert (finding.position, finding.severity) == (4, "error")
    assert finding.message.startswith("position 4 is damaged")


def test_a_flipped_byte_in_the_ledger_then_is_an_error_at_its_position(tmp_path: Path) -> None:
    path = measured(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r") as file:
        offset = file["durability/ledger"].id.get_offset()
    flip(path, offset + 3 * 4096 + 1000)
    findings = check_bank(path)
    assert {(finding.position, finding.severity) for finding in findings} == {(3, "error")}


@pytest.mark.parametrize("name", ["status", "quality/peak_v", "quality/attempts"])
def test_a_figure_that_differs_from_the_ledger_then_is_an_error_and_opening_heals_it(tmp_path: Path, name: str) -> None:
    path = measured(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r") as file:
        dataset = file[name]
        offset = dataset.id.get_offset() + 2 * dataset.id.get_type().get_size() * int(np.prod(dataset.shape[1:]))
    flip(path, offset)
    finding = only(check_bank(path))
    assert (finding.position, finding.severity) == (2, "error")
    assert "differ from the ledger" in finding.message
    BankWriter.open(path).close()
    assert check_bank(path) == []


def test_a_torn_journal_then_is_an_error_and_opening_clears_it(tmp_path: Path) -> None:
    path = measured(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r") as file:
        offset = file["durability/journal"].id.get_offset()
    flip(path, offset + 5000)
    assert only(check_bank(path)).severity == "error"
    BankWriter.open(path).close()
    assert check_bank(path) == []


def test_a_response_longer_than_the_taps_then_is_a_warning(tmp_path: Path) -> None:
    green = responses()
    green[1] *= np.exp(np.arange(TAPS) / 18)
    finding = only(check_bank(measured(tmp_path / "bank.h5", green)))
    assert (finding.position, finding.severity) == (1, "warning")
    assert "longer than the taps" in finding.message


def test_a_dead_actuator_then_is_a_warning(tmp_path: Path) -> None:
    green = responses()
    green[:, 2] *= 1e-3
    finding = only(check_bank(measured(tmp_path / "bank.h5", green)))
    assert (finding.position, finding.actuator) == (None, 2)


def test_a_position_out_of_all_proportion_then_is_a_warning(tmp_path: Path) -> None:
    green = responses()
    green[5] *= 50
    finding = only(check_bank(measured(tmp_path / "bank.h5", green)))
    assert (finding.position, finding.severity) == (5, "warning")
    assert "from the median" in finding.message


def test_a_valid_position_of_zeros_then_is_an_error(tmp_path: Path) -> None:
    green = responses()
    green[0] = 0
    finding = only(check_bank(measured(tmp_path / "bank.h5", green)))
    assert (finding.position, finding.severity) == (0, "error")


def test_two_positions_at_one_place_then_are_a_warning(tmp_path: Path) -> None:
    grid = np.stack([np.arange(POSITIONS) * 4.0, np.zeros(POSITIONS)], axis=1)
    grid[4] = grid[1]
    finding = only(check_bank(measured(tmp_path / "bank.h5", responses(), grid)))
    assert finding.position == 4
    assert "like position 1" in finding.message


def test_a_foreign_bank_with_values_that_are_not_finite_then_is_an_error(tmp_path: Path) -> None:
    green = responses()
    green[3, 1, 7] = np.nan
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file.attrs["sample_rate_hz"] = 10_000.0
        file["green"] = green
        file["position_mm"] = np.arange(2.0 * POSITIONS).reshape(-1, 2)
    finding = only(check_bank(tmp_path / "foreign.h5"))
    assert (finding.position, finding.severity) == (3, "error")
    assert "actuator 1" in finding.message


def test_a_check_during_a_run_then_has_no_findings(tmp_path: Path) -> None:
    path = measured(tmp_path / "bank.h5", responses()[:3])
    with BankWriter.open(path) as writer:
        figures = np.ones(ACTUATORS, np.float32)
        writer.commit(3, responses()[3], PointRecord(1, 1, figures, figures, figures, figures))
        assert check_bank(path) == []


def test_a_file_that_is_no_bank_then_is_refused(tmp_path: Path) -> None:
    (tmp_path / "bank.h5").write_text("not a bank")
    with pytest.raises(InputError, match="is not an HDF5 file"):
        check_bank(tmp_path / "bank.h5")


@pytest.mark.parametrize("change", ["zeroed", "flipped"])
def test_a_damaged_ledger_page_then_is_found_by_every_reader_and_measured_again(tmp_path: Path, change: str) -> None:
    path = measured(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r") as file:
        offset = file["durability/ledger"].id.get_offset() + 3 * 4096
    if change == "zeroed":
        with path.open("r+b") as raw:
            raw.seek(offset)
            raw.write(bytes(4096))
    else:
        flip(path, offset + 500)
    assert {(one.position, one.severity) for one in check_bank(path)} == {(3, "error")}
    with open_bank(path) as bank:
        assert np.flatnonzero(bank.broken).tolist() == [3]
        assert bank.verify() == (3,)
        bank.require_sound([0, 1, 2])
        with pytest.raises(InputError, match="position 3 is damaged"):
            bank.require_sound()
        with pytest.raises(InputError, match="position 3 is damaged"):
            bank.green(3)
    with BankWriter.open(path) as writer:
        assert writer.status[3] == 0


@pytest.mark.parametrize("name", ["position", "actuator", "axis", "time_s", "position_mm", "actuator_mm"])
def test_a_changed_value_that_no_resume_rewrites_then_is_found(tmp_path: Path, name: str) -> None:
    path = measured(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r+") as file:
        file[name][...] = ["x", "z"] if name == "axis" else 7
    with pytest.raises(InputError):
        check_bank(path)


def test_a_changed_unit_of_a_dataset_then_is_found(tmp_path: Path) -> None:
    path = measured(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r+") as file:
        file["quality/peak_v"].attrs["units"] = "mV"
    with pytest.raises(InputError, match="checksum of its contents"):
        check_bank(path)


def test_values_at_a_position_that_is_not_measured_then_are_an_error(tmp_path: Path) -> None:
    path = measured(tmp_path / "bank.h5", responses()[:2])
    with h5py.File(path, "r") as file:
        offset = file["green"].id.get_chunk_info(4).byte_offset
    flip(path, offset + 9)
    finding = only(check_bank(path))
    assert (finding.position, finding.severity) == (4, "error")


def test_a_bank_without_a_checksum_of_its_contents_then_is_read_and_checked_as_before(tmp_path: Path) -> None:
    path = measured(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r+") as file:
        del file.attrs["contents_sha256"]
    assert check_bank(path) == []


def test_a_row_that_its_neighbours_contradict_then_is_an_error_that_names_the_difference(tmp_path: Path) -> None:
    axis_mm = 4.0 * np.arange(-4, 5)
    grid = np.stack(np.meshgrid(axis_mm, axis_mm), axis=-1).reshape(-1, 2)
    plate = plate_bank(grid)
    create_bank(
        tmp_path / "bank.h5",
        BankHeader(RATE_HZ, TAPS_OF_PLATE, BAND_HZ, grid, ACTUATOR_MM, "{}", "{}", "ab" * 32, "test"),
    )
    figures = np.ones(len(ACTUATOR_MM), np.float32)
    with BankWriter.open(tmp_path / "bank.h5") as writer:
        for position in range(len(grid)):
            row = np.array(plate.green(position), np.float32)
            if position == 40:
                row[2] *= -0.5
            writer.commit(position, row, PointRecord(1, 1, figures, figures, figures, figures))
    errors = [one for one in check_bank(tmp_path / "bank.h5") if one.severity == "error"]
    assert [(one.position, one.actuator) for one in errors] == [(40, 2)]
    assert "polarity" in errors[0].message
    assert run(["check", str(tmp_path / "bank.h5")]) == 1
