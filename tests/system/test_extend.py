"""Banks with more positions: what is taken over, what is measured, and what is refused."""

import h5py
import numpy as np
import pytest

from tests.lab_files import POSITIONS, change_text, with_check_rows, write_positions, write_rows
from tests.system.captures import answered, held, refused, told_by, wavefocus
from wavefocus.campaign.blueprint import blueprint_of
from wavefocus.campaign.extension import extend
from wavefocus.configuration import load_run
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter

MORE = [[12.0, 0.0], *POSITIONS[:4], [12.0, 4.0]]


def _scale_rows(bank, rows, factor):
    """The same bank as if the first rows had been measured with another gain."""
    with open_bank(bank) as view:
        plan = view.plan_sha256
    with BankWriter.open(bank, plan_sha256=plan) as writer:
        for row in range(rows):
            writer.commit(row, writer.green(row) * np.float32(factor), writer.record(row))


def _extend(lab, bank, new="new.h5"):
    """The command that makes a new bank of another and of the lab's run."""
    return ["extend", bank, "--run", lab / "run.toml", "--bank", lab / new]


def test_more_positions_then_measured_rows_are_taken_over_and_the_others_measured(lab, bank, capsys):
    assert wavefocus("note", bank, "gel of Monday") == 0
    write_positions(lab, MORE)
    told = told_by(capsys, *_extend(lab, bank))
    assert {event["position"] for event in told.of("position_committed")} == {0, 5}
    assert "resume" in {event["occasion"] for event in told.of("drift")}
    with open_bank(bank) as old, open_bank(lab / "new.h5") as new:
        assert new.status.tolist() == [1] * 8
        assert new.verify() == ()
        assert new.position_mm.tolist() == [*MORE, *POSITIONS[4:]]
        for row, place in enumerate(new.position_mm.tolist()):
            if place in POSITIONS:
                was = POSITIONS.index(place)
                assert np.array_equal(new.green(row), old.green(was))
                assert new.quality["attempts"][row] == old.quality["attempts"][was]
        assert [note.text for note in new.notes] == ["gel of Monday"]
    (origin,) = answered(capsys, "status", lab / "new.h5")["origins"]
    assert (origin["bank"], origin["rows"]) == ("plate.h5", "1-4,6-7")
    assert wavefocus("check", lab / "new.h5") == 0
    # Extended again, the rows keep the name of the bank that measured them.
    write_positions(lab, [*MORE, [16.0, 0.0]])
    assert wavefocus(*_extend(lab, lab / "new.h5", new="newer.h5")) == 0
    origins = {one["bank"]: one["rows"] for one in answered(capsys, "status", lab / "newer.h5")["origins"]}
    assert origins == {"plate.h5": "1-4,7-8", "new.h5": "0,5"}


def test_given_a_changed_plate_then_nothing_is_added_and_what_is_there_stays(lab, bank, capsys):
    refused(capsys, *_extend(lab, bank, new="plate.h5"))
    write_positions(lab, MORE)
    _scale_rows(bank, len(POSITIONS), 2.0)
    assert "sentinel" in told_by(capsys, *_extend(lab, bank), code=3).err
    assert held(lab / "new.h5") == [0, 1, 1, 1, 1, 0, 1, 1]
    before = bank.read_bytes(), (lab / "new.h5").read_bytes()
    refused(capsys, *_extend(lab, bank))
    assert before == (bank.read_bytes(), (lab / "new.h5").read_bytes())


@pytest.mark.parametrize(
    ("old", "new", "named"),
    [
        ("averages = 2", "averages = 3", "capture.averages"),
        ("taps = 1000", "taps = 900", "capture.taps"),
        ("duration_s = 0.3", "duration_s = 0.4", "sweep.duration_s"),
        ("[virtual]\nseed = 3", "[virtual]\nseed = 4", "seed"),
        ("", "", "position 2"),
    ],
    ids=["averages", "taps", "duration", "another plate", "a damaged row"],
)
def test_given_another_kind_of_rows_or_a_damaged_one_then_it_is_refused(lab, bank, capsys, old, new, named):
    if old:
        change_text(lab / "run.toml", old, new)
    else:
        with h5py.File(bank, "r+") as file:
            file["green"][2, 0, 5] += 1
        write_positions(lab, MORE)
    assert named in refused(capsys, *_extend(lab, bank))
    assert not (lab / "new.h5").exists()


def test_given_check_positions_then_they_stay_such_unless_the_new_grid_has_them(lab, bank):
    coarse = with_check_rows(bank, lab / "coarse.h5", 4, 5)
    write_positions(lab, POSITIONS[:4])
    assert wavefocus(*_extend(lab, coarse, new="same.h5")) == 0
    write_positions(lab, [*MORE, POSITIONS[4]])
    assert wavefocus(*_extend(lab, coarse)) == 0
    for name, checks in (("same.h5", [POSITIONS[4], POSITIONS[5]]), ("new.h5", [POSITIONS[5]])):
        with open_bank(lab / name) as new:
            assert new.position_mm[new.check].tolist() == checks


@pytest.mark.parametrize("begun_with", [0, 12])
def test_a_bank_with_the_check_positions_of_an_earlier_version_then_it_is_extended(tmp_path, begun_with):
    assert wavefocus("init", tmp_path / "lab") == 0
    run_file, old = tmp_path / "lab" / "run.toml", tmp_path / "old.h5"
    change_text(run_file, "spacing_mm = 4.0", "spacing_mm = 24.0")
    now = run_file.read_text(encoding="utf-8")
    change_text(run_file, "# check_positions = 24", f"check_positions = {begun_with} #")
    header = blueprint_of(load_run(run_file)).bank_header()
    write_rows(old, header, np.ones((header.positions, header.actuators, header.taps)))
    run_file.write_text(now, encoding="utf-8")
    extend(old, tmp_path / "new.h5", run_file)
    with open_bank(tmp_path / "new.h5") as new:
        assert np.count_nonzero(new.status) == header.positions
        assert np.count_nonzero(new.check) >= 24


def test_given_kept_recordings_then_they_are_taken_over_too(lab, capsys):
    change_text(lab / "run.toml", "taps = 1000", "taps = 1000\nkeep_raw = true")
    bank = lab / "plate.h5"
    write_positions(lab, POSITIONS[:2])
    assert wavefocus("capture", lab / "run.toml", "--bank", bank) == 0
    write_positions(lab, POSITIONS[:3])
    assert wavefocus(*_extend(lab, bank)) == 0
    estimated = lab / "estimated.h5"
    assert wavefocus("estimate", lab / "new.raw.h5", "--bank", estimated) == 0
    with open_bank(lab / "new.h5") as new, open_bank(estimated) as again:
        for row in range(3):
            assert np.allclose(again.green(row), new.green(row), atol=1e-6 * np.abs(new.green(row)).max())
    # Ended between its two files: the recordings are whole, the bank is not there yet.
    (lab / "new.h5").unlink()
    assert wavefocus(*_extend(lab, bank)) == 0
    assert held(lab / "new.h5") == [1] * 3
    assert f"wavefocus resume {lab / 'new.h5'}" in refused(capsys, *_extend(lab, bank))
    (lab / "plate.raw.h5").unlink()
    refused(capsys, *_extend(lab, bank, new="newer.h5"))
