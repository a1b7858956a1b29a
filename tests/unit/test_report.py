"""Reports and movies: they hold all that they show, their text says what was found, names of users are escaped."""

import base64
import dataclasses
import io
import math
import re
import time
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from PIL import Image

from tests.unit.line_verification import GRID_MM, RATE_HZ, bank, rendered, scan_of, scene_of
from wavefocus import Drive, InputError
from wavefocus.config.messages.campaign import Drift
from wavefocus.rendering.number_text import number
from wavefocus.rendering.report.figures import _label_clock
from wavefocus.rendering.report.movie import Foci, colour_limit, plan_frames, read_frames
from wavefocus.rendering.report.page import build_report, remarks
from wavefocus.rendering.verify.verdict import compare
from wavefocus.storage.field_file import Field, FieldRowReader, write_field

NASTY = '<script>alert("1")</script> & </title><img src="https://evil.example/x.png">'


def louder_scan(gain=1.0, noise=0.001):
    _, prediction = rendered()
    noise_rms = noise * float(np.sqrt(np.mean(prediction.field**2)))
    field = gain * prediction.field + noise_rms * np.random.default_rng(1).standard_normal(prediction.field.shape)
    return scan_of(field, prediction.start_s, RATE_HZ, noise_rms, playback_gain=np.full(len(field), gain))


def first_focus():
    """The drive, of whose foci only the first is looked at: each takes time to be judged and drawn."""
    drive, _ = rendered()
    keys = ("focus_sample", "focus_position", "focus_source", "focus_mm")
    return dataclasses.replace(drive, **{key: getattr(drive, key)[:1] for key in keys})


def images_of(html):
    coded = re.findall(r'src="data:image/png;base64,([A-Za-z0-9+/=]+)"', html)
    return [Image.open(io.BytesIO(base64.b64decode(one))) for one in coded]


def test_the_report_shows_all_names_what_is_flawed_and_escapes_what_users_write(tmp_path):
    """Of a bank with flawed rows, a scan of unknown noise and a sentinel that drifted."""
    status = np.ones(len(GRID_MM), np.uint8)
    status[[3, 5, 7, 9]] = 2, 4, 8, 16
    flawed = dataclasses.replace(bank(), status=status, actuator_mm=np.full((4, 2), np.nan), band_hz=None)
    _, prediction = rendered()
    scan = scan_of(1.3 * prediction.field, prediction.start_s, RATE_HZ)
    first = datetime(2026, 1, 5, 18, tzinfo=UTC)
    looks = [(-0.1 * hour, 0.0, 0.999, "steady", "run", "", ()) for hour in range(5)]
    looks.append((-6.0, 0.0, 0.999, "stop", "run", "level changed", (3, 4)))
    points = [(first + timedelta(hours=hour), Drift(0.0, 0, *look)) for hour, look in enumerate(looks)]
    outline = np.array([(-50.0, -45.0), (50.0, -45.0), (50.0, 45.0), (-50.0, 45.0), (-50.0, -45.0)])
    drive = first_focus()
    report = build_report(
        tmp_path / "made", verification=compare(prediction, scan, drive, flawed), scene=scene_of(NASTY), drive=drive,
        prediction=prediction, scan=scan, bank=flawed, campaign={"hours simulated": 30.0, NASTY: NASTY}, drift=points,
        outline_mm=outline,
    )  # fmt: skip
    html = report.read_text(encoding="utf-8")
    assert report.name == "report.html"
    for text in (
        "✗ Failed", "all frequencies", "Crosses: the 4 scanned position(s)", "wavefocus remeasure", "<h2>Drift</h2>",
        "hours simulated",
    ):  # fmt: skip
        assert text in html
    pictures = images_of(html)
    assert len(pictures) == html.count("<img ") == 8
    for picture, width in zip(pictures, re.findall(r'<img [^>]*width="(\d+)"', html), strict=True):
        assert picture.width == 2 * int(width)
        assert np.count_nonzero(picture.convert("L").histogram()) > 3
    assert report.stat().st_size < 3_000_000
    drawn = ("path", "snapshots", "waveforms", "error", "gain", "drive", "waves", "drift")
    assert {path.stem for path in report.parent.glob("*.png")} == set(drawn)
    # Nothing outside is loaded.
    assert "default-src 'none'" in html
    assert not re.search(r"<script|<link|<iframe|@import|url\(", html)
    assert set(re.findall(r'\bsrc="([^,]{0,22})', html)) == {"data:image/png;base64"}
    assert "evil.example/x.png&#34;" in html
    assert html.count("</title>") == 1


@pytest.mark.long
def test_given_a_scan_then_the_remarks_say_what_to_check():
    drive, (_, prediction) = first_focus(), rendered()
    few = scan_of(prediction.field[80:90], prediction.start_s, RATE_HZ, position_index=np.arange(80, 90))
    for scan, remark, not_remark in (
        (louder_scan(gain=1.04), "louder than predicted. Check that amplifier volume", "Not judged"),
        (louder_scan(gain=1.3), "loopback carried 1.3 times", "Not judged"),
        (louder_scan(noise=0.5), "Most of the error is the vibrometer's noise", "not explained by noise"),
        (few, "Not judged: focus to path point", "not explained"),
        (few, "scaled by 0.5 to keep to its limits", "limit_v"),
    ):
        drive = dataclasses.replace(drive, scale=0.5)
        text = " ".join(remarks(compare(prediction, scan, drive, bank()), drive, scan))
        assert remark in text
        assert not_remark not in text


def test_given_a_figure_then_it_is_written_with_the_digits_it_deserves():
    dash, minus = "\N{EN DASH}", "\N{MINUS SIGN}"
    for value, unit, text in (
        (None, "mm", dash), (math.nan, "", dash), (0.0004, "mm", "0.00 mm"), (-0.001, "dB", "0.00 dB"),
        (-12.345, "dB", f"{minus}12.3 dB"), (1234.5, "V", "1,234 V"), (math.inf, "", "∞"),
    ):  # fmt: skip
        assert number(value, unit) == text


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
    from matplotlib.figure import Figure

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


def test_given_foci_then_the_movie_is_of_them_and_of_what_was_asked_for_else(tmp_path):
    """Two sources: one moves over rows 4, 5, 6 every 40 ms, the other focuses once on row 11 at 0.15 s."""
    rate_hz, samples = 1000.0, 400
    foci = (np.array([60, 100, 140, 150]), np.array([4, 5, 6, 11]), np.array([0, 0, 0, 1]))
    drive = Drive(np.zeros((2, 300)), rate_hz, -0.05, "sampled", 1.0, 0.0, *foci)
    values = np.tile(np.arange(1.0, 13.0, dtype=np.float32)[:, None], (1, samples))
    values[[4, 6], [60 + 50 + 7, 140 + 50 + 3]] = -100.0, 100.0  # where two foci are, somewhat late
    write_field(tmp_path / "field.h5", Field(values, np.arange(12), rate_hz, -0.05, "m/s"))
    with FieldRowReader(tmp_path / "field.h5") as field:
        plan = plan_frames(field, drive)
        assert (plan.sample[0], plan.sample[-1]) == (60 + 50 - 20, 150 + 50 + 20)
        assert plan.slowed == pytest.approx(rate_hz / 25)
        assert colour_limit(read_frames(field, plan.sample), Foci.of(drive).seen(field)[2]) == 100.0
        whole = plan_frames(field, None)
        assert (whole.sample[0], whole.sample[-1]) == (0, samples - 2)
        some = plan_frames(field, drive, from_s=0.0, to_s=0.1, slow=8.0)
        assert some.sample.tolist() == list(range(50, 151, 5))
        assert some.slowed == pytest.approx(8.0)
        for options, words in (({"from_s": 5.0}, "nothing to show"), ({"slow": 1e5}, "lower --slow")):
            with pytest.raises(InputError, match=words):
                plan_frames(field, None, **options)
