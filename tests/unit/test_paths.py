"""Paths followed by their arc length; drawings and path data of any content."""

import math
import warnings

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.rendering.scene.paths import Circle, Line, Point, Polyline, Strokes, TextPath
from wavefocus.rendering.scene.svg import SvgPath, flatten
from wavefocus.storage.errors import InputError

NAN = float("nan")


def test_a_path_is_followed_by_its_arc_length():
    strokes = [np.array([[0.0, 0.0], [2.0, 0.0]]), np.array([[10.0, 0.0], [10.0, 3.0]])]
    square, quarter_mm = Polyline([(0, 0), (0, 0), (4, 0), (4, 0), (4, 3)], closed=True), 2.5 * math.pi
    for path, length_mm, points_mm in (
        (square, 12.0, {4: (4, 0), 7: (4, 3), 9.5: (2, 1.5), 12: (0, 0)}),
        (Strokes(strokes), 5.0, {1.9: (1.9, 0), 2.0: (10, 0), 5.0: (10, 3)}),
        (Circle((1.0, 2.0), 5.0, 0.25), quarter_mm, {0.0: (6, 2), quarter_mm: (1.0, 7.0)}),
        (Circle((1.0, 2.0), 5.0, -0.25, 90.0), quarter_mm, {0.0: (1, 7), quarter_mm: (6, 2)}),
    ):
        assert path.length_mm == pytest.approx(length_mm)
        np.testing.assert_allclose(path.point_at(list(points_mm)), list(points_mm.values()), atol=1e-12)


@given(
    points=st.lists(st.tuples(st.floats(-100, 100), st.floats(-100, 100)), min_size=2, max_size=8), closed=st.booleans()
)
def test_neighbours_on_a_polyline_are_never_further_apart_than_along_it(points, closed):
    path = Polyline(points, closed)
    along = np.linspace(0, path.length_mm, 200)
    steps = np.hypot(*np.diff(path.point_at(along), axis=0).T)
    assert (steps <= np.diff(along) + 1e-9).all()
    np.testing.assert_allclose(path.point_at([0.0])[0], points[0], atol=1e-9)
    np.testing.assert_allclose(path.point_at([path.length_mm])[0], points[0 if closed else -1], atol=1e-9)


def test_a_path_that_makes_no_sense_is_refused():
    for make in (
        lambda: Point((NAN, 0)), lambda: Line((0, 0), (math.inf, 0)), lambda: Polyline([]), lambda: Strokes([]),
        lambda: Circle((0, 0), -1.0), lambda: Circle((0, 0), 1.0, math.inf), lambda: Polyline([(0, NAN)]),
        lambda: TextPath("  ", 10), lambda: TextPath("A", 0), lambda: TextPath("A", 10, (NAN, 0)),
        lambda: TextPath("\u4e2d", 10),
    ):  # fmt: skip
        with pytest.raises(InputError):
            make()


def svg(tmp_path, body):
    file = tmp_path / "drawing.svg"
    file.write_text(f'<?xml version="1.0"?><svg xmlns="http://www.w3.org/2000/svg">{body}</svg>')
    return file


def test_an_svg_path_is_upright_with_its_transforms_and_is_found_by_its_id(tmp_path):
    file = svg(tmp_path, '<path id="v" d="M 0 0 L 10 0 L 10 20"/>')
    path = SvgPath(file, "v", 0.5, (1.0, 2.0))
    assert path.length_mm == pytest.approx(15.0)
    np.testing.assert_allclose(path.point_at([0, 5, 15]), [[1, 2], [6, 2], [6, -8]], atol=1e-9)
    with pytest.raises(InputError, match="'v'"):
        SvgPath(file, "star")
    turned = '<g transform="rotate(90)"><path id="v" d="m1 0 1 0"/></g>'
    file = svg(tmp_path, f'<g transform="translate(10, 0) scale(2)">{turned}</g>')
    np.testing.assert_allclose(SvgPath(file).point_at([0, 2]), [[10, -2], [10, -4]], atol=1e-9)


def test_path_commands_draw_what_the_standard_says():
    for data, end, length in (
        ("M0 0 H10 V5", (10, 5), 15), ("m1,1 h2v3l-2-3z", (1, 1), 5 + math.sqrt(13)),
        ("M0 0 10 0 10 10", (10, 10), 20), ("M0,0C0,0 10,0 10,0", (10, 0), 10),
        ("M0 0c0 0 5 0 5 0s5 0 5 0", (10, 0), 10), ("M0 0Q5 0 10 0T20 0", (20, 0), 20),
        ("M0 0A10 10 0 0 1 20 0", (20, 0), 10 * math.pi), ("M0 0a10 10 0 1010 10", (10, 10), 15 * math.pi),
        ("M0 0A1 1 0 0 1 20 0", (20, 0), 10 * math.pi), ("M0 0A0 5 0 0 1 3 4", (3, 4), 5),
        ("M1e1-.5.5.5", (0.5, 0.5), math.hypot(9.5, 1.0)),
    ):  # fmt: skip
        (stroke,) = flatten(data, 1e-4)
        np.testing.assert_allclose(stroke[-1], end, atol=1e-9)
        assert np.hypot(*np.diff(stroke, axis=0).T).sum() == pytest.approx(length, rel=1e-3)


MALFORMED = ["", "L0 0", "M0", "M0 0 X", "M0 0 L1", "M0 0A1 1 0 2 0 5 5", "M0 0z 5", "M0 0 nan 0", "M 0 0 L 12",
             "M 0 0 L 10 20 345", "M 0 0 A " + 400 * "2"]  # fmt: skip


def test_malformed_path_data_is_refused_at_once():
    for data in MALFORMED:
        with pytest.raises(InputError, match=r"goes wrong|must begin with M"):
            flatten(data, 0.01)


COORDINATE = st.sampled_from([0.0, 1.0, -3.0, 1e-200, -1e-300, 5e-324, 1e99, -1e100, 1e30])


@given(st.lists(COORDINATE, min_size=14, max_size=14), st.sampled_from("LCSQTA"), st.booleans(), st.booleans())
def test_any_numbers_of_path_data_give_finite_points_or_one_sentence(values, kind, large, sweep):
    count = {"L": 2, "C": 6, "S": 4, "Q": 4, "T": 2, "A": 7}[kind]
    given_values = [str(value) for value in values[:count]]
    if kind == "A":
        given_values[3:5] = str(int(large)), str(int(sweep))
    data = f"M{values[-2]} {values[-1]}{kind}{' '.join(given_values)}"
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            strokes = flatten(data, 0.005)
        except InputError:
            return
    assert all(np.isfinite(stroke).all() for stroke in strokes)


SVGS = {
    **{name: f'<?xml version="1.0" encoding="{name}"?><svg><path d="M0 0L9 0"/></svg>'.encode() for name in (
        "zlib", "hex", "idna", "undefined", "utf-7", "rot13", "base64", "punycode", "no-such", "utf-32",
    )},
    "large numbers": b'<svg><path d="M0 0C1e308 1e308 1e308 1e308 1e308 1e308"/></svg>',
    "scale": b'<svg><g transform="scale(1e200)"><g transform="scale(1e200)"><path d="M0 0L9 0"/></g></g></svg>',
    "translate": b'<svg><path transform="translate(1e308) translate(1e308)" d="M0 0L9 0"/></svg>',
    "rotate": b'<svg><path transform="rotate(inf)" d="M0 0L9 0"/></svg>',
    "matrix": b'<svg><path transform="matrix(1e150 0 0 1e150 0 0)" d="M0 0L1e99 0"/></svg>',
    "skew": b'<svg><path transform="skewX(nan)" d="M0 0L9 0"/></svg>',
    "cubics": b'<svg><path d="M0 0' + b"C9e9 9e9 9 9 1 1" * 2000 + b'"/></svg>',
    "entities": b'<!DOCTYPE svg [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;">]><svg><path d="M0 0h1"/></svg>',
    "another file": b'<!DOCTYPE svg SYSTEM "file:///etc/passwd"><svg><path d="M0 0h1"/></svg>',
}  # fmt: skip


@pytest.mark.parametrize("name", SVGS)
def test_a_drawing_that_cannot_be_read_is_one_sentence(tmp_path, name):
    (tmp_path / "a.svg").write_bytes(SVGS[name])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError, match=r"a\.svg.*document type" if b"DOCTYPE" in SVGS[name] else r"a\.svg"):
            SvgPath(tmp_path / "a.svg")


def test_text_fills_its_height_around_its_centre():
    path = TextPath("Ab$", 40.0, (5.0, -3.0))
    points = path.point_at(np.linspace(0, path.length_mm, 4000))
    assert np.ptp(points[:, 1]) == pytest.approx(40.0, abs=0.1)
    np.testing.assert_allclose((points.min(axis=0) + points.max(axis=0)) / 2, [5, -3], atol=0.1)
    upright = TextPath("L", 10.0)
    heights = upright.point_at(np.linspace(0, upright.length_mm, 2000))[:, 1]
    assert np.count_nonzero(heights < -3) > np.count_nonzero(heights > 3)
