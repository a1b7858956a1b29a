import json
import math

import numpy as np
import pytest

from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.config.rig import RigConfig, default_rig
from wavefocus.configuration import load_rig
from wavefocus.storage.errors import InputError


def test_default_rig_has_20_actuators_on_the_rim_wired_in_order():
    rig = default_rig()
    assert rig.actuator_mm.shape == (20, 2)
    assert rig.actuator_mm[0].tolist() == [119, 0]
    assert rig.player.channels == tuple(range(20))
    assert rig.player.loopback_channel == 20
    assert rig.is_virtual


def test_default_mirror_points_straight_at_the_surface_from_a_metre():
    x_mrad, y_mrad = MirrorMap(default_rig().mirror.matrix).angles_mrad([0.0, 100.0], [0.0, -50.0])
    np.testing.assert_allclose(x_mrad, [0, 1000 * math.atan(0.1)])
    np.testing.assert_allclose(y_mrad, [0, -1000 * math.atan(0.05)])


def test_rig_with_its_own_actuators_gets_a_channel_for_each():
    rig = RigConfig.model_validate({"actuators": {"position_mm": [[0, 0], [10, 0], [0, 10]]}})
    assert rig.player.channels == (0, 1, 2)
    assert rig.player.loopback_channel == 3


def test_rig_of_another_size_gets_its_actuators_on_its_own_rim():
    rig = RigConfig.model_validate({"surface": {"length_mm": 100, "width_mm": 60}})
    assert rig.actuator_mm[0].tolist() == [44, 0]


NI = "[recorder]\ndriver = 'nidaqmx'\ndevice = 'Dev1'\n"
GENERIC = "[mirror]\ndriver = 'generic'\nport = 'COM3'\n"
MISTAKES = [
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
    (
        "[mirror]\ndriver = 'asi-tiger'\nport = 'COM3'\nfull_scale_mrad = 100",
        'mirror.full_scale_mrad = 100.0: belongs to driver "mirrorcle-mti"',
    ),
    ("[mirror]\ndriver = 'mirrorcle-mti'\nport = 'COM3'", "mirror.full_scale_mrad: is missing; driver"),
    (
        "[mirror]\ndriver = 'generic'\nport = 'socket://somewhere'",
        'mirror.port = "socket://somewhere": must be socket://HOST:PORT',
    ),
    (
        "[mirror]\ndriver = 'generic'\nport = 'serial-number:'",
        'mirror.port = "serial-number:": must be serial-number: and the number itself',
    ),
    (GENERIC + "baud = 100", "mirror.baud = 100: must be at least 300"),
    (GENERIC, 'recorder.driver = "virtual": a rig\'s instruments are all virtual or'),
    (NI, 'recorder.driver = "nidaqmx": a rig\'s instruments are all virtual or'),
    (
        "[vibrometer]\ndriver = 'polytec-ofv5000'\nport = 'COM4'",
        'vibrometer.driver = "polytec-ofv5000": a rig\'s instruments are all virtual or all real, and these are virt',
    ),
    ("[vibrometer]\nport = 'COM4'", 'vibrometer.port = "COM4": belongs to driver "polytec-ofv5000" or'),
    ("[vibrometer]\ndriver = 'polytec-ofv5000'", "vibrometer.port: is missing; driver"),
    ("[mirror]\nmap = [[1, 0], [0, 1]]", "mirror.map[0][2]: is missing"),
    (
        "[mirror]\nmap = [[1, 0, 0], [0, 1, 0], [1, 1, 0]]",
        "mirror.map = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]: must be a matrix that can be",
    ),
    (
        "[mirror]\ndistance_mm = 900\nmap = [[1, 0, 0], [0, 1, 0], [0, 0, 900]]",
        "mirror.distance_mm = 900.0: must be left out where map is given",
    ),
    (NI + "address = 'daq:31763'\ntls_root = 'none.pem'", 'recorder.tls_root = "none.pem": must be a file'),
    ("[mirror]\npark_mrad = [0, 300]", "mirror.park_mrad = [0.0, 300.0]: must be within limit_mrad = 250"),
    ("[recorder]\ndriver = 'nidaqmx'", 'recorder.device: is missing; driver "nidaqmx" needs the name that NI MAX'),
    ("[recorder]\ntrigger = 'PFI0'", 'recorder.trigger = "PFI0": belongs to driver "nidaqmx"; the driver here is'),
    (NI + "reference_input = 'ai1'", 'recorder.response_input = "ai1": is already the reference_input'),
    (NI + "response_input = 'Dev1/ai1'", 'recorder.response_input = "Dev1/ai1": must be "ai0", "ai1" and so on'),
    (NI + "terminal = 'single'", 'recorder.terminal = "single": must be "differential", "rse", "nrse" or'),
    (NI + "address = 'localhost'", 'recorder.address = "localhost": must be HOST:PORT of a gRPC Device Server'),
    (
        NI + f"tls_root = '{__file__}'",
        f"recorder.tls_root = {json.dumps(__file__)}: must be left out, or an address given",
    ),
    (
        NI + f"address = 'a:1'\ntls_root = '{__file__}'\ntls_key = '{__file__}'",
        f"recorder.tls_key = {json.dumps(__file__)}: needs tls_root and tls_certificate",
    ),
    ("[player]\ndriver = 'sounddevice'", "player.device: is missing; driver"),
    ("[player]\nblock_frames = 64", 'player.block_frames = 64: belongs to driver "sounddevice"'),
    ("[player]\nchannel_full_scale_v = [5.0, 5.0]", "player.channel_full_scale_v = [5.0, 5.0]: must have one entry"),
    ("[recovery]\ngive_up_after_s = -1", "recovery.give_up_after_s = -1: must be at least 0"),
    ("[calibration]\nfile = 'nowhere.toml'", 'calibration.file = "nowhere.toml": must be a file; none found from'),
    ("[calibration]\nstale_after_days = 0", "calibration.stale_after_days = 0: must be above 0"),
    ("[calibration]\nmeasured = {}", "calibration.measured: comes from the file that calibration.file names"),
    ("[[usb]]\nrole = 'camera'\nvendor_id = 1\nproduct_id = 1", 'usb[0].role = "camera": must be "mirror", "recorder"'),
    ("[[usb]]\nrole = 'mirror'\nvendor_id = 0x10000", "usb[0].vendor_id = 65536: must be at most 65535"),
    ("[usb]\nrole = 'mirror'", "usb: must be a list of tables, each under [[usb]]"),
    ("[emulation]\nclock_ppm = 2000", "emulation.clock_ppm = 2000: must be at most 1000"),
    ("[emulation]\ndead_actuators = [20]", "emulation.dead_actuators[0] = 20: must be below 20, the number of"),
    ("[emulation]\nreversed_outputs = [0, 21]", "emulation.reversed_outputs[1] = 21: must be below 21, the number of"),
    ("[emulation]\ndead_actuators = [1]\nweak_actuators = [3, 1]", "emulation.weak_actuators[1] = 1: is already one"),
    (
        "[[emulation.fault_plan]]\nrole = 'player'\nkind = 'silent'\nat_call = 1",
        "emulation.fault_plan[0] = { role, kind, at_call }: fault kind of the player is 'silent'; allowed: underflow",
    ),
    (
        "[[emulation.fault_plan]]\nrole = 'player'\nkind = 'lost'\nposition = 1\nat_call = 1",
        "emulation.fault_plan[0].position = 1: unknown key; ",
    ),
    ("[recorder]\nresponse_range_v = 0", "recorder.response_range_v = 0: must be above 0"),
    ("[recorder]\ninter_channel_delay_s = 5", "recorder.inter_channel_delay_s = 5: must be at most 0.001"),
    ("[player]\nchannels = [0, 1]", "player.channels = [0, 1]: must have one entry per actuator, 20 in all, has 2"),
    ("[player]\nloopback_channel = 3", "player.loopback_channel = 3: is already the channel of actuator 3"),
    ("[player]\nlimit_v = 6", "player.limit_v = 6.0: must be at most full_scale_v = 5"),
    ("[player]\nlimit_v = -1", "player.limit_v = -1: must be above 0"),
    ("[watch.noise]\nsettle_s = 1", "watch.noise.leaves_below: is needed"),
    ("[watch.noise]\nleaves_above = 1\nreturns_below = 2", "watch.noise.leaves_above = 1"),
    ("[watch.room]\nleaves_below = 18\nreturns_above = 17", "watch.room.returns_above = 17"),
    ("[watch.room]\nleaves_below = 18\nleaves_above = 18.5", "watch.room.returns_below"),
    ("[watch.noise]\nleaves_above = true", "watch.noise.leaves_above = true"),
    ("[watch]\nprobe_every_s = 0", "watch.probe_every_s = 0"),
    ("[watch.wind]\nleaves_above = 1", "watch.wind"),
    ("[recovery]\nhung_after_s = 0", "recovery.hung_after_s = 0"),
    (
        GENERIC + "[recorder]\ndriver = 'nidaqmx'\ndevice = 'Dev1'\n[player]\n"
        "driver = 'sounddevice'\ndevice = 'USB'\n[watch.light]\nleaves_below = 0.2",
        'watch.light = "...": needs a vibrometer that reports it',
    ),
    (
        "[actuators]\nposition_mm = [[0, 0], [1, 1]]\n[player]\nchannels = [4, 4]",
        "player.channels[1] = 4: is already the channel of actuator 0",
    ),
    ("[camera]\ndriver = 'x'", "camera = { driver }: unknown key; allowed: rig, surface, actuators, mirror"),
    ("actuators = 3", "actuators = 3: must be a table"),
]


@pytest.mark.parametrize(("text", "complaint"), MISTAKES, ids=[complaint[:40] for _, complaint in MISTAKES])
def test_mistake_in_a_rig_file_is_one_line_with_file_key_value_and_what_is_allowed(tmp_path, text, complaint):
    file = tmp_path / "rig.toml"
    file.write_text(text)
    with pytest.raises(InputError) as told:
        load_rig(file)
    assert str(told.value).startswith(f"{file}: {complaint}")
    assert str(told.value).isprintable()


REAL = """
[mirror]
driver = "asi-tiger"
port = "serial-number:A9"

[recorder]
driver = "nidaqmx"
device = "Dev1"
trigger = ""

[player]
driver = "sounddevice"
device = "interface"

[vibrometer]
driver = "polytec-ofv5000"
port = "COM4"

[[usb]]
role = "recorder"
vendor_id = 0x3923
product_id = 0x7179
"""


def real(tmp_path, text=""):
    file = tmp_path / "rig.toml"
    file.write_text(REAL + text)
    return load_rig(file)


def test_real_rig_says_outright_what_its_drivers_take_where_they_are_told_nothing(tmp_path):
    rig = real(tmp_path)
    assert not rig.is_virtual
    assert (rig.mirror.baud, rig.mirror.beam_per_mirror, rig.mirror.tolerance_mrad) == (None, 2.0, 0.5)
    recorder = rig.recorder
    assert (recorder.reference_input, recorder.response_input, recorder.terminal) == ("ai0", "ai1", "differential")
    assert recorder.trigger is None
    assert (rig.player.block_frames, rig.player.outputs) == (0, 21)
    assert rig.player.output_full_scale_v == (5.0,) * 21
    assert (rig.vibrometer.decoder, rig.vibrometer.sensitivity_m_s_per_v) == (1, None)
    assert rig.usb[0].vendor_id == 0x3923
    assert rig.recovery.give_up_after_s == 600
    assert RigConfig.model_validate_json(rig.model_dump_json()) == rig


def test_weakest_output_limits_what_may_be_asked_of_an_actuator():
    volts = [4.0, 3.0, 5.0, 1.0]
    player = {"channels": [0, 1, 2], "loopback_channel": 3, "channel_full_scale_v": volts}
    rig = RigConfig.model_validate({"actuators": {"position_mm": [[0, 0], [1, 0], [2, 0]]}, "player": player})
    assert rig.player.largest_v == 3.0


@pytest.mark.parametrize(
    ("text", "area_mm2", "size_mm"),
    [
        ("[surface]\nkind = 'rectangle'\nlength_mm = 100\nwidth_mm = 120", 12_000.0, (100.0, 120.0)),
        ("[surface]\nkind = 'disk'\nlength_mm = 100", math.pi * 2500, (100.0, 100.0)),
        (
            "[surface]\nkind = 'polygon'\ncorners_mm = [[-10, 0], [40, 0], [0, 30]]\n"
            "[actuators]\nposition_mm = [[5, 5]]",
            750.0,
            (80.0, 60.0),
        ),
    ],
)
def test_given_another_kind_of_surface_then_outline_and_size_are_its_own(tmp_path, text, area_mm2, size_mm):
    (tmp_path / "rig.toml").write_text(text)
    rig = load_rig(tmp_path / "rig.toml")
    assert rig.surface.outline.area_mm2 == pytest.approx(area_mm2)
    assert (rig.surface.length_mm, rig.surface.width_mm) == size_mm
    assert rig.surface.outline.contains(rig.actuator_mm).all()
