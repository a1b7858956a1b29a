import pytest

from wavefocus.config.scene import Output, Regularisation, SceneConfig
from wavefocus.rendering.scene import paths, signals
from wavefocus.rendering.scene.model import load_scene
from wavefocus.rendering.scene.paths import TextPath
from wavefocus.rendering.scene.svg import SvgPath
from wavefocus.storage.errors import InputError

POINT = "[[source]]\npath = { kind = 'point', at_mm = [1, 2] }\nsignal = { kind = 'impulse' }\n"
MOVING = "[[source]]\nspeed_mm_s = 80\nstep_mm = 4\nsignal = { kind = 'impulse' }\n"
CONTRACT_EXAMPLE = """
[scene]
name = "circle"

[[source]]
start_s = 0.0
speed_mm_s = 80.0
step_mm = 4.0
amplitude = 1.0
path = { kind = "circle", centre_mm = [0, 0], radius_mm = 30, turns = 1.0, start_deg = 0 }
signal = { kind = "noise", band_hz = [50, 450], duration_s = 0.05, seed = 1 }
emission = "per_point"

[regularisation]
saturation = 0.5
saturation_absolute = 0.0
normalise = true

[output]
interpolation = "nearest"
limit_v = 1.0
"""


def scene_of(folder, text):
    file = folder / "scene.toml"
    file.write_text(text, encoding="utf-8")
    return load_scene(file)


def test_contracts_example_is_built_to_the_letter(tmp_path):
    scene = scene_of(tmp_path, CONTRACT_EXAMPLE)
    (source,) = scene.sources
    assert scene.name == "circle"
    assert source.path == paths.Circle((0, 0), 30, 1, 0)
    assert source.signal == signals.Noise((50, 450), 0.05, 1)
    assert (source.start_s, source.speed_mm_s, source.step_mm, source.amplitude) == (0, 80, 4, 1)
    assert source.emission == "per_point"
    assert scene.regularisation == Regularisation(saturation=0.5)
    assert scene.output == Output(interpolation="nearest", limit_v=1.0)


def test_scene_with_a_bare_point_has_the_contracts_defaults(tmp_path):
    scene = scene_of(tmp_path, POINT)
    (source,) = scene.sources
    assert (source.start_s, source.amplitude, source.emission) == (0, 1, "continuous")
    assert not scene.regularisation.saturation
    assert not scene.regularisation.saturation_absolute
    assert scene.regularisation.normalise
    assert scene.output == Output(interpolation="auto")


@pytest.mark.parametrize(
    ("table", "built"),
    [
        ("{ kind = 'line', start_mm = [0, 1], end_mm = [2, 3] }", paths.Line((0, 1), (2, 3))),
        ("{ kind = 'circle', radius_mm = 5 }", paths.Circle((0, 0), 5, 1, 0)),
        (
            "{ kind = 'polyline', points_mm = [[0, 0], [1, 0], [1, 1]], closed = true }",
            paths.Polyline(((0, 0), (1, 0), (1, 1)), True),
        ),
        ("{ kind = 'text', string = 'ab', height_mm = 9, centre_mm = [1, 2] }", TextPath("ab", 9, (1, 2))),
        ("{ kind = 'impulse' }", signals.Impulse()),
        ("{ kind = 'sine', frequency_hz = 200, duration_s = 0.1 }", signals.Sine(200, 0.1)),
        ("{ kind = 'noise', band_hz = [50, 450], duration_s = 1 }", signals.Noise((50, 450), 1, 0)),
    ],
)
def test_each_table_of_a_path_or_signal_builds_it(tmp_path, table, built):
    text = POINT.replace("{ kind = 'impulse' }", table)
    if isinstance(built, signals.Impulse | signals.Sine | signals.Noise):
        assert scene_of(tmp_path, text).sources[0].signal == built
    else:
        assert scene_of(tmp_path, f"{MOVING}path = {table}").sources[0].path == built


def test_files_are_found_beside_the_scene(tmp_path):
    (tmp_path / "a.svg").write_text('<svg><path id="p" d="M 0 0 L 10 0"/></svg>')
    (tmp_path / "a.wav").write_bytes(b"read when its samples are wanted")
    text = (
        "[[source]]\nspeed_mm_s = 80\nstep_mm = 4\n"
        "path = { kind = 'svg', file = 'a.svg', path_id = 'p', scale = 2, origin_mm = [1, 2] }\n"
        "signal = { kind = 'file', path = 'a.wav' }"
    )
    (source,) = scene_of(tmp_path, text).sources
    assert source.path == SvgPath(tmp_path / "a.svg", "p", 2, (1, 2))
    assert source.signal == signals.SoundFile(tmp_path / "a.wav")


def test_svg_without_the_named_path_tells_scene_and_drawing(tmp_path):
    (tmp_path / "a.svg").write_text('<svg><path id="p" d="M 0 0 L 10 0"/></svg>')
    with pytest.raises(InputError) as told:
        scene_of(tmp_path, f"{MOVING}path = {{ kind = 'svg', file = 'a.svg', path_id = 'q' }}")
    message = str(told.value)
    assert message.startswith(f"{tmp_path / 'scene.toml'}: source[0]: {tmp_path / 'a.svg'}")
    assert message.isprintable()


def test_scene_survives_json():
    data = {"source": [{"path": {"kind": "point", "at_mm": [1, 2]}, "signal": {"kind": "impulse"}}]}
    scene = SceneConfig.model_validate(data)
    assert SceneConfig.model_validate_json(scene.model_dump_json()) == scene


def moving(path):
    return f"{MOVING}path = {path}"


CIRCLE = "[[source]]\npath = { kind = 'circle', radius_mm = 3 }\nsignal = { kind = 'impulse' }\n"
MISTAKES = [
    ("", "source: is missing"),
    ("source = []", "source = []: must have at least 1 entries, has 0"),
    ("[source]\nstart_s = 0", "source: must be a list of tables, each under [[source]]"),
    ("[[sources]]\nstart_s = 0", "source: is missing; sources = [{ start_s }]: unknown key; did you mean source?"),
    ("[[source]]\nsignal = { kind = 'impulse' }", "source[0].path: is missing"),
    (moving("{ kind = 'square' }"), 'source[0].path.kind = "square": must be one of "point", "line", "circle"'),
    (moving("{ radius_mm = 3 }"), "source[0].path = { radius_mm }: must have a kind"),
    (moving("'circle'"), 'source[0].path = "circle": must be a table'),
    (moving("{ kind = 'circle', radius_cm = 3 }"), "source[0].path.radius_mm: is missing; "),
    (moving("{ kind = 'circle', radius_mm = 3, radius_cm = 3 }"), "source[0].path.radius_cm = 3: unknown key; did"),
    (moving("{ kind = 'circle', radius_mm = -3 }"), "source[0].path.radius_mm = -3: must be at least 0"),
    (moving("{ kind = 'circle', radius_mm = 3, turns = inf }"), "source[0].path.turns = inf: must be a finite"),
    (moving("{ kind = 'line', start_mm = [0], end_mm = [0, 0] }"), "source[0].path.start_mm[1]: is missing"),
    (moving("{ kind = 'polyline', points_mm = [] }"), "source[0].path.points_mm = []: must have at least 1"),
    (moving("{ kind = 'svg', file = 'no.svg' }"), 'source[0].path.file = "no.svg": must be a file'),
    (moving("{ kind = 'text', string = '', height_mm = 3 }"), 'source[0].path.string = "": must not be empty'),
    (CIRCLE + "step_mm = 4", "source[0].speed_mm_s: is needed in mm/s for a path of kind circle"),
    (CIRCLE + "speed_mm_s=4", "source[0].step_mm: is needed in mm for a path of kind circle"),
    (POINT + "speed_mm_s = -1", "source[0].speed_mm_s = -1: must be at least 0"),
    (POINT + "step_mm = 0", "source[0].step_mm = 0: must be above 0"),
    (POINT + "start_s = -1", "source[0].start_s = -1: must be at least 0"),
    (POINT + "amplitude = nan", "source[0].amplitude = nan: must be a finite number"),
    (POINT + "emission = 'once'", 'source[0].emission = "once": must be "per_point" or "continuous"'),
    (POINT + POINT + "start_s = -1", "source[1].start_s = -1: must be at least 0"),
    (POINT.replace("'impulse'", "'beep'"), 'source[0].signal.kind = "beep": must be one of "impulse", "sine"'),
    (
        POINT.replace("'impulse'", "'noise', band_hz = [450, 50], duration_s = 1"),
        "source[0].signal.band_hz = [450.0, 50.0]: must be [lower, upper] with lower below upper",
    ),
    (
        POINT.replace("'impulse'", "'sine', frequency_hz = 0, duration_s = 1"),
        "source[0].signal.frequency_hz = 0: must be above 0",
    ),
    (POINT.replace("'impulse'", "'file', path = 'no.wav'"), 'source[0].signal.path = "no.wav": must be a file'),
    (POINT + "[regularisation]\nsaturation = -1", "regularisation.saturation = -1: must be at least 0"),
    (
        POINT + "[regularisation]\nsaturation = 0.5\nsaturation_absolute = 1",
        "regularisation.saturation_absolute = 1.0: must be 0 or left out where saturation is given",
    ),
    (POINT + "[output]\nlimit_v = 0", "output.limit_v = 0: must be above 0"),
    (POINT + "[output]\ninterpolation = 'cubic'", 'output.interpolation = "cubic": must be "nearest", "bilinear"'),
    (POINT + "[output]\nemission = 'x'", 'output.emission = "x": unknown key; it belongs to [[source]]'),
]


@pytest.mark.parametrize(("text", "complaint"), MISTAKES, ids=[complaint[:50] for _, complaint in MISTAKES])
def test_mistake_in_a_scene_file_is_one_line_with_file_key_value_and_what_is_allowed(tmp_path, text, complaint):
    with pytest.raises(InputError) as told:
        scene_of(tmp_path, text)
    assert str(told.value).startswith(f"{tmp_path / 'scene.toml'}: {complaint}")
    assert str(told.value).isprintable()
