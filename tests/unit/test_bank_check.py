"""What a check of a bank finds."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from calibration.bank_check import Finding, check_bank
from calibration.bank_creation import create_bank
from calibration.bank_header import BankHeader
from calibration.bank_ledger import PointRecord
from calibration.bank_writer import BankWriter
from calibration.errors import InputError

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
def test_a_figure_that_differs_from_the_ledger_then_is_a_warning_and_opening_heals_it(
    tmp_path: Path, name: str
) -> None:
    path = measured(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r") as file:
        dataset = file[name]
        offset = dataset.id.get_offset() + 2 * dataset.id.get_type().get_size() * int(np.prod(dataset.shape[1:]))
    flip(path, offset)
    finding = only(check_bank(path))
    assert (finding.position, finding.severity) == (2, "warning")
    assert "differ from the ledger" in finding.message
    BankWriter.open(path).close()
    assert check_bank(path) == []


def test_a_journal_left_by_a_crash_then_is_a_warning(tmp_path: Path) -> None:
    path = measured(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r") as file:
        offset = file["durability/journal"].id.get_offset()
    flip(path, offset + 5000)
    assert "a replacement was cut off" in only(check_bank(path)).message
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
