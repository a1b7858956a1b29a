"""Durations for people."""

import pytest

from wavefocus.acquisition.wording import hours


@pytest.mark.parametrize(
    ("seconds", "words"),
    [
        (0.0, "0 s"),
        (59.4, "59 s"),
        (59.6, "1 min 00 s"),
        (3599.6, "1 h 00 min"),
        (108_000.0, "30 h 00 min"),
        (-5.0, "0 s"),
        (1e300, "over 100 years"),
        (float("inf"), "unknown"),
        (float("nan"), "unknown"),
    ],
)
def test_given_seconds_then_words(seconds: float, words: str) -> None:
    assert hours(seconds) == words
