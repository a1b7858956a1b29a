"""Text of the report: numbers, lines of figures, remarks with advice."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.rendering.number_text import number, percent, precise

if TYPE_CHECKING:
    from wavefocus.rendering.verify.results import Figure
    from wavefocus.rendering.verify.scan import Scan
    from wavefocus.rendering.verify.verdict import Verification
    from wavefocus.storage.drive_file import Drive
    from wavefocus.storage.field_file import Field

NOISE_SHARE = 0.7
"""Share of the error above which noise is named as its cause: half of the error's square."""

REMEDIES = {
    "the scan failed": "look at the instruments' messages and scan these positions again",
    "the scan reached the end of the input range": "set a wider response range or a lower limit_v",
    "the bank's row is not valid": 'run "wavefocus remeasure" on the bank',
}


FigureLine = tuple[str, str, str]
"""A line of the report's table of figures: name, value and definition."""


def figure_lines(verification: Verification, gain_range_db: float) -> list[FigureLine]:
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


def remarks(verification: Verification, drive: Drive, scan: Field | Scan) -> list[str]:
    """Notes and advice for the reader, most pressing first."""
    from wavefocus.rendering.field.focus_figures import (  # the window imports this module
        FOCUS_RADIUS_MM,
        median_or_none,
    )
    from wavefocus.rendering.verify.scan import Scan
    from wavefocus.rendering.verify.sentinel import drift_sentence

    fields = verification.fields
    failed = {check.name for check in verification.checks if check.passed is False}
    not_judged = [check.name for check in verification.checks if check.passed is None]
    noise = verification.noise_error
    from_noise = noise is not None and noise > NOISE_SHARE * fields.error
    delay_us = 1e6 * abs(fields.delay_samples) / fields.sample_rate_hz
    gains = scan.playback_gain if isinstance(scan, Scan) else np.full(1, np.nan)
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
            f"The drive was scaled by {number(drive.scale)} to keep to limit_v, and prediction and scan with it.",
        ),
        (
            drive.omitted_bound > 0.0,
            f"The renderer left out parts of the drive; the relative error is at most {percent(drive.omitted_bound)}.",
        ),
    ]
    return [text for applies, text in found if applies]
