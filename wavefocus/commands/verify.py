"""``wavefocus verify``: play a scene, scan it, compare with the prediction, report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from acquisition.durations import hours
from acquisition.grid import stadium_rim
from acquisition.quality import median_snr_db
from acquisition.sentinel import DriftLimits
from calibration.bank import Bank, open_bank
from calibration.drive_file import write_drive
from calibration.errors import InputError
from calibration.field_file import write_field
from rendering.field import predict as predict_field
from rendering.metrics import grid_spacing_mm
from rendering.report import build_report
from rendering.scan import ScanPlan, scan
from rendering.verification import Check, Tolerances, compare
from wavefocus.campaign_view import CampaignView
from wavefocus.commands.render import rendered
from wavefocus.compose import bank_configuration, open_setup
from wavefocus.config.loading import Configuration, load_rig
from wavefocus.config.rig import RigConfig, default_rig
from wavefocus.config.scene import load_scene
from wavefocus.console import progress, say
from wavefocus.drift_history import read_drift
from wavefocus.exits import Exit
from wavefocus.positions import parse_positions
from wavefocus.rig_limits import check_drive

# Enough for an outline that looks round on any screen.
OUTLINE_POINTS = 400


def verify(scene_file: Path, bank: Path, rig_file: Path, out: Path, positions: str, *, as_json: bool) -> Exit:
    """Check the focusing of a scene against a new scan; exit code 1 when it is not good enough."""
    scene = load_scene(scene_file)
    with open_bank(bank) as view:
        configuration = bank_configuration(view)
        rig = _checked_rig(rig_file, configuration, view)
        rows = parse_positions(positions, view.positions) if positions else None
        out.mkdir(parents=True, exist_ok=True)
        drive, facts = rendered(scene_file, scene, view)
        for warning in facts.warnings:
            say(f"warning: {warning}")
        check_drive(drive, rig.player, str(scene_file), "set output.limit_v or output.limit_rms_v in the scene")
        write_drive(out / "drive.h5", drive)
        with progress("predict", view.positions) as report:
            prediction = predict_field(drive, view, rows, dtype=np.float32, on_progress=report)
        write_field(out / "prediction.h5", prediction)
        with open_setup(rig, configuration.run) as setup, progress("scan", len(prediction.field)) as report:
            started_s = setup.instruments.clock.now_s()
            plan = ScanPlan(tuple(int(row) for row in prediction.position_index))
            measured = scan(plan, setup, drive, view, on_progress=report, publish=CampaignView(report))
            scan_s = setup.instruments.clock.now_s() - started_s
        write_field(out / "scan.h5", measured.as_field())
        with progress("compare and report", 2) as report:
            verification = compare(prediction, measured, drive, view, _tolerances(configuration, view))
            report(1, 2)
            report_file = build_report(
                out,
                verification=verification,
                scene=scene,
                drive=drive,
                prediction=prediction,
                scan=measured,
                bank=view,
                campaign=_facts(configuration, view, scan_s),
                outline_mm=stadium_rim(rig.surface.length_mm, rig.surface.width_mm, 0.0, OUTLINE_POINTS),
                drift=read_drift(bank),
                drift_limits=DriftLimits(**configuration.run.drift.model_dump()),
                save_pictures=True,
            )
            report(2, 2)
    for check in verification.checks:
        say(_line(check))
    say(f"report: {report_file}")
    if as_json:
        print(json.dumps({"report": str(report_file), **verification.as_dict()}))
    return Exit.DONE if verification.passed else Exit.NOT_GOOD_ENOUGH


def _tolerances(configuration: Configuration, bank: Bank) -> Tolerances:
    """The limits of the run; the distance allowed to a focus is in millimetres there."""
    limits = configuration.run.tolerance
    return Tolerances(
        normalised_error=limits.normalised_error,
        correlation=limits.correlation,
        focus_offset_spacings=limits.focus_error_mm / grid_spacing_mm(bank.position_mm),
    )


def _facts(configuration: Configuration, bank: Bank, scan_s: float) -> dict[str, object]:
    """What the report says of the campaign and the scan."""
    run = configuration.run
    sweep, capture = run.sweep, run.capture
    facts: dict[str, object] = {
        "Bank": str(bank.path),
        "Positions measured": f"{np.count_nonzero(bank.status)} of {bank.positions}",
        "Excitation": (
            f"{capture.averages} linear sweeps of {sweep.duration_s:g} s, {sweep.start_hz:g}-{sweep.stop_hz:g} Hz, "
            f"{sweep.amplitude_v:g} V, each followed by {capture.decay_s:g} s"
        ),
        "Rig": configuration.rig.rig.name,
        "Scan": f"{hours(scan_s)} on the rig's clock",
        "Plan": str(bank.plan_sha256),
    }
    if (snr_db := median_snr_db(bank.quality.get("snr_db"), bank.status)) is not None:
        facts["Signal-to-noise ratio"] = f"{snr_db:.1f} dB, median over all pairs"
    return facts


def _line(check: Check) -> str:
    """One check for people."""
    if check.value is None:
        return f"-     {check.name}: the positions it needs were not scanned"
    word = "pass" if check.passed else "FAIL"
    return f"{word}  {check.name}: {check.value:.4g} {check.unit} ({check.relation} {check.limit:.4g})"


def _checked_rig(rig_file: Path, configuration: Configuration, bank: Bank) -> RigConfig:
    """The rig that shall play, refused when it is wired to other actuators than the bank's."""
    rig = default_rig() if str(rig_file) == "virtual" else load_rig(rig_file)
    if rig.actuators.position_mm != configuration.rig.actuators.position_mm:
        raise InputError(
            f"{rig_file}: actuators.position_mm are not those of {bank.path}; verify plays the bank's drives, so the "
            "rig must have the bank's actuators in the bank's order"
        )
    return rig
