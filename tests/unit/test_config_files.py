"""Files of rigs, runs and scenes: what they mean, and the one sentence for each mistake in them."""

import json
import math
import re

import numpy as np
import pytest

from wavefocus import InputError, Source, load_scene
from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.config.fields import tables_of
from wavefocus.config.loading import MAX_KEY_PARTS, parse_toml
from wavefocus.config.rig import RigConfig, default_rig
from wavefocus.config.run import RunConfig
from wavefocus.config.scene import Output, Regularisation, SceneConfig
from wavefocus.configuration import configuration_from_json, load_rig, load_run
from wavefocus.rendering.scene import paths, signals
from wavefocus.rendering.scene.paths import TextPath
from wavefocus.rendering.scene.svg import SvgPath

POSITIONS = np.array([[0.0, 0.0], [4.0, 0.0]])
LOADS = {"rig": load_rig, "run": load_run, "scene": load_scene}


def write(folder, text, name="run.toml"):
    file = folder / name
    file.write_text(text, encoding="utf-8")
    return file


def complaint_about(file, load=load_run):
    with pytest.raises(InputError) as told:
        load(file)
    message = str(told.value)
    assert message.isprintable()  # one line
    return message


NI = "[recorder]\ndriver = 'nidaqmx'\ndevice = 'Dev1'\n"
GENERIC = "[mirror]\ndriver = 'generic'\nport = 'COM3'\n"
POINT = "[[source]]\npath = { kind = 'point', at_mm = [1, 2] }\nsignal = { kind = 'impulse' }\n"
CIRCLE = "[[source]]\npath = { kind = 'circle', radius_mm = 3 }\nsignal = { kind = 'impulse' }\n"


def moving(path):
    return f"[[source]]\nspeed_mm_s = 80\nstep_mm = 4\nsignal = {{ kind = 'impulse' }}\npath = {path}"


RIG_MISTAKES = [
    ("[surface]\nlength_m = 0.25", "surface.length_m = 0.25: unknown key; did you mean length_mm?"),
    ("[surface]\nkind = 'oval'", 'surface.kind = "oval": must be "stadium", "rectangle", "disk" or "polygon"'),
    ("[surface]\nkind = 'disk'\nwidth_mm = 100", "surface.width_mm = 100.0: must be length_mm = 250"),
    ("[surface]\nkind = 'polygon'", "surface.corners_mm: must be given"),
    ("[surface]\nkind = 'polygon'\ncorners_mm = [[0, 0], [0, 9], [9, 9]]", "surface.corners_mm"),
    ("[surface]\nlength_mm = 100", "surface.width_mm = 150.0: must be at most length_mm = 100"),
    ("[actuators]\nposition_mm = []", "actuators.position_mm = []: must have at least 1 entries, has 0"),
    ("[actuators]\nposition_mm = [[0, 0], [1]]", "actuators.position_mm[1][1]: is missing"),
    ("[actuators]\nposition_mm = [[0, nan]]", "actuators.position_mm[0][1] = nan: must be a finite number"),
    ("[actuators]\nposition_mm = [[0, 0, 0]]", "actuators.position_mm[0] = [0, 0, 0]: must have at most 2 entries"),
    ("[actuators]\nposition_mm = [[0, 0], [0, 80]]", "actuators.position_mm[1] = [0.0, 80.0]: must be on the surface"),
    ("[actuators]\nposition_mm = [[1, 2], [0, 0], [1, 2]]", "actuators.position_mm[2] = [1.0, 2.0]: is already the"),
    ("[mirror]\ndriver = 'asi'", 'mirror.driver = "asi": must be "virtual", "analog", "asi-tiger", "generic"'),
    ("[mirror]\ndriver = 'asi-tiger'", 'mirror.port: is missing; driver "asi-tiger" needs it, such as "/dev/ttyUSB0"'),
    ("[mirror]\nport = 'COM3'", 'mirror.port = "COM3": belongs to driver "asi-tiger", "generic"'),
    ("[mirror]\ndriver = 'generic'\nport = 'socket://somewhere'",
     'mirror.port = "socket://somewhere": must be socket://HOST:PORT'),
    ("[mirror]\ndriver = 'generic'\nport = 'serial-number:'",
     'mirror.port = "serial-number:": must be serial-number: and the number itself'),
    (GENERIC, 'recorder.driver = "virtual": a rig\'s instruments are all virtual or'),
    (NI, 'recorder.driver = "nidaqmx": a rig\'s instruments are all virtual or'),
    ("[vibrometer]\ndriver = 'polytec-ofv5000'\nport = 'COM4'",
     'vibrometer.driver = "polytec-ofv5000": a rig\'s instruments are all virtual or all real, and these are virt'),
    ("[mirror]\nmap = [[1, 0, 0], [0, 1, 0], [1, 1, 0]]",
     "mirror.map = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]: must be a matrix that can be"),
    ("[mirror]\ndistance_mm = 900\nmap = [[1, 0, 0], [0, 1, 0], [0, 0, 900]]",
     "mirror.distance_mm = 900.0: must be left out where map is given"),
    (NI + "address = 'daq:31763'\ntls_root = 'none.pem'", 'recorder.tls_root = "none.pem": must be a file'),
    ("[mirror]\npark_mrad = [0, 300]", "mirror.park_mrad = [0.0, 300.0]: must be within limit_mrad = 250"),
    ("[recorder]\ndriver = 'nidaqmx'", 'recorder.device: is missing; driver "nidaqmx" needs the name that NI MAX'),
    ("[recorder]\ntrigger = 'PFI0'", 'recorder.trigger = "PFI0": belongs to driver "nidaqmx"; the driver here is'),
    (NI + "reference_input = 'ai1'", 'recorder.response_input = "ai1": is already the reference_input'),
    (NI + "response_input = 'Dev1/ai1'", 'recorder.response_input = "Dev1/ai1": must be "ai0", "ai1" and so on'),
    (NI + "address = 'localhost'", 'recorder.address = "localhost": must be HOST:PORT of a gRPC Device Server'),
    (NI + f"tls_root = '{__file__}'",
     f"recorder.tls_root = {json.dumps(__file__)}: must be left out, or an address given"),
    (NI + f"address = 'a:1'\ntls_root = '{__file__}'\ntls_key = '{__file__}'",
     f"recorder.tls_key = {json.dumps(__file__)}: needs tls_root and tls_certificate"),
    ("[player]\nchannel_full_scale_v = [5.0, 5.0]", "player.channel_full_scale_v = [5.0, 5.0]: must have one entry"),
    ("[calibration]\nfile = 'nowhere.toml'", 'calibration.file = "nowhere.toml": must be a file; none found from'),
    ("[calibration]\nmeasured = {}", "calibration.measured: comes from the file that calibration.file names"),
    ("[[usb]]\nrole = 'camera'\nvendor_id = 1\nproduct_id = 1", 'usb[0].role = "camera": must be "mirror", "recorder"'),
    ("[usb]\nrole = 'mirror'", "usb: must be a list of tables, each under [[usb]]"),
    ("[emulation]\ndead_actuators = [20]", "emulation.dead_actuators[0] = 20: must be below 20, the number of"),
    ("[emulation]\ndead_actuators = [1]\nweak_actuators = [3, 1]", "emulation.weak_actuators[1] = 1: is already one"),
    ("[[emulation.fault_plan]]\nrole = 'player'\nkind = 'silent'\nat_call = 1",
     "emulation.fault_plan[0] = { role, kind, at_call }: fault kind of the player is 'silent'; allowed: underflow"),
    ("[[emulation.fault_plan]]\nrole = 'player'\nkind = 'lost'\nposition = 1\nat_call = 1",
     "emulation.fault_plan[0].position = 1: unknown key; "),
    ("[player]\nchannels = [0, 1]", "player.channels = [0, 1]: must have one entry per actuator, 20 in all, has 2"),
    ("[player]\nloopback_channel = 3", "player.loopback_channel = 3: is already the channel of actuator 3"),
    ("[player]\nlimit_v = 6", "player.limit_v = 6.0: must be at most full_scale_v = 5"),
    ("[watch.noise]\nsettle_s = 1", "watch.noise.leaves_below: is needed"),
    ("[watch.noise]\nleaves_above = 1\nreturns_below = 2", "watch.noise.leaves_above = 1"),
    ("[watch.room]\nleaves_below = 18\nreturns_above = 17", "watch.room.returns_above = 17"),
    ("[watch.room]\nleaves_below = 18\nleaves_above = 18.5", "watch.room.returns_below"),
    ("[watch.wind]\nleaves_above = 1", "watch.wind"),
    (GENERIC + NI + "[player]\ndriver = 'sounddevice'\ndevice = 'USB'\n[watch.light]\nleaves_below = 0.2",
     'watch.light = "...": needs a vibrometer that reports it'),
    ("[actuators]\nposition_mm = [[0, 0], [1, 1]]\n[player]\nchannels = [4, 4]",
     "player.channels[1] = 4: is already the channel of actuator 0"),
    ("[camera]\ndriver = 'x'", "camera = { driver }: unknown key; allowed: rig, surface, actuators, mirror"),
    ("actuators = 3", "actuators = 3: must be a table"),
]  # fmt: skip

RUN_MISTAKES = [
    ("[virtual]\nplate = 'thin'", 'virtual.plate = "thin": needs kind = "rectangle"'),
    ("[virtual]\nquality = 3", 'virtual.quality = 3.0: belongs to plate = "thin"'),
    ("[virtual]\nplate = 'solid'\nshear_speed_m_s = 9", "virtual.pressure_speed_m_s = 9.4: must be above 10.39, 2 /"),
    ("[grid]\nspacing_m = 4", "grid.spacing_m = 4: unknown key; did you mean spacing_mm?"),
    ("[grid]\ntaps = 4", "grid.taps = 4: unknown key; it belongs to [capture]"),
    ("[grid]\ncolour = 4", "grid.colour = 4: unknown key; allowed: lattice, spacing_mm, margin_mm, positions_file"),
    ("[gird]\nspacing_mm = 4", "gird = { spacing_mm }: unknown key; did you mean grid?"),
    ("[grid]\nspacing_mm = '4'", 'grid.spacing_mm = "4": must be a number'),
    ("[grid]\nspacing_mm = true", "grid.spacing_mm = true: must be a number"),
    ("[grid]\nspacing_mm = 1e-6", "grid.spacing_mm = 1e-06: gives more than 1,000,000 positions"),
    ("[grid]\nspacing_mm = 1e6", "grid.spacing_mm = 1e+06: leaves no position"),
    ("[grid]\nmargin_mm = 75", "grid.margin_mm = 75: "),
    ("[grid]\npositions_file = 'x.csv'", 'grid.positions_file = "x.csv": must be a file'),
    ("[sweep]\nstop_hz = 5000", "sweep.stop_hz = 5000.0: must be below 5000 (half of capture.sample_rate_hz)"),
    ("[sweep]\nstop_hz = 20", "sweep.stop_hz = 20.0: must be above start_hz = 20"),
    ("[sweep]\namplitude_v = 5.1", "sweep.amplitude_v = 5.1: must be at most player.limit_v = 5 of the rig"),
    ("[capture]\naverages = 2.5", "capture.averages = 2.5: must be a whole number"),
    ("[capture]\ntaps = 2001", "capture.taps = 2001: must be at most 2000 (decay_s * sample_rate_hz)"),
    ("[capture]\ndecay_s = 0.1", "capture.taps = 2000: must be at most 1000 (decay_s * sample_rate_hz)"),
    ("[capture]\nstagger_s = 0.239", "capture.stagger_s = 0.239: must be at least 0.24 (1.2 times the response"),
    ("[capture]\ngroups = 21", "capture.groups = 21: must be at most 20, the number of actuators"),
    ("[settled]\nreason = 'a'", "settled: comes from the trial before a staggered campaign"),
    ("[capture]\nkeep_raw = 1", "capture.keep_raw = 1: must be true or false"),
    ("[drift]\nstop_level_db = 0.1", "drift.stop_level_db = 0.1"),
    ("[drift]\nstop_delay_samples = 0.1", "drift.stop_delay_samples = 0.1"),
    ("[drift]\nstop_correlation = 0.99", "drift.stop_correlation = 0.99"),
    ("[virtual]\nroom_c = [[5, 20], [1, 21]]", "virtual.room_c"),
    ("[virtual]\nfinger = { place_mm = [0, 73] }", "virtual.finger.place_mm = [0, 73]: must be on the surface, 3 mm"),
    ("[virtual]\nfault_plan = 'f.toml'", 'virtual.fault_plan = "f.toml": must be a file'),
    ("[[virtual.fault_plan]]\nrole = 'player'", "virtual.fault_plan[0].operation: is missing"),
    ("[[virtual.fault_plan]]\nrole = 'laser'\noperation = 'read'\nkind = 'lost'\nposition = 1",
     "virtual.fault_plan[0] = { role, operation, kind, position }: fault role is 'laser'; allowed: mirror"),
    ("[[virtual.fault_plan]]\nrole = 'mirror'\noperation = 'play'\nkind = 'lost'\nat_call = 1",
     "virtual.fault_plan[0] = { role, operation, kind, at_call }: fault operation of the mirror is 'play'; allowed"),
    ("[[virtual.fault_plan]]\nrole = 'player'\noperation = 'wait'\nkind = 'lost'",
     "virtual.fault_plan[0] = { role, operation, kind }: a fault needs either at_call"),
    ("[grid]\nspacing_mm=0\nmargin_mm=-1\n[sweep]\nstart_hz=0\nstop_hz=0\nduration_s=0",
     "grid.spacing_mm = 0: must be above 0; grid.margin_mm = -1: must be at least 0; sweep.start_hz = 0: must be above "
     "0; and 2 more"),
    ("rig = 'lab.toml'", 'rig = "lab.toml": must be a file'),
    ("rig = ''", 'rig = "": must not be empty'),
    ("rig = 3", "rig = 3: must be text in quotes"),
    ('rig = "C:\\lab.toml"', "not TOML: Unescaped '\\' in a string (at line 1, column 12); a path stands in single"),
    ('rig = "C:\\users\\a.toml"', "not TOML: Invalid hex value (at line 1, column 12); a path stands in single quo"),
    ("rig = \n", "not TOML: Invalid value (at line 1, column 7)"),
    ("a = " + "[" * 50_000, "not TOML"),
    ("a = " + "9" * 50_000, "not TOML"),
]  # fmt: skip

SCENE_MISTAKES = [
    ("", "source: is missing"),
    ("[[sources]]\nstart_s = 0", "source: is missing; sources = [{ start_s }]: unknown key; did you mean source?"),
    ("[[source]]\nsignal = { kind = 'impulse' }", "source[0].path: is missing"),
    (moving("{ kind = 'square' }"), 'source[0].path.kind = "square": must be one of "point", "line", "circle"'),
    (moving("{ radius_mm = 3 }"), "source[0].path = { radius_mm }: must have a kind"),
    (moving("'circle'"), 'source[0].path = "circle": must be a table'),
    (moving("{ kind = 'circle', radius_cm = 3 }"), "source[0].path.radius_mm: is missing; "),
    (moving("{ kind = 'circle', radius_mm = 3, radius_cm = 3 }"), "source[0].path.radius_cm = 3: unknown key; did"),
    (moving("{ kind = 'circle', radius_mm = -3 }"), "source[0].path.radius_mm = -3: must be at least 0"),
    (moving("{ kind = 'svg', file = 'no.svg' }"), 'source[0].path.file = "no.svg": must be a file'),
    (moving("{ kind = 'text', string = '', height_mm = 3 }"), 'source[0].path.string = "": must not be empty'),
    (CIRCLE + "step_mm = 4", "source[0].speed_mm_s: is needed in mm/s for a path of kind circle"),
    (CIRCLE + "speed_mm_s=4", "source[0].step_mm: is needed in mm for a path of kind circle"),
    (POINT + POINT + "start_s = -1", "source[1].start_s = -1: must be at least 0"),
    (POINT.replace("'impulse'", "'beep'"), 'source[0].signal.kind = "beep": must be one of "impulse", "sine"'),
    (POINT.replace("'impulse'", "'noise', band_hz = [450, 50], duration_s = 1"),
     "source[0].signal.band_hz = [450.0, 50.0]: must be [lower, upper] with lower below upper"),
    (POINT.replace("'impulse'", "'file', path = 'no.wav'"), 'source[0].signal.path = "no.wav": must be a file'),
    (POINT + "[regularisation]\nsaturation = 0.5\nsaturation_absolute = 1",
     "regularisation.saturation_absolute = 1.0: must be 0 or left out where saturation is given"),
    (POINT + "[output]\ninterpolation = 'cubic'", 'output.interpolation = "cubic": must be "nearest", "bilinear"'),
    (POINT + "[output]\nemission = 'x'", 'output.emission = "x": unknown key; it belongs to [[source]]'),
    (POINT + "[[quiet]]", "quiet[0].at_mm: a quiet place has either at_mm, or path with speed_mm_s"),
    (POINT + "[[quiet]]\nat_mm = [24, 0]\nat = 3", "quiet[0].at = 3: unknown key; "),
    (POINT + "[[quiet]]\nat_mm = [24, 0]\npath = { kind = 'point', at_mm = [0, 0] }", "quiet[0].path = "),
    (POINT + "[[quiet]]\npath = { kind = 'line', start_mm = [0, 0], end_mm = [9, 0] }",
     "quiet[0].speed_mm_s: is needed in mm/s for a path of kind line"),
]  # fmt: skip

MISTAKES = {"rig": RIG_MISTAKES, "run": RUN_MISTAKES, "scene": SCENE_MISTAKES}


@pytest.mark.parametrize(
    ("kind", "text", "complaint"),
    [pytest.param(kind, *one, id=f"{kind}: {one[1][:50]}") for kind, table in MISTAKES.items() for one in table],
)
def test_a_mistake_in_a_file_is_one_line_with_file_key_value_and_what_is_allowed(tmp_path, kind, text, complaint):
    file = write(tmp_path, text, f"{kind}.toml")
    assert complaint_about(file, LOADS[kind]).startswith(f"{file}: {complaint}")


def test_an_empty_run_file_is_the_default_campaign_on_20_actuators(tmp_path):
    there = load_run(write(tmp_path, ""))
    assert (there.run, there.rig, there.position_mm.shape) == (RunConfig(), default_rig(), (1500, 2))
    assert (there.rig.is_virtual, there.rig.actuator_mm.shape) == (True, (20, 2))
    assert (there.rig.player.channels, there.rig.player.loopback_channel) == (tuple(range(20)), 20)
    angles_mrad = MirrorMap(there.rig.mirror.matrix).angles_mrad([0.0, 100.0], [0.0, -50.0])
    np.testing.assert_allclose(angles_mrad, [[0, 1000 * math.atan(0.1)], [0, -1000 * math.atan(0.05)]])


def test_a_rig_of_its_own_gets_channels_and_a_rim_and_its_weakest_output_limits_it():
    rig = RigConfig.model_validate({"actuators": {"position_mm": [[0, 0], [10, 0], [0, 10]]}})
    assert (rig.player.channels, rig.player.loopback_channel) == ((0, 1, 2), 3)
    rig = RigConfig.model_validate({"surface": {"length_mm": 100, "width_mm": 60}})
    assert rig.actuator_mm[0].tolist() == [44, 0]
    player = {"channels": [0, 1, 2], "loopback_channel": 3, "channel_full_scale_v": [4.0, 3.0, 5.0, 1.0]}
    rig = RigConfig.model_validate({"actuators": {"position_mm": [[0, 0], [1, 0], [2, 0]]}, "player": player})
    assert rig.player.largest_v == 3.0


REAL = """
mirror = { driver = "asi-tiger", port = "serial-number:A9" }
recorder = { driver = "nidaqmx", device = "Dev1", trigger = "" }
player = { driver = "sounddevice", device = "interface" }
vibrometer = { driver = "polytec-ofv5000", port = "COM4" }
usb = [{ role = "recorder", vendor_id = 0x3923, product_id = 0x7179 }]
"""


def test_real_rig_says_outright_what_its_drivers_take_where_they_are_told_nothing(tmp_path):
    rig = load_rig(write(tmp_path, REAL))
    assert (rig.is_virtual, rig.mirror.baud, rig.mirror.beam_per_mirror) == (False, None, 2.0)
    recorder, player = rig.recorder, rig.player
    assert (recorder.reference_input, recorder.response_input, recorder.trigger) == ("ai0", "ai1", None)
    assert (player.block_frames, player.outputs, player.output_full_scale_v) == (0, 21, (5.0,) * 21)
    assert (rig.vibrometer.decoder, rig.vibrometer.sensitivity_m_s_per_v) == (1, None)
    assert rig.usb[0].vendor_id == 0x3923
    assert RigConfig.model_validate_json(rig.model_dump_json()) == rig


@pytest.mark.parametrize(
    ("text", "area_mm2", "size_mm"),
    [
        ("[surface]\nkind = 'rectangle'\nlength_mm = 100\nwidth_mm = 120", 12_000.0, (100.0, 120.0)),
        ("[surface]\nkind = 'disk'\nlength_mm = 100", math.pi * 2500, (100.0, 100.0)),
        (
            "[surface]\nkind = 'polygon'\ncorners_mm = [[-10, 0], [40, 0], [0, 30]]\n"
            "[actuators]\nposition_mm = [[5, 5]]", 750.0, (80.0, 60.0),
        ),
    ],
)  # fmt: skip
def test_given_another_kind_of_surface_then_outline_and_size_are_its_own(tmp_path, text, area_mm2, size_mm):
    rig = load_rig(write(tmp_path, text))
    assert rig.surface.outline.area_mm2 == pytest.approx(area_mm2)
    assert (rig.surface.length_mm, rig.surface.width_mm) == size_mm
    assert rig.surface.outline.contains(rig.actuator_mm).all()


def numbers_beyond_a_bound():
    """Every number of rigs, runs and scenes, beyond each of its bounds: file, table, key, value and sentence."""
    for kind, model in (("rig", RigConfig), ("run", RunConfig), ("scene", SceneConfig)):
        for table in model.model_fields:
            for inner in tables_of(model, table):
                for key, field in inner.model_fields.items():
                    for mark in field.metadata:
                        for bound, words in (("gt", "above"), ("ge", "at least"), ("lt", "below"), ("le", "at most")):
                            if (limit := getattr(mark, bound, None)) is not None:
                                value = limit + {"ge": -1, "le": 1}.get(bound, 0)
                                yield kind, table, key, value, f"must be {words} {limit:g}"


def test_a_number_beyond_any_bound_of_any_key_is_refused_with_key_value_and_bound(tmp_path):
    cases = list(numbers_beyond_a_bound())
    assert len(cases) > 60
    for kind, table, key, value, sentence in cases:
        heading = {"usb": "[[usb]]", "source": POINT, "quiet": "[[quiet]]\nat_mm = [0, 0]"}.get(table, f"[{table}]")
        complaint = complaint_about(write(tmp_path, f"{heading}\n{key} = {value}", f"{kind}.toml"), LOADS[kind])
        of_banks = key == "regular_positions"
        assert of_banks or re.search(rf"[:;] {table}.*\.{key}( = [-+.\de]+)?: {re.escape(sentence)}", complaint)


def test_a_key_of_too_many_parts_is_refused_with_its_line_and_other_dots_are_read():
    for text in (
        "a" + ".a" * 450_000 + " = 1\n", "[a" + ".a" * 450_000 + "]\n", "[[a" + ' . "a"' * 200_000 + "]]\n",
        "x = { 'a'" + ".'a'" * 200_000 + " = 1 }\n", "x = 1\ny" + ".y" * (MAX_KEY_PARTS + 1) + " = 1\n",
    ):  # fmt: skip
        with pytest.raises(InputError, match=r"^deep\.toml: not TOML: line [12]: a key of more than 16 parts"):
            parse_toml(text, "deep.toml")
    for text in ("a.b.c.d = 1", f'text = "{"one. " * 100}"', f"x = [{'1.5, ' * 100}]", "x = 1 # " + ". " * 100):
        assert parse_toml(text, "plain.toml")


def test_a_file_that_is_none_or_not_utf8_is_told_in_one_line_by_name_and_line(tmp_path):
    file = write(tmp_path, 'rig = "a\\nb.toml"\n', name="run\n1.toml")
    assert complaint_about(file).startswith(f'{tmp_path}/run\\n1.toml: rig = "a\\nb.toml"')
    for name in ("missing.toml", "", "x" * 300):
        assert complaint_about(tmp_path / name).startswith(f"{tmp_path / name}: ")
    file = tmp_path / "run.toml"
    file.write_bytes("# für\nrig = 'ü'\n".encode("latin-1"))
    assert complaint_about(file) == f"{file}: line 1: not UTF-8 text; save the file as UTF-8"


def test_a_positions_file_replaces_the_grid_and_its_mistakes_have_its_lines(tmp_path):
    positions = write(tmp_path, "x_mm,y_mm\n0,0\n130,0\n", name="grid.csv")
    file = write(tmp_path, "[grid]\npositions_file = 'grid.csv'")
    assert complaint_about(file).startswith(f"{positions}: line 3: (130, 0) mm lies outside the surface")
    write(tmp_path, "x_mm,y_mm\n0,0\n4,0\n", name="grid.csv")
    configuration = load_run(write(tmp_path, "[grid]\npositions_file = 'grid.csv'\nspacing_mm = 8"))
    assert configuration.position_mm.tolist() == [[0, 0], [4, 0]]


def test_a_rig_file_is_found_beside_the_run_file_its_mistakes_and_limits_named(tmp_path):
    file, rig = write(tmp_path, "rig = 'rig.toml'"), write(tmp_path, "[rig]\nname = 'bench'", name="rig.toml")
    assert load_run(file).rig.rig.name == "bench"
    rig.write_text("[surface]\nwidth_mm = 0")
    assert complaint_about(file) == f"{rig}: surface.width_mm = 0: must be above 0"
    rig.write_text("[mirror]\nlimit_mrad = 100\npark_mrad = [0, 0]")
    complaint = complaint_about(file)
    assert "grid: position " in complaint
    assert complaint.endswith("mrad; the rig's mirror.limit_mrad = 100")
    rig.write_text("[recorder]\nreference_range_v = 1\nreference_gain = 2")
    assert "sweep.amplitude_v = 1: must be at most 0.5" in complaint_about(file)
    rig.write_text(REAL)
    file = write(tmp_path, "rig = 'rig.toml'\nvirtual = { seed = 2 }")
    assert complaint_about(file).startswith(f"{file}: virtual: is only for a virtual rig")


@pytest.mark.parametrize(
    "text", ["", "[capture]\ntaps = 3000\ndecay_s = 0.3\n[virtual]\nnoise_v = 1e-3\nfault_plan = 'f.toml'"]
)
def test_configuration_and_its_fault_plan_survive_the_bank_and_keep_their_hash(tmp_path, text):
    write(tmp_path, "[[fault]]\nrole='recorder'\noperation='read'\nkind='short_read'\nposition=3\n", name="f.toml")
    there = load_run(write(tmp_path, text))
    if there.run.virtual is not None:
        assert [(fault.role, fault.position) for fault in there.run.virtual.fault_plan] == [("recorder", 3)]
    back = configuration_from_json(
        there.rig.model_dump_json(), there.run.model_dump_json(), there.position_mm, "bank.h5"
    )
    assert (back.run, back.rig) == (there.run, there.rig)
    assert back.plan_sha256 == there.plan_sha256
    older = there.run.model_dump_json().replace("short_read", "a kind of earlier versions")
    opened = configuration_from_json(there.rig.model_dump_json(), older, there.position_mm, "bank.h5")
    assert opened.plan_sha256 == there.plan_sha256


@pytest.mark.parametrize("text", ["{", "[]", '{"grid": {"spacing_mm": NaN}}', "[" * 50_000])
def test_bank_with_a_spoilt_configuration_is_told_in_one_line(text):
    with pytest.raises(InputError, match=re.escape("bank.h5: attribute run: ")):
        configuration_from_json(default_rig().model_dump_json(), text, POSITIONS, "bank.h5")


CONTRACT_EXAMPLE = """
scene.name = "circle"
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

[output]
interpolation = "nearest"
limit_v = 1.0
"""


def scene_of(folder, text):
    return load_scene(write(folder, text, "scene.toml"))


def test_the_contracts_example_is_built_to_the_letter_and_a_point_has_defaults(tmp_path):
    scene = scene_of(tmp_path, CONTRACT_EXAMPLE)
    written = SceneConfig.model_validate(parse_toml(CONTRACT_EXAMPLE, ""))
    assert SceneConfig.model_validate_json(written.model_dump_json()) == written
    circle, noise = paths.Circle((0, 0), 30, 1, 0), signals.Noise((50, 450), 0.05, 1)
    assert (scene.name, *scene.sources) == ("circle", Source(circle, noise, 0, 80, 4, 1, "per_point"))
    assert scene.regularisation == Regularisation(saturation=0.5)
    assert scene.output == Output(interpolation="nearest", limit_v=1.0)
    scene = scene_of(tmp_path, POINT)
    assert scene.sources == (Source(paths.Point((1, 2)), signals.Impulse(), 0, 0, 0, 1, "continuous"),)
    assert scene.regularisation == Regularisation(saturation=0.0, saturation_absolute=0.0, normalise=True)
    assert scene.output == Output(interpolation="auto")


@pytest.mark.parametrize(
    ("table", "built"),
    [
        ("{ kind = 'line', start_mm = [0, 1], end_mm = [2, 3] }", paths.Line((0, 1), (2, 3))),
        ("{ kind = 'circle', radius_mm = 5 }", paths.Circle((0, 0), 5, 1, 0)),
        ("{ kind = 'polyline', points_mm = [[0, 0], [1, 0]], closed = true }", paths.Polyline(((0, 0), (1, 0)), True)),
        ("{ kind = 'sine', frequency_hz = 200, duration_s = 0.1 }", signals.Sine(200, 0.1)),
        ("{ kind = 'noise', band_hz = [50, 450], duration_s = 1 }", signals.Noise((50, 450), 1, 0)),
    ],
)
def test_each_table_of_a_path_or_signal_builds_it(tmp_path, table, built):
    of_signals = isinstance(built, signals.Sine | signals.Noise)
    text = POINT.replace("{ kind = 'impulse' }", table) if of_signals else moving(table)
    (source,) = scene_of(tmp_path, text).sources
    assert built in (source.path, source.signal)


# Not in the table: to draw letters loads matplotlib, which whoever collects the tests would wait for.
def test_a_table_of_a_text_builds_it(tmp_path):
    table = "{ kind = 'text', string = 'ab', height_mm = 9, centre_mm = [1, 2] }"
    (source,) = scene_of(tmp_path, moving(table)).sources
    assert source.path == TextPath("ab", 9, (1, 2))


def test_files_are_found_beside_the_scene(tmp_path):
    (tmp_path / "a.svg").write_text('<svg><path id="p" d="M 0 0 L 10 0"/></svg>')
    (tmp_path / "a.wav").write_bytes(b"read when its samples are wanted")
    text = moving("{ kind = 'svg', file = 'a.svg', path_id = 'p', scale = 2, origin_mm = [1, 2] }")
    (source,) = scene_of(tmp_path, text.replace("kind = 'impulse'", "kind = 'file', path = 'a.wav'")).sources
    assert source.path == SvgPath(tmp_path / "a.svg", "p", 2, (1, 2))
    assert source.signal == signals.SoundFile(tmp_path / "a.wav")
    complaint = complaint_about(write(tmp_path, text.replace("'p'", "'q'"), "scene.toml"), load_scene)
    assert complaint.startswith(f"{tmp_path / 'scene.toml'}: source[0]: {tmp_path / 'a.svg'}")
