"""Scans of a virtual rig and comparisons whose outcome is known."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest

from tests.lab_files import rig_fault, setup_of
from tests.unit.line_verification import scan_of
from wavefocus import Drive, GreenArray, InputError, predict
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.rendering.verify.extra_measurements import linearity as linearity_of
from wavefocus.rendering.verify.extra_measurements import linearity_rows, quieter
from wavefocus.rendering.verify.scan import Scan, scan
from wavefocus.rendering.verify.verdict import compare
from wavefocus.storage.field_file import LowPass

RATE_HZ = 10_000.0
TAPS = 600
SPACING_MM = 4.0
AXIS_MM = np.arange(-20.0, 20.1, SPACING_MM)
GRID_MM = np.stack(np.meshgrid(AXIS_MM, AXIS_MM), axis=-1).reshape(-1, 2)
CENTRE = 60
AROUND = (48, 49, 50, 59, 60, 61, 70, 71, 72)
SETTINGS = VirtualSettings(
    actuator_mm=((-60.0, 0.0), (60.0, 10.0), (0.0, 60.0), (5.0, -60.0), (45.0, 45.0), (-45.0, -40.0)),
    dropout_probability=0.0,
)


@cache
def bank():
    rig = VirtualRig(SETTINGS)
    green = np.stack([rig.truth(x, y, TAPS) for x, y in GRID_MM])
    return GreenArray(green, GRID_MM, RATE_HZ, band_hz=(20.0, 500.0))


@cache
def impulse_drive():
    """Time-reversed Green's functions of the centre: an impulse source at rest there."""
    reversed_v = bank().green(CENTRE)[:, ::-1]
    one = np.ones(1, np.int64)
    drive_v, start_s = reversed_v / np.abs(reversed_v).max(), -(TAPS - 1) / RATE_HZ
    return Drive(drive_v, RATE_HZ, start_s, "sampled", 1.0, 0.0, 0 * one, CENTRE * one, 0 * one)


def scanned(rows, *faults, drive=None, attempts=3, **changes):
    rig = VirtualRig(dataclasses.replace(SETTINGS, fault_plan=faults, **changes))
    setup = setup_of(rig, inter_channel_delay_s=rig.settings.inter_channel_delay_s)
    return scan(rows, setup, drive or impulse_drive(), bank(), attempts=attempts)


def as_scan(field, noise_rms=math.nan, **changes):
    return dataclasses.replace(scan_of(field, impulse_drive().start_s, RATE_HZ, noise_rms), **changes)


@cache
def prediction():
    return predict(impulse_drive(), bank())


def compared(found, *, of=None, **options):
    """The comparison of a scan, or of a field as if it were scanned, with the prediction."""
    measured = found if isinstance(found, Scan) else as_scan(found)
    return compare(of or prediction(), measured, impulse_drive(), options.pop("source", bank()), **options)


def test_an_honest_rig_then_the_scan_agrees_with_the_prediction_but_for_its_noise():
    found = scanned(AROUND, clock_ppm=45.0, inter_channel_delay_s=3e-5)
    outcome = compared(found)
    assert np.array_equal(found.position_index, AROUND)
    assert found.field.shape == (9, 2 * TAPS - 1)
    assert np.all(found.status == 1)
    assert found.clock_ratio == pytest.approx(1.000045, abs=1e-6)
    assert found.noise_rms == pytest.approx(SETTINGS.noise_v * SETTINGS.sensitivity_m_s_per_v, rel=0.5)
    assert outcome.fields.error < 0.005
    assert outcome.misfit < 2.0 * outcome.noise_error
    assert abs(outcome.fields.delay_samples) < 1e-3
    assert outcome.passed


@pytest.mark.parametrize(
    ("fault", "status", "attempts", "reason"),
    [
        (rig_fault("player", "wait", "underflow", position=49, count=2), 1, 3, None),
        (rig_fault("recorder", "read", "missing_reference", position=49), 1, 2, None),
        (rig_fault("recorder", "read", "dropout", position=49, purpose="scan"), 1, 2, None),
        (rig_fault("recorder", "read", "short_read", position=49, count=9), 8, 3, "the scan failed"),
        (rig_fault("recorder", "read", "over_range", position=49, count=9), 2, 2, "end of the input range"),
        (rig_fault("recorder", "read", "dropout", position=49, count=9), 4, 3, "the vibrometer lost the signal"),
    ],
)
def test_a_fault_that_passes_is_repeated_and_one_that_stays_left_out(fault, status, attempts, reason):
    found = scanned((48, 49, 50), fault)
    assert found.status.tolist() == [1, status, 1]
    assert found.attempts.tolist() == [1, attempts, 1]
    outcome = compared(found)
    if status == 1:
        assert outcome.fields.error < 0.005
        return
    # A record that reached the end of the range, though not compared, is kept.
    assert found.as_field().position_index.tolist() == ([48, 49, 50] if status == 2 else [48, 50])
    ((row, why),) = outcome.fields.excluded
    assert (row, reason in why) == (49, True)
    assert not outcome.passed  # too few positions are usable


def test_a_drive_with_noise_beyond_the_band_then_a_dropout_is_found_all_the_same():
    # As banks measured with noise give: their Green's functions, reversed, are the drives.
    drive_v = impulse_drive().drive_v
    drive_v = drive_v + 0.02 * np.random.default_rng(2).standard_normal(drive_v.shape)
    fault = rig_fault("recorder", "read", "dropout", position=49, purpose="scan")
    found = scanned((48, 49, 50), fault, drive=dataclasses.replace(impulse_drive(), drive_v=drive_v))
    assert found.attempts.tolist() == [1, 2, 1]


def test_a_reference_that_never_comes_then_the_scan_gives_up():
    faults = [rig_fault("recorder", "read", "missing_reference", position=row, count=9) for row in range(9)]
    with pytest.raises(ReferenceMissingError):
        scanned(range(9), *faults, attempts=1)


def test_white_noise_of_known_level_is_error_and_noise_and_leaves_no_misfit():
    field = prediction().field
    rms = 0.02 * float(np.sqrt(np.mean(field**2)))
    noisy = field + rms * np.random.default_rng(5).standard_normal(field.shape)
    outcome = compared(as_scan(noisy, rms))
    assert outcome.fields.error_all_frequencies == pytest.approx(0.02, rel=0.02)
    # 480 of 5000 Hz, and the soft edges.
    assert 0.1 < (outcome.fields.error / 0.02) ** 2 < 0.13
    assert outcome.noise_error == pytest.approx(outcome.fields.error, rel=0.02)
    assert outcome.passed


@pytest.mark.long
def test_a_louder_or_later_scan_then_level_and_delay_are_found_and_the_verdict_is_no():
    late = compared(np.roll(prediction().field, 3, axis=1))
    assert late.fields.delay_samples == pytest.approx(3.0, abs=0.01)
    assert late.noise_error is None
    assert not late.passed
    louder = compared(1.12 * prediction().field)
    assert louder.fields.level_db == pytest.approx(20.0 * math.log10(1.12), abs=1e-3)
    assert louder.fields.error == pytest.approx(0.12 / 1.12, rel=1e-3)


def test_the_focus_of_an_impulse_is_at_its_path_point_and_a_shifted_one_fails():
    outcome = compared(prediction().field)
    (instant,) = outcome.fields.instant
    assert (instant.sample, instant.row) == (0, CENTRE)
    assert outcome.focus.from_intended_mm[0] < 1.0
    assert outcome.focus.from_prediction_mm[0] == 0.0
    assert 5.0 < outcome.focus.scanned_width_mm[0] < 16.0
    assert outcome.fields.error == 0.0
    assert all(check.passed for check in outcome.checks)
    rows = np.arange(len(GRID_MM)).reshape(11, 11)
    shifted = compared(prediction().field[np.roll(rows, 2, axis=1).ravel()])
    failed = {check.name for check in shifted.checks if check.passed is False}
    assert {"focus to path point", "focus to predicted focus"} <= failed
    assert shifted.focus.from_intended_mm[0] == pytest.approx(8.0, abs=1.0)


def test_a_coarse_grid_then_half_a_cell_s_diagonal_is_allowed_to_the_focus():
    rows = np.append(np.flatnonzero((np.rint((GRID_MM + 20.0) / SPACING_MM) % 3 == 0).all(axis=1)), range(1, 121, 11))
    check = np.arange(len(rows)) >= len(rows) - 11
    source = GreenArray(bank().values[rows], GRID_MM[rows], RATE_HZ, band_hz=bank().band_hz, check=check)
    between, reversed_v = 71, bank().green(71)[:, ::-1]
    at = int(np.argmin(np.hypot(*(GRID_MM[rows[~check]] - GRID_MM[between]).T)))
    drive = dataclasses.replace(
        impulse_drive(), drive_v=reversed_v, focus_position=np.array([at]), focus_mm=GRID_MM[[between]]
    )
    there = predict(drive, source)
    outcome = compare(there, as_scan(there.field), drive, source)
    (focus,) = (one for one in outcome.checks if one.name == "focus to path point")
    assert outcome.spacing_mm == 3 * SPACING_MM
    assert focus.limit == pytest.approx(3 * SPACING_MM / math.sqrt(2))
    assert 4.0 < focus.value < focus.limit
    assert outcome.passed


def test_rows_that_are_not_valid_in_the_bank_then_they_are_left_out_and_counted():
    status = np.ones(len(GRID_MM), np.uint8)
    status[[7, 9]] = 4, 2
    doubtful = dataclasses.replace(bank(), status=status)
    field = prediction().field.copy()
    field[[7, 9]] = 100.0
    outcome = compared(field, source=doubtful)
    assert [row for row, _ in outcome.fields.excluded] == [7, 9]
    assert outcome.fields.error == 0.0
    assert outcome.passed
    status[:6] = 4
    assert not compared(field, source=dataclasses.replace(bank(), status=status)).passed


def test_fields_that_cannot_be_compared_are_refused():
    failed = np.full(len(GRID_MM), 8, np.uint8)
    for changes, low_pass, message in (
        ({"start_s": 0.0}, None, "start_s of the prediction"),
        ({"status": failed}, None, "no position in common"),
        ({}, LowPass(100.0, 4), "4 times lower than the bank's, low-passed above 100 Hz"),
    ):
        of = dataclasses.replace(prediction(), low_pass=low_pass)
        with pytest.raises(InputError, match=message):
            compared(as_scan(prediction().field, **changes), of=of)


def test_a_surface_that_compresses_then_the_linearity_says_by_how_much():
    drive = impulse_drive()
    rows = linearity_rows(drive, np.array(AROUND))
    assert rows == AROUND

    def judged(noise, **changes):
        scans = [scanned(rows, drive=one, **changes) for one in (drive, quieter(drive))]
        return linearity_of(prediction(), *scans, bank().band_hz, noise)[0]

    (linearity, compression), sound = judged(0.001, cubic_per_v2=-0.3), judged(0.01)
    assert linearity.passed is False
    assert compression.value > 0.02
    assert sound[0].passed is True
    assert abs(sound[1].value) < 0.01
