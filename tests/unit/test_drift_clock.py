"""The clock under the drift of a sentinel, as people read it."""

import re
import time
from datetime import UTC, datetime

import pytest
from matplotlib.figure import Figure

from wavefocus.rendering.report.figures import _label_clock


@pytest.mark.may_skip("Windows has no tzset")
@pytest.mark.skipif(not hasattr(time, "tzset"), reason="Windows has no tzset")
@pytest.mark.parametrize(
    ("zone", "start"),
    [
        ("CET-1CEST,M3.5.0,M10.5.0/3", "2026-10-24T18:00"),
        ("CET-1CEST,M3.5.0,M10.5.0/3", "2026-03-28T18:00"),
        ("AEST-10AEDT,M10.1.0,M4.1.0/3", "2026-10-03T08:00"),
        ("UTC0", "2026-10-24T18:00"),
    ],
)
def test_a_night_across_a_change_of_summer_time_then_each_label_has_its_own_offset(monkeypatch, zone, start):
    monkeypatch.setenv("TZ", zone)
    time.tzset()
    try:
        first = datetime.fromisoformat(start).replace(tzinfo=UTC).timestamp() / 86_400
        axes = Figure().add_subplot()
        axes.set_xlim(first, first + 0.6)
        _label_clock(axes, with_labels=True)
        places = axes.xaxis.get_majorticklocs()
        labels = axes.xaxis.get_major_formatter().format_ticks(places)
        clocks = {
            place: label for place, label in zip(places, labels, strict=True) if re.fullmatch(r"\d\d:\d\d", label)
        }
        assert len(clocks) >= 3
        for place, label in clocks.items():
            assert label == time.strftime("%H:%M", time.localtime(round(place * 86_400)))
    finally:
        monkeypatch.undo()
        time.tzset()
