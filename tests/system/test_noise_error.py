"""The error that white noise leaves in the rows, as it is stated, against the virtual plate's truth."""

import json
from dataclasses import replace

import numpy as np
import pytest

from wavefocus.__main__ import run
from wavefocus.calibration.check import check_bank
from wavefocus.calibration.estimator.noise_error import bank_noise_error_db
from wavefocus.campaign.blueprint import bank_configuration
from wavefocus.commands.demo import compare_with_truth
from wavefocus.config.run import Virtual
from wavefocus.rig.virtual_bench import virtual_rig
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter

STAGGERED = 'taps = 1000\nexcitation = "staggered"\nstagger_s = 0.15'


@pytest.mark.parametrize(
    ("before", "after"),
    [
        ("taps = 1000", "taps = 1000"),
        ("decay_s = 0.1", "decay_s = 0.6"),
        ("duration_s = 0.3", "duration_s = 0.6\nstop_hz = 200.0"),
        ("taps = 1000", STAGGERED),
    ],
    ids=["short periods", "long silence", "narrow band", "staggered"],
)
def test_given_white_noise_then_the_error_of_the_rows_is_stated_within_1_db(lab, capsys, before, after):
    file, bank = lab / "run.toml", lab / "plate.h5"
    text = file.read_text(encoding="utf-8").replace("noise_v = 1e-4", "noise_v = 1e-3")
    file.write_text(text.replace(before, after), encoding="utf-8")
    assert run(["capture", str(file), "--bank", str(bank)]) in (0, 1)
    with open_bank(bank) as view:
        configuration = bank_configuration(view)
        truth_db = compare_with_truth(view, virtual_rig(configuration.rig, configuration.run.virtual or Virtual()))
        stated_db = bank_noise_error_db(view)
        assert stated_db is not None
        median_db = float(np.median(stated_db))
        assert float(np.median(truth_db - stated_db)) == pytest.approx(0.0, abs=1.0)
        # The ratio itself would not do.
        assert float(np.median(truth_db + view.quality["snr_db"])) < -3.0
    capsys.readouterr()
    assert run(["status", str(bank), "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["median_noise_error_db"] == pytest.approx(median_db)
    assert any(f"{median_db:.1f} dB" in found.message for found in check_bank(bank) if found.severity == "note")


def test_rows_that_noise_hides_then_they_are_counted_and_worst_is_one_that_is_heard(bank):
    with open_bank(bank) as view:
        plan = view.plan_sha256
    with BankWriter.open(bank, plan_sha256=plan) as writer:
        record = writer.record(2)
        snr_db = np.array([10.0, -230.0, 40.0], np.float32)
        writer.commit(2, writer.green(2), replace(record, snr_db=snr_db))
    (note,) = [found.message for found in check_bank(bank) if "white noise" in found.message]
    assert "in the worst (position 2, actuator 0)" in note
    assert "it hides: 1 (the first: position 2, actuator 1)" in note
