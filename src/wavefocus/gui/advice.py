"""Advice of commands, in the words of the window: what names an option there names a button or a box here."""

from __future__ import annotations

import re

# What commands advise, and what does it in the window. Longer phrases come first.
_PHRASES: tuple[tuple[re.Pattern[str], str], ...] = tuple(
    (re.compile(pattern), words)
    for pattern, words in (
        (
            r"(?:run )?wavefocus remeasure \S+ --positions (\S+) and resume, or go on with --accept-drift",
            r"select positions \1 on the map and press Remeasure selected, then Resume, or tick Accept drift in the "
            "Campaign menu and press Resume",
        ),
        (
            r"put it right and resume, start a new bank, or go on with --accept-drift",
            "put it right and press Resume, start a new bank, or tick Accept drift in the Campaign menu and press "
            "Resume",
        ),
        (r"go on with --accept-drift", "tick Accept drift in the Campaign menu and press Resume"),
        (r"(?:go on )?with --accept-calibration", "with Accept another calibration ticked in the Campaign menu"),
        (r"--accept-calibration", "Accept another calibration in the Campaign menu"),
        (r"--accept-drift", "Accept drift in the Campaign menu"),
        (r"allowed with --allow-large", "allowed with the box “Allow large scenes”"),
        (r" ?\(--allow-large\)", ""),
        (r"--allow-large", "“Allow large scenes”"),
        (r"name the rig with --rig", "choose the rig file"),
        (r"(?:run |with: )?wavefocus resume(?: [^\s,;]+)?", "Resume in the Campaign tab"),
        (r"(?:run )?\"?wavefocus remeasure\"?(?: on the bank| [^\s,;.]+\.h5)?", "Remeasure in the Campaign tab"),
        (r"(?:run )?wavefocus calibrate(?: --only (\w+))?(?: again)?", "use the page Calibration of the Rig tab"),
        (r"(?:then )?(?:run )?wavefocus doctor(?: again)?", "Examine in the Rig tab"),
        (r"or use --gain-db", "or the gain"),
        (r"lower --amplitude-v", "lower sweep.amplitude_v"),
        (r"wavefocus resume, or stop", "press Continue, or Stop after this position"),
        (r"; --force replaces (?:it|them)", ""),
    )
)


def in_window(sentence: str) -> str:
    """Return a command's sentence with the window's names for what it advises."""
    for pattern, words in _PHRASES:
        sentence = pattern.sub(words, sentence)
    return sentence
