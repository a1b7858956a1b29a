"""Banks from raw recordings that an independent script wrote, against the limit that the noise itself sets."""

from __future__ import annotations

from dataclasses import replace

import h5py
import numpy as np
import pytest

from tests.system.raw_script import RATE_HZ, Script, sweep
from wavefocus.__main__ import run
from wavefocus.estimation import estimate

SEQUENTIAL = Script(
    base=sweep(0.8),
    slots=[[(0, 0.0, 1.0)], [(1, 0.0, 0.5)], [(2, 0.0, 1.0)]],
    samples=round(1.0 * RATE_HZ),
)
STAGGERED = Script(
    base=sweep(0.8),
    slots=[[(actuator, 0.2 * actuator, 1.0) for actuator in range(4)]],
    samples=round(1.7 * RATE_HZ),
    period_s=0.8,
    seed=2,
)


@pytest.mark.parametrize("counts", [False, True], ids=["float", "int16"])
@pytest.mark.parametrize("script", [SEQUENTIAL, STAGGERED], ids=["sequential", "staggered"])
def test_raw_recordings_by_another_program_then_bank_is_within_1_5_db_of_noise(tmp_path, script, counts):
    raw, bank = script.write(tmp_path / "a.raw.h5", counts=counts), tmp_path / "bank.h5"
    assert run(["estimate", str(raw), "--bank", str(bank)]) == 0
    with h5py.File(bank) as file:
        green = file["green"][:].astype(np.float64)
    assert np.median(script.error_db(green) - script.limit_db()) <= 1.5


def test_given_one_worker_or_two_then_the_bank_is_the_same_to_the_byte(tmp_path):
    raw = SEQUENTIAL.write(tmp_path / "a.raw.h5")
    for workers in (1, 2):
        estimate(raw, tmp_path / f"{workers}.h5", workers=workers).close()
    assert (tmp_path / "1.h5").read_bytes() == (tmp_path / "2.h5").read_bytes()


def test_given_a_file_that_is_no_recording_then_exit_2_and_one_line(tmp_path, capsys):
    (tmp_path / "a.raw.h5").write_bytes(b"nothing of the kind")
    assert run(["estimate", str(tmp_path / "a.raw.h5"), "--bank", str(tmp_path / "bank.h5")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
    assert not (tmp_path / "bank.h5").exists()


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_reference_of_another_gain_by_another_program_then_rows_are_valid_all_same(tmp_path, gain):
    script = replace(SEQUENTIAL, reference_gain=gain, snr_db=60.0)
    raw, bank = script.write(tmp_path / "a.raw.h5"), tmp_path / "bank.h5"
    assert run(["estimate", str(raw), "--bank", str(bank)]) == 0
    with h5py.File(bank) as file:
        assert file["status"][:].tolist() == [1, 1]


def test_a_recording_with_a_fainter_reference_makes_its_position_poor(tmp_path):
    raw, bank = replace(SEQUENTIAL, snr_db=60.0).write(tmp_path / "a.raw.h5"), tmp_path / "bank.h5"
    with h5py.File(raw, "r+") as file:
        file["reference"][1, 2] = file["reference"][1, 2] * 10 ** (-0.3 / 20)
    assert run(["estimate", str(raw), "--bank", str(bank)]) == 0
    with h5py.File(bank) as file:
        assert file["status"][:].tolist() == [1, 4]
