"""What a check of a bank finds."""

import h5py
import numpy as np
import pytest

from tests.lab_files import attribute, flip, record_of, with_check_rows, within, write_bank
from tests.unit.plate_banks import ACTUATOR_MM, BAND_HZ, RATE_HZ, plate_greens
from wavefocus import InputError, open_bank
from wavefocus.calibration.check import check_bank
from wavefocus.storage.bank.ledger import Status
from wavefocus.storage.bank.writer import BankWriter

POSITIONS, ACTUATORS, TAPS = 6, 3, 200


def responses():
    """Responses that have died away by the last tenth of the taps."""
    noise = np.random.default_rng(0).normal(size=(POSITIONS, ACTUATORS, TAPS))
    return (noise * np.exp(-np.arange(TAPS) / 15)).astype(np.float32)


def flip_in(path, dataset, byte, chunk=None):
    """Flip one bit of a dataset, or of one chunk of it, so many bytes from its beginning."""
    with h5py.File(path, "r") as file:
        kept = file[dataset].id
        offset = kept.get_offset() if chunk is None else kept.get_chunk_info(chunk).byte_offset
    flip(path, offset + byte)


@pytest.mark.parametrize(
    ("measured_rows", "damage", "position", "heals"),
    [
        (POSITIONS, ("green", 9, 4), 4, False),
        (2, ("green", 9, 4), 4, False),  # not measured
        (POSITIONS, ("durability/ledger", 3 * 4096 + 1000), 3, False),
        (POSITIONS, ("durability/journal", 5000), None, True),
        (POSITIONS, ("status", 2), 2, True),
        (POSITIONS, ("quality/peak_v", 2 * 4 * ACTUATORS), 2, True),
        (POSITIONS, ("quality/attempts", 2 * 4), 2, True),
    ],
)
def test_a_flipped_bit_is_an_error_at_its_position_and_opening_heals_figures(
    tmp_path, measured_rows, damage, position, heals
):
    path = write_bank(tmp_path / "bank.h5", responses(), rows=range(measured_rows))
    flip_in(path, *damage)
    found = check_bank(path)
    assert {(finding.position, finding.severity) for finding in found} == {(position, "error")}
    assert position != 2 or "differ from the ledger" in found[0].message
    if heals:
        BankWriter.open(path).close()
        assert check_bank(path) == []


@pytest.mark.parametrize(
    ("rows", "factor", "position", "severity", "words"),
    [
        (np.s_[1], np.exp(np.arange(TAPS) / 18), 1, "warning", "longer than the taps"),
        (np.s_[:, 2], 1e-3, None, "warning", "actuator 2"),
        (np.s_[5], 50.0, 5, "warning", "from the median"),
        (np.s_[0], 0.0, 0, "error", "only zeros"),
    ],
    ids=["a long response", "a dead actuator", "out of all proportion", "zeros"],
)
def test_responses_that_cannot_be_then_are_named(tmp_path, rows, factor, position, severity, words):
    green = responses()
    green[rows] *= factor
    (finding,) = check_bank(write_bank(tmp_path / "bank.h5", green))
    assert (finding.position, finding.severity) == (position, severity)
    assert finding.actuator == (2 if position is None else None)
    assert words in finding.message


def test_positions_over_range_poor_or_failed_or_at_one_place_are_named(tmp_path):
    grid = np.stack([np.arange(POSITIONS) * 4.0, np.zeros(POSITIONS)], axis=1)
    grid[5] = grid[0]
    path = write_bank(tmp_path / "bank.h5", responses(), grid)
    with BankWriter.open(path) as writer:
        for position, status in ((1, Status.POOR_SIGNAL), (2, Status.FAILED), (4, Status.OVER_RANGE | Status.VALID)):
            writer.amend(position, status=int(status))
    found = {one.position: (one.severity, one.message) for one in check_bank(path)}
    assert {position: severity for position, (severity, _) in found.items()} == {1: "warning", 5: "warning"}
    assert "positions 1-2,4 are over range, poor or failed" in found[1][1]
    assert "like position 0" in found[5][1]


def test_a_check_during_a_run_or_without_the_checksum_of_contents_has_no_findings(tmp_path):
    path = write_bank(tmp_path / "bank.h5", responses(), rows=range(3))
    with h5py.File(path, "r+") as file:  # as of an earlier version
        del file.attrs["contents_sha256"]
    assert check_bank(path) == []
    with BankWriter.open(path) as writer:
        writer.commit(3, responses()[3], record_of(3, actuators=ACTUATORS))
        assert check_bank(path) == []


def test_a_zeroed_ledger_page_then_is_found_by_every_reader_and_measured_again(tmp_path):
    path = write_bank(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r") as file:
        offset = file["durability/ledger"].id.get_offset() + 3 * 4096
    with path.open("r+b") as raw:
        raw.seek(offset)
        raw.write(bytes(4096))
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


@pytest.mark.parametrize(
    "change",
    [
        within("axis", ["x", "z"]), within("time_s", 7), within("position_mm", 7),
        attribute("units", "mV", of="quality/peak_v"),
    ],
)  # fmt: skip
def test_a_changed_value_or_unit_that_no_resume_rewrites_then_is_found(tmp_path, change):
    path = write_bank(tmp_path / "bank.h5", responses())
    with h5py.File(path, "r+") as file:
        change(file)
    with pytest.raises(InputError):
        check_bank(path)


@pytest.mark.long
def test_a_row_that_its_neighbours_contradict_is_named_unless_it_is_off_the_grid(tmp_path):
    axis_mm = 4.0 * np.arange(-3, 4)
    grid = np.stack(np.meshgrid(axis_mm, axis_mm), axis=-1).reshape(-1, 2)
    green = plate_greens(grid)[:, :3]
    green[24, 2] *= -0.5
    path = tmp_path / "bank.h5"
    write_bank(path, green, grid, actuator_mm=ACTUATOR_MM[:3], rate_hz=RATE_HZ, band_hz=BAND_HZ)
    errors = [one for one in check_bank(path) if one.severity == "error"]
    assert [(one.position, one.actuator) for one in errors] == [(24, 2)]
    assert "polarity" in errors[0].message
    # A row that only judges what is interpolated is no neighbour and has none (coarse: test_wrong_positions.py).
    apart = with_check_rows(path, tmp_path / "apart.h5", 24)
    assert [one for one in check_bank(apart) if one.severity == "error"] == []
