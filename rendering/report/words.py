"""The report's words: figures with definitions, and remarks on what to do."""

from __future__ import annotations

import math
from collections import Counter
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from rendering.field.focus_figures import FOCUS_RADIUS_MM, median_or_none
from rendering.verify.scan import Scan

if TYPE_CHECKING:
    from rendering.verify.verdict import Verification
    from storage.drive_file import Drive
    from storage.field_file import Field

# Deviations below these are not worth a sentence.
NOTED_LEVEL_DB = 0.2
NOTED_DELAY_SAMPLES = 0.1
NOTED_GAIN = 0.01

REMEDIES = {
    "the scan failed": "look at the instruments' messages and scan these positions again",
    "the scan reached the end of the input range": "set a wider response range or a lower limit_v",
    "the bank's row is not valid": 'run "wavefocus remeasure" on the bank',
}


@dataclass(frozen=True, slots=True)
class Figure:
    """A line of the report's table of figures."""

    name: str
    value: str
    definition: str


def summary(verification: Verification) -> str:
    """The verdict in one or two sentences."""
    fields = verification.fields
    failed = [check.name for check in verification.checks if check.passed is False]
    text = (
        f"Scan and prediction differ by {number(100.0 * fields.error, '%')} and correlate at "
        f"{precise(fields.correlation)} over {len(fields.position_index):,} positions."
    )
    if failed:
        return f"{text} Beyond the limit: {', '.join(failed)}."
    if verification.noise_error is not None:
        noise = number(100.0 * verification.noise_error, "%")
        text += f" The vibrometer's noise alone makes a difference of {noise}."
    return text


def figures(verification: Verification, gain_range_db: float) -> list[Figure]:
    """Every figure of the report that has no limit, with its definition."""
    fields, focus = verification.fields, verification.focus
    band = "all frequencies" if fields.band_hz is None else f"{fields.band_hz[0]:g} to {fields.band_hz[1]:g} Hz"
    delay_us = 1e6 * fields.delay_samples / fields.sample_rate_hz
    radius = f"{FOCUS_RADIUS_MM:g} mm"
    return [
        Figure(
            "Normalised error",
            percent(fields.error),
            "Norm of (scan \N{MINUS SIGN} prediction) over norm of the scan, over all compared positions and "
            f"samples. Both fields are limited to the bank's band, {band}, with edges a quarter of an "
            f"octave wide.",
        ),
        Figure(
            "of which noise",
            percent(verification.noise_error),
            "What the vibrometer's noise alone makes of it: the rms of each record before anything plays, "
            "taken "
            "as white, over all samples and within the band, over the norm of the scan.",
        ),
        Figure(
            "of which misfit",
            percent(verification.misfit),
            "The rest, as the root of the difference of squares: errors of the bank (its own noise too), "
            "of gains "
            "and clocks, nonlinearity, and whatever changed since the bank was measured.",
        ),
        Figure(
            "Error, all frequencies",
            percent(fields.error_all_frequencies),
            "The normalised error of the fields as they stand in their files, noise outside the band included.",
        ),
        Figure(
            "Correlation",
            precise(fields.correlation),
            "Zero-lag correlation over all compared positions and samples.",
        ),
        Figure(
            "Correlation, median position",
            precise(fields.correlation_median),
            "Median over positions of the correlation at each.",
        ),
        Figure(
            "Level",
            number(fields.level_db, "dB"),
            "Gain that fits the prediction best to the scan; 0 dB when all gains are what they were.",
        ),
        Figure(
            "Delay",
            number(delay_us, "\N{MICRO SIGN}s"),
            "How much later the scan is: peak of the cross-correlation summed over positions.",
        ),
        Figure(
            "Focus to path point",
            number(median_or_none(focus.from_intended_mm), "mm"),
            f"Median over focus instants: distance from the path point to the largest |y| within {radius} "
            f"of it, "
            "refined between positions by a quadratic fit.",
        ),
        Figure(
            "Focal width, scan",
            number(median_or_none(focus.scanned_width_mm), "mm"),
            "Median over focus instants: diameter of the disk of equal area to the connected region around "
            "the "
            "peak where y has the peak's sign and exceeds half of it (field interpolated between positions).",
        ),
        Figure(
            "Focal width, prediction",
            number(median_or_none(focus.predicted_width_mm), "mm"),
            "The same of the predicted field.",
        ),
        Figure(
            "Artefact level",
            number(median_or_none(focus.scanned_artefact_db), "dB"),
            f"Median over focus instants: largest |y| of the scan beyond {radius} from the path point over "
            f"the "
            "largest within.",
        ),
        Figure(
            "Range of n(x)",
            number(gain_range_db, "dB"),
            "20 lg of largest over smallest normalisation factor (equation 15) over all measured positions, "
            "those beside the actuators included.",
        ),
    ]


def remarks(verification: Verification, drive: Drive, scan: Field | Scan) -> list[str]:
    """What a reader should know or do, most pressing first."""
    fields = verification.fields
    failed = {check.name for check in verification.checks if check.passed is False}
    found: list[str] = []
    noise = verification.noise_error
    if "normalised error" in failed and noise is not None and noise > 0.7 * fields.error:
        found.append(
            "Most of the error is the vibrometer's noise. Play louder (a larger limit_v or amplitude), "
            "focus the "
            "laser, or put retro-reflective tape on the surface; the bank itself may be sound."
        )
    if abs(fields.level_db) > NOTED_LEVEL_DB:
        louder = "louder" if fields.level_db > 0 else "quieter"
        found.append(
            f"The scan is {number(abs(fields.level_db), 'dB')} {louder} than predicted. Check that amplifier "
            "volume and vibrometer sensitivity are those of the night in which the bank was measured."
        )
    if abs(fields.delay_samples) > NOTED_DELAY_SAMPLES:
        delay_us = 1e6 * abs(fields.delay_samples) / fields.sample_rate_hz
        later = "later" if fields.delay_samples > 0 else "earlier"
        found.append(
            f"The scan comes {number(delay_us, chr(0xB5) + 's')} {later} than predicted. Check "
            f"inter_channel_delay_s "
            "in the rig file and that the recorder's rate is that of the bank."
        )
    explained = noise is not None and noise > 0.7 * fields.error
    if failed & {"normalised error", "correlation"} and not explained:
        found.append(
            "The error is not explained by noise. Look at the error map: an area of its own points to the "
            "surface "
            "or the grid, the whole map to a gain, a dead actuator, or a surface that has warmed up or "
            "dried since "
            'the bank was measured. Measure a few positions anew with "wavefocus remeasure" and compare.'
        )
    if failed & {"focus to path point", "focus to predicted focus"}:
        found.append(
            "The focus is not where it should be. If all foci are displaced alike, check the mirror map; "
            "if they "
            "scatter, the positions around them are noisy or the path leaves the measured grid."
        )
    for reason, count in Counter(reason for _, reason in fields.excluded).most_common():
        remedy = REMEDIES.get(reason, "scan them again")
        found.append(f"{count} scanned position(s) were not compared because {reason}: {remedy}.")
    open_checks = [check.name for check in verification.checks if check.passed is None]
    if open_checks:
        found.append(
            f"Not judged: {', '.join(open_checks)}. The positions around the path points were not all "
            f"scanned, or "
            "no focal spot lies wholly within them; scan every position within "
            f"{FOCUS_RADIUS_MM:g} mm of the path."
        )
    if isinstance(scan, Scan) and np.isfinite(scan.playback_gain).any():
        gain = float(np.nanmedian(scan.playback_gain))
        if abs(gain - 1.0) > NOTED_GAIN:
            found.append(
                f"The loopback carried {number(gain)} times the volts asked for. Calibrate the player's "
                f"full-scale "
                "voltage (full_scale_v) or reference_gain in the rig file."
            )
    artefact = median_or_none(verification.focus.scanned_artefact_db)
    if artefact is not None and artefact > 0.0:
        found.append(
            f"Beyond {FOCUS_RADIUS_MM:g} mm from the focus the surface moves more than in it (by "
            f"{number(artefact, 'dB')} at the median focus instant), mostly beside the actuators. "
            f"Saturation in the "
            "scene's [regularisation] spreads the drive over more actuators."
        )
    if drive.scale < 1.0:
        found.append(
            f"The drive was scaled by {number(drive.scale)} to keep to limit_v, and prediction and scan with it."
        )
    if drive.omitted_bound > 0.0:
        found.append(
            f"The renderer left out parts of the drive; their relative error is at most {percent(drive.omitted_bound)}."
        )
    return found


def number(value: float | None, unit: str = "") -> str:
    """Three digits and the unit; a dash where there is no value."""
    if value is None or math.isnan(value):
        return "\N{EN DASH}"
    if math.isinf(value):
        text = "\N{INFINITY}" if value > 0 else "\N{MINUS SIGN}\N{INFINITY}"
    else:
        # A hundredth of a millimetre and of a decibel is as far as any of these figures can be trusted.
        digits = ".2f" if unit in ("mm", "dB") and abs(value) < 10 else ".3g"
        text = f"{value:{digits}}" if abs(value) < 1000 else f"{value:,.0f}"
        text = text.removeprefix("-") if not text.strip("-0.") else text
        text = text.replace("-", "\N{MINUS SIGN}")
    return text if unit == "1" else f"{text} {unit}".rstrip()


def precise(value: float | None) -> str:
    """A correlation, which differs from 1 in its last digits only."""
    return number(value) if value is None or math.isnan(value) else f"{value:.4f}".replace("-", "\N{MINUS SIGN}")


def percent(value: float | None) -> str:
    """A ratio of amplitudes in per cent and dB."""
    if value is None or math.isnan(value):
        return number(None)
    if not (value > 0.0 and math.isfinite(value)):
        return number(100.0 * value, "%")
    return f"{number(100.0 * value, '%')} ({number(20.0 * math.log10(value), 'dB')})"
