"""The report holds all that it shows, and its text says what was found; names of users are escaped."""

import base64
import dataclasses
import io
import math
import re
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest
from PIL import Image

from tests.unit.line_verification import GRID_MM, RATE_HZ, bank, rendered, scan_of, scene_of
from wavefocus.acquisition.limits import DriftPoint
from wavefocus.rendering.number_text import number
from wavefocus.rendering.report.page import build_report, remarks
from wavefocus.rendering.verify.verdict import compare
from wavefocus.storage.field_file import Field

NASTY = '<script>alert("1")</script> & </title><img src="https://evil.example/x.png">'


def louder_scan(gain=1.0, noise=0.001):
    _, prediction = rendered()
    noise_rms = noise * float(np.sqrt(np.mean(prediction.field**2)))
    field = gain * prediction.field + noise_rms * np.random.default_rng(1).standard_normal(prediction.field.shape)
    return scan_of(field, prediction.start_s, RATE_HZ, noise_rms, playback_gain=np.full(len(field), gain))


def report_of(out_dir, scan, source, name, foci=None, **options):
    drive, prediction = rendered()
    kept = {key: getattr(drive, key)[:foci] for key in ("focus_sample", "focus_position", "focus_source")}
    places = None if drive.focus_mm is None else drive.focus_mm[:foci]
    drive = dataclasses.replace(drive, **kept, focus_mm=places)
    return build_report(
        out_dir,
        verification=compare(prediction, scan, drive, source),
        scene=scene_of(name),
        drive=drive,
        prediction=prediction,
        scan=scan,
        bank=source,
        **options,
    )


@pytest.fixture(scope="module")
def good_report(tmp_path_factory):
    outline = np.array([(-50.0, -45.0), (50.0, -45.0), (50.0, 45.0), (-50.0, 45.0), (-50.0, -45.0)])
    return report_of(
        tmp_path_factory.mktemp("good") / "made",
        louder_scan(),
        bank(),
        NASTY,
        campaign={"hours simulated": 30.0, NASTY: NASTY},
        outline_mm=outline,
        save_pictures=True,
    )


def images_of(html):
    coded = re.findall(r'src="data:image/png;base64,([A-Za-z0-9+/=]+)"', html)
    return [Image.open(io.BytesIO(base64.b64decode(one))) for one in coded]


def test_given_a_good_scan_then_the_report_passes_and_holds_all_its_pictures(good_report):
    html = good_report.read_text(encoding="utf-8")
    assert good_report.name == "report.html"
    assert "✓ Passed" in html
    assert "✗" not in html
    assert "hours simulated" in html
    pictures = images_of(html)
    assert len(pictures) == html.count("<img ") == 7
    for picture, width in zip(pictures, re.findall(r'<img [^>]*width="(\d+)"', html), strict=True):
        assert picture.width == 2 * int(width)
        assert np.count_nonzero(picture.convert("L").histogram()) > 3
    assert good_report.stat().st_size < 3_000_000
    drawn = ("path", "snapshots", "waveforms", "error", "gain", "drive", "waves")
    assert {path.stem for path in good_report.parent.glob("*.png")} == set(drawn)
    assert "<h2>Drift</h2>" not in html


def test_names_that_are_markup_then_they_are_text_and_nothing_outside_is_loaded(good_report):
    html = good_report.read_text(encoding="utf-8")
    assert "default-src 'none'" in html
    assert not re.search(r"<script|<link|<iframe|@import|url\(", html)
    assert set(re.findall(r'\bsrc="([^,]{0,22})', html)) == {"data:image/png;base64"}
    assert "evil.example/x.png&#34;" in html
    assert html.count("</title>") == 1


@pytest.fixture(scope="module")
def flawed_report(tmp_path_factory):
    """Of a bank with flawed rows, a plain field and a sentinel that drifted."""
    status = np.ones(len(GRID_MM), np.uint8)
    status[[3, 5, 7, 9]] = 2, 4, 8, 16
    flawed = dataclasses.replace(bank(), status=status, actuator_mm=np.full((4, 2), np.nan), band_hz=None)
    _, prediction = rendered()
    scan = Field(1.3 * prediction.field, prediction.position_index, RATE_HZ, prediction.start_s, "m/s")
    first = datetime(2026, 1, 5, 18, tzinfo=UTC)
    points = [DriftPoint(first + timedelta(hours=hour), -0.1 * hour, 0.0, 0.999, "steady") for hour in range(5)]
    points.append(DriftPoint(first + timedelta(hours=5), -6.0, 0.0, 0.999, "stop", (3, 4)))
    folder = tmp_path_factory.mktemp("flawed")
    return report_of(folder, scan, flawed, "flawed", foci=1, campaign={}, drift=points, save_pictures=True)


@pytest.mark.long
def test_given_flawed_rows_and_a_plain_field_then_the_report_names_and_crosses_them(flawed_report):
    html = flawed_report.read_text(encoding="utf-8")
    assert "✗ Failed" in html
    assert "all frequencies" in html
    assert "Crosses: the 4 scanned position(s)" in html
    assert "wavefocus remeasure" in html
    assert "<h2>Drift</h2>" in html
    assert flawed_report.with_name("drift.png").read_bytes().startswith(b"\x89PNG")


def few_positions():
    _, prediction = rendered()
    return Field(prediction.field[80:90], np.arange(80, 90), RATE_HZ, prediction.start_s, "m/s")


@pytest.mark.parametrize(
    ("scan", "remark", "not_remark"),
    [
        (lambda: louder_scan(gain=1.04), "louder than predicted. Check that amplifier volume", "Not judged"),
        (lambda: louder_scan(gain=1.3), "loopback carried 1.3 times", "Not judged"),
        (lambda: louder_scan(noise=0.5), "Most of the error is the vibrometer's noise", "not explained by noise"),
        (few_positions, "Not judged: focus to path point", "not explained"),
    ],
)
def test_given_a_scan_then_the_remarks_say_what_to_check(scan, remark, not_remark):
    drive, prediction = rendered()
    text = " ".join(remarks(compare(prediction, scan(), drive, bank()), drive, scan()))
    assert remark in text
    assert not_remark not in text


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [
        (None, "mm", "\N{EN DASH}"),
        (math.nan, "", "\N{EN DASH}"),
        (0.0004, "mm", "0.00 mm"),
        (-0.001, "dB", "0.00 dB"),
        (-12.345, "dB", "\N{MINUS SIGN}12.3 dB"),
        (1234.5, "V", "1,234 V"),
        (math.inf, "", "∞"),
    ],
)
def test_given_a_figure_then_it_is_written_with_the_digits_it_deserves(value, unit, text):
    assert number(value, unit) == text
