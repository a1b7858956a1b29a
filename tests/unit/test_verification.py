"""Scans of a virtual rig and comparisons whose outcome is known."""

import dataclasses
import math
from functools import cache

import numpy as np
import pytest

from tests.unit.line_verification import scan_of
from wavefocus.acquisition.setup import Setup
from wavefocus.calibration.known_signal import ReferenceMissingError
from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.drivers.errors import InstrumentLostError
from wavefocus.mocks.virtual.rig import RigFault, VirtualRig, VirtualSettings
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.rendering.verify.extra_measurements import linearity as linearity_of
from wavefocus.rendering.verify.extra_measurements import linearity_rows, quieter
from wavefocus.rendering.verify.scan import Scan, ScanPlan, scan
from wavefocus.rendering.verify.verdict import Tolerances, compare
from wavefocus.storage.drive_file import Drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import Field, LowPass

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


def setup_of(rig):
    settings = rig.settings
    return Setup(
        instruments=rig.instruments,
        mirror_map=MirrorMap.straight(1000.0),
        actuator_channels=settings.channel_of_actuator,
        loopback_channel=settings.channel_of_loopback,
        range_v=(10.0, 10.0),
        response_per_volt=settings.sensitivity_m_s_per_v,
        inter_channel_delay_s=settings.inter_channel_delay_s,
    )


def scanned(plan, *faults, **changes):
    rig = VirtualRig(dataclasses.replace(SETTINGS, fault_plan=faults, **changes))
    return scan(plan, setup_of(rig), impulse_drive(), bank())


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
    found = scanned(ScanPlan(AROUND), clock_ppm=45.0, inter_channel_delay_s=3e-5)
    outcome = compared(found)
    assert np.array_equal(found.position_index, AROUND)
    assert found.field.shape == (9, 2 * TAPS - 1)
    assert np.all(found.status == 1)
    assert found.clock_ratio == pytest.approx(1.000045, abs=1e-6)
    assert found.noise_rms == pytest.approx(SETTINGS.noise_v * SETTINGS.sensitivity_m_s_per_v, rel=0.5)
    assert outcome.fields.error < 0.005
    assert outcome.noise_error is not None
    assert outcome.misfit is not None
    assert outcome.misfit < 2.0 * outcome.noise_error
    assert abs(outcome.fields.delay_samples) < 1e-3
    assert outcome.passed


@pytest.mark.parametrize(
    ("fault", "attempts"),
    [
        (RigFault("player", "wait", "underflow", position=49, count=2), 3),
        (RigFault("recorder", "read", "missing_reference", position=49), 2),
        (RigFault("recorder", "read", "dropout", position=49, purpose="scan"), 2),
    ],
    ids=["underflow", "missing reference", "dropout"],
)
def test_a_fault_that_passes_then_the_position_is_repeated_and_the_scan_complete(fault, attempts):
    found = scanned(ScanPlan((48, 49, 50)), fault)
    assert found.attempts.tolist() == [1, attempts, 1]
    assert found.status.tolist() == [1, 1, 1]
    assert compared(found).fields.error < 0.005


def test_a_drive_with_noise_beyond_the_band_then_a_dropout_is_found_all_the_same():
    # As banks measured with noise give: their Green's functions, reversed, are the drives.
    drive = impulse_drive()
    noise_v = 0.02 * np.random.default_rng(2).standard_normal(drive.drive_v.shape)
    fault = RigFault("recorder", "read", "dropout", position=49, purpose="scan")
    rig = VirtualRig(dataclasses.replace(SETTINGS, fault_plan=(fault,)))
    noisy = dataclasses.replace(drive, drive_v=drive.drive_v + noise_v)
    found = scan(ScanPlan((48, 49, 50)), setup_of(rig), noisy, bank())
    assert found.attempts.tolist() == [1, 2, 1]


@pytest.mark.parametrize(
    ("kind", "status", "attempts", "reason"),
    [
        ("short_read", 8, 3, "the scan failed"),
        ("over_range", 2, 2, "the scan reached the end of the input range"),
        ("dropout", 4, 3, "the vibrometer lost the signal in the scan"),
    ],
)
def test_given_a_fault_that_stays_then_the_position_is_marked_and_left_out(kind, status, attempts, reason):
    fault = RigFault("recorder", "read", kind, position=49, purpose="scan", count=9)
    progress: list[tuple[int, int]] = []
    rig = VirtualRig(dataclasses.replace(SETTINGS, fault_plan=(fault,)))
    plan = ScanPlan((50, 49, 48))
    found = scan(plan, setup_of(rig), impulse_drive(), bank(), on_progress=lambda *at: progress.append(at))
    assert found.status.tolist() == [1, status, 1]
    assert found.attempts[1] == attempts
    assert progress == [(1, 3), (2, 3), (3, 3)]
    assert [row for row, _ in found.faults] == ([49] if status == 8 else [])
    assert found.as_field().position_index.tolist() == ([48, 49, 50] if status == 2 else [48, 50])
    outcome = compared(found)
    assert outcome.fields.excluded == ((49, reason),)
    assert not outcome.passed  # too few positions are usable


def test_a_lost_recorder_or_a_reference_that_never_comes_then_the_scan_gives_up():
    with pytest.raises(InstrumentLostError, match="recorder"):
        scanned(ScanPlan((48, 49)), RigFault("recorder", "read", "lost", position=49))
    faults = [RigFault("recorder", "read", "missing_reference", position=row, count=9) for row in range(9)]
    with pytest.raises(ReferenceMissingError):
        scanned(ScanPlan(tuple(range(9)), attempts=1), *faults)


def test_given_a_drive_beyond_full_scale_then_nothing_is_played():
    rig = VirtualRig(SETTINGS)
    loud = dataclasses.replace(impulse_drive(), drive_v=20.0 * impulse_drive().drive_v)
    with pytest.raises(InputError, match="at most 5 V, the player's full scale"):
        scan(ScanPlan((3,)), setup_of(rig), loud, bank())
    few = dataclasses.replace(impulse_drive(), drive_v=impulse_drive().drive_v[:4])
    with pytest.raises(InputError, match="4 actuators; the rig has 6"):
        scan(ScanPlan((3,)), setup_of(rig), few, bank())


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


def test_a_louder_or_later_scan_then_level_and_delay_are_found_and_the_verdict_is_no():
    late = compared(np.roll(prediction().field, 3, axis=1))
    assert late.fields.delay_samples == pytest.approx(3.0, abs=0.01)
    assert late.noise_error is None
    assert not late.passed
    louder = compared(1.12 * prediction().field)
    assert louder.fields.level_db == pytest.approx(20.0 * math.log10(1.12), abs=1e-3)
    assert louder.fields.error == pytest.approx(0.12 / 1.12, rel=1e-3)


def test_given_an_impulse_then_the_focus_is_at_its_path_point_at_its_sample():
    outcome = compared(prediction().field)
    (instant,) = outcome.fields.instant
    assert (instant.sample, instant.row) == (0, CENTRE)
    assert outcome.focus.from_intended_mm[0] < 1.0
    assert outcome.focus.from_prediction_mm[0] == 0.0
    assert 5.0 < outcome.focus.scanned_width_mm[0] < 16.0
    assert outcome.fields.error == 0.0
    assert all(check.passed for check in outcome.checks)


def test_given_a_focus_shifted_by_two_positions_then_its_check_fails():
    rows = np.arange(len(GRID_MM)).reshape(11, 11)
    moved = prediction().field[np.roll(rows, 2, axis=1).ravel()]
    outcome = compared(moved)
    failed = {check.name for check in outcome.checks if check.passed is False}
    assert {"focus to path point", "focus to predicted focus"} <= failed
    assert outcome.focus.from_intended_mm[0] == pytest.approx(8.0, abs=1.0)


def test_given_a_few_positions_then_errors_are_judged_and_the_focus_is_not():
    few = Field(prediction().field[[0, 60, 90]], np.array([0, 60, 90]), RATE_HZ, prediction().start_s, "m/s")
    outcome = compared(prediction().field, of=few)
    passed = {check.name: check.passed for check in outcome.checks}
    assert passed["normalised error"] is True
    assert passed["focus to path point"] is None
    assert passed["focal width against prediction"] is None
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
    strict = compared(field, source=doubtful, tolerances=Tolerances(usable_share=0.99))
    assert not strict.passed


def test_fields_of_different_drives_or_nothing_in_common_then_the_message_says_so():
    later = as_scan(prediction().field, start_s=0.0)
    with pytest.raises(InputError, match="start_s of the prediction"):
        compared(later)
    failed = as_scan(prediction().field, status=np.full(len(GRID_MM), 8, np.uint8))
    with pytest.raises(InputError, match="no position in common"):
        compared(failed)
    low = dataclasses.replace(prediction(), low_pass=LowPass(100.0, 4))
    with pytest.raises(InputError, match="4 times lower than the bank's, low-passed above 100 Hz"):
        compared(prediction().field, of=low)


def test_given_a_surface_that_compresses_then_the_linearity_says_by_how_much():
    drive, plan = impulse_drive(), ScanPlan(linearity_rows(impulse_drive(), np.array(AROUND)), purpose="linearity")
    assert plan.position == AROUND
    setup = setup_of(VirtualRig(dataclasses.replace(SETTINGS, cubic_per_v2=-0.3)))
    loud, quiet = scan(plan, setup, drive, bank()), scan(plan, setup, quieter(drive), bank())
    (linearity, compression), _ = linearity_of(prediction(), loud, quiet, bank().band_hz, 0.001)
    scans = [scanned_at(plan, one) for one in (drive, quieter(drive))]
    sound, _ = linearity_of(prediction(), *scans, bank().band_hz, 0.01)
    assert linearity.passed is False
    assert compression.value > 0.02
    assert sound[0].passed is True
    assert abs(sound[1].value) < 0.01


def scanned_at(plan, drive):
    return scan(plan, setup_of(VirtualRig(SETTINGS)), drive, bank())
