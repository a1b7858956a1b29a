"""The report of a verification, one self-contained HTML file: verdict, pictures, figures, remarks with advice."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.config.messages.campaign import Drift
from wavefocus.config.run import DriftLimits
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.field import metrics
from wavefocus.rendering.field.foci import FOCUS_RADIUS_MM, median_or_none
from wavefocus.rendering.greens.regularisation import focus_gain_map
from wavefocus.rendering.number_text import number, percent, precise
from wavefocus.rendering.report import figures as report_figures
from wavefocus.rendering.report.canvas import Picture, ReportSurface, html_page
from wavefocus.rendering.report.figures import drift_over_time
from wavefocus.rendering.report.waves import FigureLine, wave_figures, waves_of, waves_picture
from wavefocus.rendering.scene.trajectory import TrajectoryPath
from wavefocus.rendering.verify.correction import correction_lines
from wavefocus.rendering.verify.extra_measurements import drift_sentence
from wavefocus.rendering.verify.record import PATH_POINTS, REPORT_NAME, path_line_mm
from wavefocus.rendering.verify.results import remedy, sentence
from wavefocus.rendering.verify.scan import Scan
from wavefocus.rendering.verify.verdict import Verification
from wavefocus.storage.output_files import write_whole

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource
    from wavefocus.rendering.scene.model import Scene
    from wavefocus.rendering.verify.results import Figure
    from wavefocus.storage.drive_file import Drive
    from wavefocus.storage.field_file import Field


def build_report(
    out_dir: Path,
    *,
    verification: Verification,
    scene: Scene,
    drive: Drive,
    prediction: Field,
    scan: Scan,
    bank: GreenSource,
    campaign: Mapping[str, object],
    outline_mm: Float64Array | None = None,
    drift: Sequence[tuple[datetime, Drift]] = (),
    drift_limits: DriftLimits | None = None,
) -> Path:
    """Write ``report.html``: verdict, pictures, figures with definitions, what to do; the pictures as files, too.

    The report holds everything it shows: no network, scripts or fonts of others.

    Returns the report.
    """
    paths_mm = [path_line_mm(source, PATH_POINTS if source.path.length_mm > 0.0 else 1) for source in scene.sources]
    surface = ReportSurface.of(bank, paths_mm, outline_mm)
    gain = focus_gain_map(bank, scene.regularisation)
    pictures, captions = _pictures(surface, verification, drive, gain)
    if drift:
        pictures["drift"] = drift_over_time(drift, drift_limits or DriftLimits())
    waves = waves_of(scene, bank, verification.fields, surface.spacing_mm)
    pictures["waves"] = waves_picture(waves, verification.fields.band_hz)
    html = html_page(
        "report.html.jinja",
        scene_name=scene.name,
        verification=verification,
        remarks=remarks(verification, drive, scan),
        sentence=sentence,
        remedy=remedy,
        correction=verification.correction and correction_lines(verification.correction),
        pictures=pictures,
        figures=[
            *_figure_lines(verification, metrics.range_db(gain)),
            *wave_figures(waves, scene, verification.fields.band_hz),
        ],
        facts=_facts(scene, drive, prediction, scan, verification, campaign),
        **captions,
    )
    out_dir.mkdir(parents=True, exist_ok=True)
    for picture in pictures.values():
        if picture is not None:
            write_whole(out_dir / f"{picture.name}.png", picture.png)
    report = out_dir / REPORT_NAME
    write_whole(report, html)
    return report


def _pictures(
    surface: ReportSurface, verification: Verification, drive: Drive, gain: Float64Array
) -> tuple[dict[str, Picture | None], dict[str, str]]:
    fields = verification.fields
    every_row = np.arange(len(surface.position_mm))
    has_foci = len(fields.instant) > 0 and bool(np.any(fields.predicted_snapshot))
    chosen = evenly_spread(len(fields.instant), 6)
    with np.errstate(divide="ignore", invalid="ignore"):
        error_db = 20.0 * np.log10(fields.position_error)
        gain_db = 20.0 * np.log10(gain / np.nanmedian(gain))
    excluded = np.array([row for row, _ in fields.excluded], np.int64)
    pictures: dict[str, Picture | None] = {
        "path": report_figures.path_map(surface, fields) if has_foci else None,
        "snapshots": report_figures.snapshots(surface, fields, chosen) if has_foci else None,
        "waveforms": report_figures.waveforms(surface, fields) if len(fields.waveform_index) else None,
        "error": report_figures.value_map(
            "error",
            surface,
            fields.position_index,
            error_db,
            "normalised error (dB)",
            colours="cividis",
            crossed=excluded,
        ),
        "gain": report_figures.value_map("gain", surface, every_row, gain_db, "n(x) over its median (dB)"),
        "drive": report_figures.drive_levels(drive.drive_v),
    }
    captions = {
        "error_caption": "Normalised error at each position. It grows where the field is weak, because noise does not."
        + (f" Crosses: the {excluded.size} scanned position(s) that were not compared." if excluded.size else ""),
        "gain_caption": "Normalisation factor n(x) of equation 15: how much louder the drive must be for an equal"
        f" focus. Range {number(metrics.range_db(gain), 'dB')} (20 lg of largest over smallest).",
        "drive_caption": "Rms of each actuator's drive over its whole length, relative to the largest. "
        f"Peak {number(float(np.max(np.abs(drive.drive_v), initial=0.0)), drive.drive_unit)} at any actuator.",
    }
    return pictures, captions


def _facts(
    scene: Scene,
    drive: Drive,
    prediction: Field,
    scan: Scan,
    verification: Verification,
    campaign: Mapping[str, object],
) -> list[tuple[str, str]]:
    facts: list[tuple[str, str]] = [("scene", scene.name)]
    for index, source in enumerate(scene.sources, 1):
        motion = "at rest"
        if isinstance(source.path, TrajectoryPath):
            motion = f"{source.path.length_mm:.4g} mm long, {source.travel_s:.4g} s, {len(source.path.time_s)} rows"
        elif source.path.length_mm > 0.0:
            motion = (
                f"{source.path.length_mm:.4g} mm long, {source.speed_mm_s:g} mm/s, "
                f"a point every {source.step_mm:g} mm, {source.emission.replace('_', ' ')} emission"
            )
        text = (
            f"{type(source.path).__name__.lower()} {motion}; {type(source.signal).__name__.lower()}, "
            f"amplitude {source.amplitude:g}, from {source.start_s:g} s"
        )
        facts.append((f"source {index}", text))
    actuators, samples = drive.drive_v.shape
    facts += [
        ("drive", f"{drive.method}, {actuators} actuators, {samples / drive.sample_rate_hz:.3g} s"),
        ("foci", f"{len(drive.focus_sample):,}, of which {len(verification.fields.instant)} were compared"),
        ("positions predicted", f"{len(prediction.position_index):,}"),
        ("positions scanned", f"{len(scan.position_index):,}"),
        ("positions compared", f"{len(verification.fields.position_index):,}"),
    ]
    for name, value in campaign.items():
        facts.append((name, f"{value:.6g}" if isinstance(value, float) else str(value)))
    return facts


NOISE_SHARE = 0.7
"""Share of the error above which noise is named as its cause: half of the error's square."""

REMEDIES = {
    "the scan failed": "look at the instruments' messages and scan these positions again",
    "the scan reached the end of the input range": "set a wider response range or a lower limit_v",
    "the bank's row is not valid": 'run "wavefocus remeasure" on the bank',
}


def _figure_lines(verification: Verification, gain_range_db: float) -> list[FigureLine]:
    """The figures without a limit, with those that only the report has."""
    lines = [(figure.name, _value(figure), figure.definition) for figure in verification.figures if not figure.relation]
    gain_range = (
        "range of n(x)", number(gain_range_db, "dB"),
        "20 lg of largest over smallest normalisation factor (equation 15) over all measured positions, those next to"
        " the actuators included",
    )  # fmt: skip
    return [*lines, gain_range]


def _value(figure: Figure) -> str:
    if figure.unit == "%":
        return percent(None if figure.value is None else figure.value / 100.0)
    return number(figure.value, figure.unit) if figure.unit else precise(figure.value)


def remarks(verification: Verification, drive: Drive, scan: Scan) -> list[str]:
    """Notes and advice for the reader, most pressing first."""
    fields = verification.fields
    failed = {check.name for check in verification.checks if check.passed is False}
    not_judged = [check.name for check in verification.checks if check.passed is None]
    noise = verification.noise_error
    from_noise = noise is not None and noise > NOISE_SHARE * fields.error
    delay_us = 1e6 * abs(fields.delay_samples) / fields.sample_rate_hz
    gains = scan.playback_gain
    gain = float(np.nanmedian(gains)) if np.isfinite(gains).any() else 1.0
    artefact_db = median_or_none(verification.focus.scanned_artefact_db)
    excluded = Counter(reason for _, reason in fields.excluded).most_common()
    # Levels within 0.2 dB, delays within 0.1 samples and a loopback within 1 % get no remark.
    found: list[tuple[bool, str]] = [
        (
            "normalised error" in failed and from_noise,
            "Most of the error is the vibrometer's noise. Play louder (a larger limit_v or amplitude), focus the laser,"
            " or put retro-reflective tape on the surface; the bank itself may be sound.",
        ),
        (
            not verification.symptoms and abs(fields.level_db) > 0.2,
            f"The scan is {number(abs(fields.level_db), 'dB')} {'louder' if fields.level_db > 0 else 'quieter'} than"
            " predicted. Check that amplifier volume and vibrometer sensitivity are those of the campaign in which the"
            " bank was measured.",
        ),
        (
            not verification.symptoms and abs(fields.delay_samples) > 0.1,
            f"The scan comes {number(delay_us, chr(0xB5) + 's')} {'later' if fields.delay_samples > 0 else 'earlier'}"
            " than predicted. Check inter_channel_delay_s in the rig file and that the recorder's rate is that of the"
            " bank.",
        ),
        (verification.drift is not None, "" if verification.drift is None else drift_sentence(verification.drift)),
        (
            bool(failed & {"focus to path point", "focus to predicted focus"}),
            "The focus is not where it should be. If all foci are displaced alike, check the mirror map; if they"
            " scatter, the positions around them are noisy or the path leaves the measured grid.",
        ),
        *(
            (
                True,
                f"{count} scanned position(s) were not compared because {reason}:"
                f" {REMEDIES.get(reason, 'scan them again')}.",
            )
            for reason, count in excluded
        ),
        (
            bool(not_judged),
            f"Not judged: {', '.join(not_judged)}. The positions around the path points were not all scanned, or no"
            f" focal spot lies wholly within them; scan every position within {FOCUS_RADIUS_MM:g} mm of the path.",
        ),
        (
            abs(gain - 1.0) > 0.01,
            f"The loopback carried {number(gain)} times the requested voltage. Calibrate the player's full-scale"
            " voltage (full_scale_v) or reference_gain in the rig file.",
        ),
        (
            artefact_db is not None and artefact_db > 0.0,
            f"Beyond {FOCUS_RADIUS_MM:g} mm from the focus the surface moves more than in it (by"
            f" {number(artefact_db, 'dB')} at the median focus instant), mostly next to the actuators. Saturation in"
            " the scene's [regularisation] spreads the drive over more actuators.",
        ),
        (
            drive.scale < 1.0,
            f"The drive was scaled by {number(drive.scale)} to keep to its limits, and prediction and scan with it.",
        ),
        (
            drive.omitted_bound > 0.0,
            f"The renderer left out parts of the drive; the relative error is at most {percent(drive.omitted_bound)}.",
        ),
    ]
    return [text for applies, text in found if applies]
