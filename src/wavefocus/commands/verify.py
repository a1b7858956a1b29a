"""``wavefocus verify``: a scene played, scanned and compared with its prediction."""

import hashlib
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from wavefocus.acquisition.leak import BAND_HZ, measure_leak
from wavefocus.acquisition.setup import Setup
from wavefocus.acquisition.wording import hours
from wavefocus.calibration.crosstalk import UNKNOWN_ROWS_SHARE, Crosstalk, leak_limit
from wavefocus.campaign.blueprint import bank_configuration, blueprint_of
from wavefocus.campaign.sidecar_files import VerifyLog, read_drift
from wavefocus.campaign.status import CampaignView
from wavefocus.config.messages.campaign import Event, Subscriber
from wavefocus.config.rig import RigConfig
from wavefocus.configuration import Configuration, named_rig, plan_sha256, with_rig
from wavefocus.console import Exit, Report, progress, say
from wavefocus.drivers.errors import TransientInstrumentError
from wavefocus.drives import naming
from wavefocus.ending import ended_by_file, ending_at_once
from wavefocus.input_files import input_files, require_sound, scan_rows
from wavefocus.rendering.arrays import Float64Array, Int64Array
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.prediction import predict as predict_field
from wavefocus.rendering.number_text import percent
from wavefocus.rendering.report.page import build_report
from wavefocus.rendering.report.render_report import RenderReport
from wavefocus.rendering.scene.model import Scene, load_scene
from wavefocus.rendering.verify import correction as corrected
from wavefocus.rendering.verify import record as files
from wavefocus.rendering.verify.extra_measurements import drift_sentence, linearity_rows, measure_sentinel, quieter
from wavefocus.rendering.verify.mirror_error import sentinel_shift_mm
from wavefocus.rendering.verify.results import Correction, Sentinel, remedy, sentence
from wavefocus.rendering.verify.scan import Scan, marker_v, scan
from wavefocus.rendering.verify.verdict import Verification, compare
from wavefocus.rig.limits import check_drive, stricter
from wavefocus.rig.setup import open_setup
from wavefocus.rig.unattended import AliveSignal, kept_awake
from wavefocus.storage.bank.ledger import median_of_pairs, usable
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.drive_file import Drive, write_drive
from wavefocus.storage.errors import InputError
from wavefocus.storage.field_file import Field, write_field
from wavefocus.storage.output_files import require_output_folder, staged_folder
from wavefocus.storage.scan_journal import ScanJournal, identity_of
from wavefocus.storage.units import quantity

# Enough for an outline that looks round on any screen.
OUTLINE_POINTS = 400
_IN_JSON = ("passed", "summary", "figures", "excluded", "symptoms", "actuators", "drift", "correction")


def verify(
    scene_file: Path,
    bank: Path,
    rig_file: Path,
    out: Path,
    positions: str,
    *,
    linearity: bool = False,
    corrections: int = 0,
    force: bool = False,
    as_json: bool,
) -> Exit:
    """Check the focusing of a scene against a new scan; exit code 1 when it is not good enough.

    With `linearity` the scene is also played 12 dB quieter at some positions; with `corrections` the drive is corrected
    by further scans, so many at most, of the scene's foci and quiet places.
    The bank's sentinel position is measured again first; its drift is stated.

    A scan that was interrupted goes on where it was.

    A file ``verify.stop`` in the folder ends it as Ctrl-C does: outputs muted, mirror parked, exit code 130.
    """
    results = (files.RECORD_NAME, files.REPORT_NAME, *files.FIELD_NAMES, files.CORRECTED_NAME, *files.PICTURE_NAMES)
    journals = files.JOURNAL_NAME, files.QUIET_JOURNAL_NAME
    may_exist: tuple[str, ...] = (files.LOG_NAME, files.STOP_NAME, *journals)
    # Without a record, results beside a journal are of a verification that ended while it published them.
    published = () if (out / journals[0]).exists() and not (out / files.RECORD_NAME).exists() else results
    inputs = input_files(scene_file, bank, rig_file)
    require_output_folder(
        out, published, inputs, force=force, may_exist=may_exist if published else may_exist + results
    )
    scene = load_scene(scene_file)
    with open_bank(bank) as view:
        require_sound(view)
        configuration, rig = bank_configuration(view), named_rig(rig_file)
        if rig.actuators.position_mm != configuration.rig.actuators.position_mm:
            raise InputError(
                f"{rig_file}: actuators.position_mm are not those of {bank}; verify plays the bank's drives, so the "
                "rig must have the bank's actuators in the bank's order"
            )
        rows = scan_rows(positions, scene, view.position_mm, scene_file, view.check)
        out.mkdir(parents=True, exist_ok=True)
        with (
            AliveSignal(rig.messages),
            kept_awake(f"verifying {scene_file.name}"),
            ending_at_once(),
            ended_by_file(out / files.STOP_NAME),
            VerifyLog(out / files.LOG_NAME) as log,
        ):
            with staged_folder(out, files.RECORD_NAME, results) as staged:
                work = _Work(scene_file, scene, view, configuration, rig, log)
                names = {"scene_file": str(scene_file), "bank": str(bank), "rig": str(rig_file)}
                verification, record = work.run(
                    rows, staged, out, names, linearity=linearity, corrections=corrections, force=force
                )
            for name in journals:
                (out / name).unlink(missing_ok=True)
            code = Exit.DONE if verification.passed else Exit.NOT_GOOD_ENOUGH
            log.done(code, verification.summary)
    for line in _lines(verification):
        say(line)
    say(f"report: {out / files.REPORT_NAME}")
    if as_json:
        named = {"report": str(out / files.REPORT_NAME), "record": str(out / files.RECORD_NAME)}
        print(json.dumps({**named, **{key: record[key] for key in _IN_JSON}}))
    return code


@dataclass(frozen=True, slots=True)
class _Work:
    """One verification: rendered, predicted, scanned, compared and reported."""

    scene_file: Path
    scene: Scene
    bank: Bank
    configuration: Configuration
    rig: RigConfig
    log: VerifyLog

    def run(
        self,
        rows: list[int] | None,
        out: Path,
        journals: Path,
        names: dict[str, str],
        *,
        linearity: bool,
        corrections: int,
        force: bool,
    ) -> tuple[Verification, dict[str, Any]]:
        """Carry out all steps and write all files; `journals` is where an interrupted scan is kept.

        Returns what was found, and the content of ``verify.json``.
        """
        bank, limits = self.bank, self.configuration.run.tolerance
        with self._step("render", 1) as report, naming(self.scene_file, bank):
            report(0, 1, "preparing the scene: its interpolation and quiet places")
            begun = self._begun(journals / files.JOURNAL_NAME, report)
            drive, facts = begun or render_with_report(self.scene, bank, report)
            report(1, 1)
        for warning in facts.warnings:
            say(f"warning: {warning}")
        advice = "set output.limit_v or output.limit_rms_v in the scene"
        check_drive(drive, self.rig.player, str(self.scene_file), advice)
        control = self._control(drive, rows, correct=corrections > 0)
        write_drive(out / files.DRIVE_NAME, drive)
        with self._step("predict", bank.positions if rows is None else len(rows)) as report:
            prediction = predict_field(drive, bank, rows, dtype=np.float32, on_progress=report)
        write_field(out / files.PREDICTION_NAME, prediction)
        softer, quiet, correction = quieter(drive), None, None
        with (
            self._journal(drive, journals / files.JOURNAL_NAME, force=force) as kept,
            self._journal(softer, journals / files.QUIET_JOURNAL_NAME, force=force)
            if linearity
            else nullcontext() as softer_kept,
            open_setup(self.rig, self.configuration.run) as setup,
        ):
            sentinel, started_s = self._sentinel(setup), setup.clock.now_s()
            measured = self._scan(setup, drive, prediction.position_index.tolist(), journal=kept)
            if linearity:
                some = linearity_rows(drive, measured.position_index)
                quiet = self._scan(setup, softer, some, "linearity", softer_kept)
            if corrections:
                best, correction = self._corrected(setup, drive, measured, control, sentinel, corrections)
                write_drive(out / files.CORRECTED_NAME, best)
            scan_s = setup.clock.now_s() - started_s
            leak = self._leak(setup, prediction)
            marker: Float64Array | None = marker_v(setup, measured.field.shape[1], drive.sample_rate_hz)
        write_field(out / files.SCAN_NAME, measured.as_field())
        with self._step("compare and report", 2) as report:
            drift_limits, errors = self.configuration.run.drift, facts.interpolation_errors
            between = None if errors is None else errors.overall
            verification = compare(
                prediction, measured, drive, bank, limits, quiet=quiet, sentinel=sentinel, leak=leak,
                drift_limits=drift_limits, marker_v=marker, interpolation_error=between,
            )  # fmt: skip
            verification = replace(verification, correction=correction)
            report(1, 2)
            outline_mm = self.rig.surface.outline.line(OUTLINE_POINTS)
            build_report(
                out, verification=verification, scene=self.scene, drive=drive, prediction=prediction, scan=measured,
                bank=bank, campaign=_facts(self.configuration, bank, scan_s), outline_mm=outline_mm,
                drift=read_drift(bank.path), drift_limits=drift_limits,
            )  # fmt: skip
            record = files.write_record(
                out, verification=verification, scene=self.scene, prediction=prediction, bank=bank, names=names,
                outline_mm=outline_mm,
            )  # fmt: skip
            report(2, 2)
        return verification, record

    def _begun(self, journal: Path, report: Report) -> tuple[Drive, RenderReport] | None:
        """The drive of an interrupted scan of an earlier version, which took "nearest" where a scene names nothing."""
        begun, earlier = identity_of(journal), self.scene.of_earlier_versions
        if begun is None or earlier is None:
            return None
        rendered = render_with_report(earlier, self.bank, report)
        return rendered if self._identity(rendered[0]) == begun else None

    def _identity(self, drive: Drive) -> str:
        what = plan_sha256(self.rig, self.configuration.run, self.configuration.position_mm)
        return hashlib.sha256(what.encode() + np.ascontiguousarray(drive.drive_v, "<f8").tobytes()).hexdigest()

    def _control(self, drive: Drive, rows: list[int] | None, *, correct: bool) -> Int64Array:
        """Bank rows of the control places of a correction, none without one.

        Raises InputError: nothing that is scanned could be compared or corrected; so far nothing has played.
        """
        bank, sound = self.bank, usable(self.bank.status)
        scanned = np.flatnonzero(np.asarray(bank.status)) if rows is None else np.asarray(rows, np.int64)
        if not np.any(sound[scanned]):
            raise InputError(f"{bank.path}: none of the positions to scan is valid, so none could be compared")
        if not correct:
            return scanned[:0]
        control = corrected.control_rows(drive, np.asarray(bank.position_mm, np.float64))
        control = control[sound[control]]
        with naming(self.scene_file, bank):
            corrected.require_correctable(drive, bank, control)
        if control.size < corrected.MIN_CONTROLS:
            say(f"{control.size} control places: none is held out, so one correction is made at most")
        return control

    def _corrected(
        self, setup: Setup, drive: Drive, measured: Scan, rows: Int64Array, sentinel: Sentinel | None, corrections: int
    ) -> tuple[Drive, Correction]:
        """Correct the drive by scans of the control places, and keep the best; not where the mirror is off."""
        bank = self.bank
        shift_mm = None if sentinel is None else sentinel_shift_mm(sentinel, bank)
        if sentinel is None:
            say("warning: no sentinel position was measured, so that a mirror that is off would not show here")
        if shift_mm is not None:
            say("warning: the sentinel position shows the field ({:+.2g}, {:+.2g}) mm further".format(*shift_mm))
            return drive, Correction((), None, "mirror")
        return corrected.correct_drive(
            drive, bank, rows, lambda played: self._scan(setup, played, rows.tolist(), "correction"), corrections,
            limits=stricter(self.scene.output, self.rig.player),
            first=measured if np.isin(rows, measured.position_index).all() else None,
        )  # fmt: skip

    def _leak(self, setup: Setup, prediction: Field) -> Crosstalk | None:
        """The leak of the loopback into the response input now, where it makes 1 % of the median row; else None."""
        bank, place_mm = self.bank, self.bank.position_mm[int(prediction.position_index[0])]
        try:
            with self._step("crosstalk", 1) as report:
                band = () if bank.band_hz is None else (bank.band_hz,)
                found = measure_leak(setup, place_mm.tolist(), self.rig.safe_amplitude_v, bank.sample_rate_hz, *band)
                report(1, 1)
        except TransientInstrumentError as failure:
            say(f"warning: crosstalk is not measured: {failure}")
            return None
        rms, per_volt = bank.rms[usable(bank.status)], setup.response_per_volt
        limit = leak_limit(rms, bank.taps, bank.sample_rate_hz, band[0] if band else BAND_HZ, per_volt)
        return found if found.reaches(limit or UNKNOWN_ROWS_SHARE) else None

    def _scan(
        self, setup: Setup, drive: Drive, rows: Sequence[int], purpose: str = "scan", journal: ScanJournal | None = None
    ) -> Scan:
        with self._step(purpose, len(rows)) as report:
            publish = self._publisher(report)
            return scan(
                rows, setup, drive, self.bank, purpose=purpose, on_progress=report, publish=publish, journal=journal
            )

    @contextmanager
    def _journal(self, drive: Drive, path: Path, *, force: bool) -> Iterator[ScanJournal]:
        """The positions that were scanned before an interruption of this same scan, and are from now on."""
        samples = drive.drive_v.shape[1] + self.bank.taps - 1
        with ScanJournal(path, self._identity(drive), samples, replace=force) as journal:
            if len(journal):
                say(f"the interrupted scan goes on; positions scanned before: {len(journal)}, kept in {path}")
            try:
                yield journal
            except BaseException:
                if len(journal):
                    say(f"positions scanned so far: {len(journal)}, kept in {path}; the same command goes on with them")
                raise

    def _sentinel(self, setup: Setup) -> Sentinel | None:
        """Measure the bank's sentinel position again, where this rig can play the sweeps of the bank's run."""
        try:
            plan = blueprint_of(with_rig(self.configuration, self.rig, "the rig")).plan
        except InputError as refused:
            say(f"warning: the sentinel position is not measured: {refused}")
            return None
        with self._step("sentinel", 1) as report:
            sentinel = measure_sentinel(plan, setup, self.bank, self._publisher(report))
            report(1, 1)
        if isinstance(sentinel, str):
            because = f": {sentinel}" if sentinel else ""
            say(f"warning: the bank has no sentinel position that gives a usable record{because}; drift is not stated")
            return None
        return sentinel

    def _publisher(self, report: Report) -> Subscriber:
        view = CampaignView(report)

        def publish(event: Event) -> None:
            view(event)
            self.log(event)

        return publish

    @contextmanager
    def _step(self, name: str, total: int) -> Iterator[Report]:
        """Report how far a step is, to people and in the log."""
        logged = self.log.step(name, total)
        with progress(name, total) as people:

            def report(done: int, total: int, note: str = "") -> None:
                people(done, total, note)
                logged(done, total)

            yield report


def _facts(configuration: Configuration, bank: Bank, scan_s: float) -> dict[str, object]:
    sweep, capture = configuration.run.sweep, configuration.run.capture
    facts: dict[str, object] = {
        "Bank": str(bank.path),
        "Positions measured": f"{np.count_nonzero(bank.status)} of {bank.positions}",
        "Excitation": (
            f"{capture.averages} x {sweep.duration_s:g} s, {sweep.waveform}, {sweep.start_hz:g}-{sweep.stop_hz:g} Hz, "
            f"{sweep.amplitude_v:g} V, each followed by {capture.decay_s:g} s"
        ),
        "Rig": configuration.rig.rig.name,
        "Scan": f"{hours(scan_s)} on the rig's clock",
        "Plan": str(bank.plan_sha256),
    }
    if (snr_db := median_of_pairs(bank.quality.get("snr_db"), bank.status)) is not None:
        facts["Signal-to-noise ratio"] = f"{snr_db:.1f} dB, median over all pairs"
    return facts


def _lines(verification: Verification) -> Iterator[str]:
    """The verification for people."""
    for symptom in verification.symptoms:
        yield f"{sentence(symptom)} {remedy(symptom)}"
    for check in verification.checks:
        if check.value is None:
            yield f"-     {check.name}: the positions it needs were not scanned"
        else:
            value, word = quantity(f"{check.value:.4g}", check.unit), "pass" if check.passed else "FAIL"
            yield f"{word}  {check.name}: {value} ({check.relation} {check.limit:.4g})"
    if (noise := verification.noise_error) is not None:
        parts = [percent(one) for one in (verification.fields.error, noise, verification.misfit)]
        yield "error {}: noise {}, model {}".format(*parts)
    if verification.drift is not None:
        yield drift_sentence(verification.drift)
    if verification.correction is not None:
        yield from corrected.correction_lines(verification.correction)
