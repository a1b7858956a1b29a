"""Scenes of extreme numbers and sizes: a finite drive or one sentence, and the size before anything is made."""

import tracemalloc
import warnings
from pathlib import Path

import numpy as np
import pytest
import soundfile
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.unit.plate_banks import NOISE_MM, noise_bank
from wavefocus.config.scene import SceneConfig
from wavefocus.rendering.drive.rendering import SceneRenderer, render_with_report
from wavefocus.rendering.scene.model import build_scene, read_scene
from wavefocus.rendering.scene.sampling import MAX_DRIVE_BYTES, check_scene_size, scene_size
from wavefocus.rendering.scene.scene_rows import scene_rows
from wavefocus.rendering.scene.svg import SvgPath, flatten
from wavefocus.storage.errors import InputError

RATE_HZ = 1000.0
LINE = '{ kind = "line", start_mm = [-12, 0], end_mm = [12, 0] }'
POINT = '{ kind = "point", at_mm = [0, 0] }'
IMPULSE = '{ kind = "impulse" }'
LARGE = {
    "late": ("start_s = 1e6\nspeed_mm_s = 80\nstep_mm = 4", LINE, IMPULSE),
    "long sine": ("", POINT, '{ kind = "sine", frequency_hz = 200, duration_s = 1e6 }'),
    "long noise": ("", POINT, '{ kind = "noise", band_hz = [50, 400], duration_s = 1e6 }'),
    "longest sine": ("", POINT, '{ kind = "sine", frequency_hz = 200, duration_s = 1e308 }'),
    "many points": ("speed_mm_s = 80\nstep_mm = 1e-6", LINE, IMPULSE),
    "one long step": ("speed_mm_s = 80\nstep_mm = 1e9", LINE, IMPULSE),
    "slow": ("speed_mm_s = 1e-5\nstep_mm = 4", LINE, IMPULSE),
    "many turns": ("speed_mm_s = 80\nstep_mm = 4", '{ kind = "circle", radius_mm = 8, turns = 1e9 }', IMPULSE),
}


def source(keys, path, signal):
    return f"[[source]]\n{keys}\npath = {path}\nsignal = {signal}\n"


def read(text, folder=Path()):
    return read_scene(text, folder / "scene.toml")


@pytest.mark.parametrize("name", LARGE)
def test_a_large_scene_is_refused_by_its_size_before_anything_is_made(name):
    scene, small = read(source(*LARGE[name])), noise_bank(40)
    tracemalloc.start()
    try:
        for make in (
            lambda: render_with_report(scene, small),
            lambda: SceneRenderer(scene, small),
        ):
            with pytest.raises(InputError, match="allowed"):
                make()
        assert tracemalloc.get_traced_memory()[1] < 50e6
    finally:
        tracemalloc.stop()


def test_a_long_scene_is_rendered_in_the_size_stated_and_a_longer_one_refused():
    text = source(
        "speed_mm_s = 0.001\nstep_mm = 0.005", '{ kind = "line", start_mm = [0, 0], end_mm = [4, 0] }', IMPULSE
    )
    stated = scene_size(read(text), sample_rate_hz=RATE_HZ, taps=40, actuators=3)
    live = SceneRenderer(read(text), noise_bank(40), method="sampled")
    assert live.shape[1] == stated.samples
    assert sum(len(one.focus_sample) for one in live.sampled.sources) == stated.path_points
    slower = read(text.replace("speed_mm_s = 0.001", "speed_mm_s = 0.00001"))
    assert scene_size(slower, sample_rate_hz=RATE_HZ, taps=40, actuators=3).drive_bytes > MAX_DRIVE_BYTES
    with pytest.raises(InputError, match="8 GiB of drives are allowed: split it"):
        SceneRenderer(slower, noise_bank(40), method="sampled")


@pytest.mark.parametrize("turns", [1e9, 1e12])
def test_a_path_of_any_length_is_refused_where_only_its_positions_are_sought(turns):
    path = f'{{ kind = "circle", radius_mm = 8, turns = {turns} }}'
    scene = read(source("speed_mm_s = 80\nstep_mm = 4", path, IMPULSE))
    with pytest.raises(InputError, match="points"):
        scene_rows(scene, NOISE_MM)


def declaring(path, frames):
    """A FLAC file whose header declares another number of frames than it holds."""
    soundfile.write(path, np.random.default_rng(0).standard_normal(5000) * 0.1, 8000)
    content = bytearray(path.read_bytes())
    packed = int.from_bytes(content[18:26], "big")
    content[18:26] = ((packed >> 36 << 36) | frames).to_bytes(8, "big")
    path.write_bytes(content)
    return path


def test_a_sound_file_is_refused_by_what_it_declares(tmp_path):
    declaring(tmp_path / "a.flac", 10**8)
    text = source("", POINT, '{ kind = "file", path = "a.flac" }')
    with pytest.raises(InputError, match="samples of signals are allowed"):
        render_with_report(read(text, tmp_path), noise_bank(40))
    with pytest.raises(InputError, match=r"a\.flac cannot be read"):
        read(text, tmp_path).sources[0].signal.samples(RATE_HZ)


def test_a_sound_file_of_many_channels_is_sized_by_its_frames_and_read_one_channel(tmp_path):
    with soundfile.SoundFile(tmp_path / "c.flac", "w", 8000, 8, "PCM_16") as file:
        file.write(np.ones((2**18, 8), np.int16))
    scene = read(source("", POINT, '{ kind = "file", path = "c.flac" }'), tmp_path)
    size = check_scene_size(scene, sample_rate_hz=RATE_HZ, taps=40, actuators=3)
    assert (size.signal_samples, round(size.seconds, 2)) == (2**18, round(2**18 / 8000 + 0.039, 2))
    import scipy.signal  # noqa: F401  # loading it would count as memory

    tracemalloc.start()
    try:
        samples = scene.sources[0].signal.samples(RATE_HZ)
        assert tracemalloc.get_traced_memory()[1] < 4 * 8 * 2**20
    finally:
        tracemalloc.stop()
    assert len(samples) == 2**18 // 8


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
}  # fmt: skip


@pytest.mark.parametrize("name", SVGS)
def test_a_drawing_that_cannot_be_read_is_one_sentence(tmp_path, name):
    (tmp_path / "a.svg").write_bytes(SVGS[name])
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(InputError, match=r"a\.svg"):
            SvgPath(tmp_path / "a.svg")


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


EXTREMES = [5e-324, 1e-200, 1e-12, 1.0, 30.0, 1e12, 1e200, 1.7e308]
ABOVE_ZERO = st.sampled_from(EXTREMES)
FINITE = st.sampled_from([0.0, *EXTREMES, *(-value for value in EXTREMES)])
PAIR = st.tuples(FINITE, FINITE)
NEAR = st.tuples(st.sampled_from([-8.0, 0.0, 1e-200, 8.0]), st.sampled_from([-8.0, 0.0, 8.0]))
PATHS = st.one_of(
    st.fixed_dictionaries({"kind": st.just("point"), "at_mm": NEAR | PAIR}),
    st.fixed_dictionaries({"kind": st.just("line"), "start_mm": NEAR | PAIR, "end_mm": NEAR | PAIR}),
    st.fixed_dictionaries({"kind": st.just("circle"), "centre_mm": NEAR, "radius_mm": ABOVE_ZERO, "turns": FINITE}),
    st.fixed_dictionaries(
        {
            "kind": st.just("polyline"),
            "points_mm": st.lists(NEAR | PAIR, min_size=1, max_size=4),
            "closed": st.booleans(),
        }
    ),
    st.fixed_dictionaries(
        {"kind": st.just("text"), "string": st.just("o"), "height_mm": ABOVE_ZERO, "centre_mm": NEAR}
    ),
)
SIGNALS = st.one_of(
    st.just({"kind": "impulse"}),
    st.fixed_dictionaries({"kind": st.just("sine"), "frequency_hz": ABOVE_ZERO, "duration_s": ABOVE_ZERO}),
    st.fixed_dictionaries(
        {"kind": st.just("noise"), "band_hz": st.tuples(ABOVE_ZERO, ABOVE_ZERO), "duration_s": ABOVE_ZERO}
    ),
)
SOURCES = st.fixed_dictionaries(
    {
        "start_s": st.just(0.0) | ABOVE_ZERO,
        "speed_mm_s": st.just(80.0) | ABOVE_ZERO,
        "step_mm": st.just(4.0) | ABOVE_ZERO,
        "amplitude": st.just(1.0) | FINITE,
        "path": PATHS,
        "signal": SIGNALS,
        "emission": st.sampled_from(["per_point", "continuous"]),
    }
)
SCENES = st.fixed_dictionaries(
    {
        "source": st.lists(SOURCES, min_size=1, max_size=2),
        "regularisation": st.fixed_dictionaries(
            {
                "saturation": st.just(0.0) | ABOVE_ZERO,
                "saturation_absolute": st.sampled_from([0.0, 0.0, *EXTREMES]),
                "normalise": st.booleans(),
            }
        ),
        "output": st.fixed_dictionaries(
            {
                "interpolation": st.sampled_from(["nearest", "bilinear"]),
                "limit_v": st.none() | ABOVE_ZERO,
                "limit_rms_v": st.none() | ABOVE_ZERO,
            }
        ),
    }
)


@given(SCENES)
def test_any_numbers_of_a_scene_give_finite_drives_or_one_sentence(tables):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        try:
            scene = build_scene(SceneConfig.model_validate(tables), Path("scene.toml"))
            drive, _ = render_with_report(scene, noise_bank(40))
        except (InputError, ValidationError):
            return
    assert np.isfinite(drive.drive_v).all()
    assert 0 <= drive.scale <= 1
