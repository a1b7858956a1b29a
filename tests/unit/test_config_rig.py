from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from calibration.errors import InputError
from wavefocus.config.loading import load_rig
from wavefocus.config.rig import RigConfig, default_rig


def test_default_rig_has_20_actuators_on_the_rim_wired_in_order() -> None:
    rig = default_rig()
    assert rig.actuator_mm.shape == (20, 2)
    assert rig.actuator_mm[0].tolist() == [119, 0]
    assert rig.player.channels == tuple(range(20))
    assert rig.player.loopback_channel == 20
    assert rig.is_virtual


def test_default_mirror_points_straight_at_the_surface_from_a_metre() -> None:
    angles = default_rig().mirror.angles_mrad(np.array([[0.0, 0.0], [100.0, -50.0]]))
    np.testing.assert_allclose(angles, [[0, 0], [1000 * math.atan(0.1), -1000 * math.atan(0.05)]])


def test_rig_with_its_own_actuators_gets_a_channel_for_each() -> None:
    rig = RigConfig.model_validate({"actuators": {"position_mm": [[0, 0], [10, 0], [0, 10]]}})
    assert rig.player.channels == (0, 1, 2)
    assert rig.player.loopback_channel == 3


def test_rig_of_another_size_gets_its_actuators_on_its_own_rim() -> None:
    rig = RigConfig.model_validate({"surface": {"length_mm": 100, "width_mm": 60}})
    assert rig.actuator_mm[0].tolist() == [44, 0]


@pytest.mark.parametrize(
    "data",
    [
        {},
        {"actuators": {"position_mm": [[1.5, 2]]}},
        {"mirror": {"map": [[2, 0, 0], [0, 2, 0], [0, 1e-4, 2000]]}},
    ],
)
def test_rig_survives_json(data: dict[str, object]) -> None:
    rig = RigConfig.model_validate(data)
    assert RigConfig.model_validate_json(rig.model_dump_json()) == rig


MISTAKES = [
    ("[surface]\nlength_m = 0.25", "surface.length_m = 0.25: unknown key; did you mean length_mm?"),
    ("[surface]\nkind = 'disk'", 'surface.kind = "disk": must be "stadium"'),
    ("[surface]\nlength_mm = 100", "surface.width_mm = 150.0: must be at most length_mm = 100"),
    ("[actuators]\nposition_mm = []", "actuators.position_mm = []: must have at least 1 entries, has 0"),
    ("[actuators]\nposition_mm = [[0, 0], [1]]", "actuators.position_mm[1][1]: is missing"),
    ("[actuators]\nposition_mm = [[0, nan]]", "actuators.position_mm[0][1] = nan: must be a finite number"),
    (
        "[actuators]\nposition_mm = [[0, 0, 0]]",
        "actuators.position_mm[0] = [0, 0, 0]: must have at most 2 entries",
    ),
    (
        "[actuators]\nposition_mm = [[0, 0], [0, 80]]",
        "actuators.position_mm[1] = [0.0, 80.0]: must be on the surface of 250 x 150 mm",
    ),
    (
        "[actuators]\nposition_mm = [[1, 2], [0, 0], [1, 2]]",
        "actuators.position_mm[2] = [1.0, 2.0]: is already the place of actuator 0",
    ),
    ("[mirror]\ndriver = 'asi-tiger'", 'mirror.driver = "asi-tiger": must be "virtual"'),
    ("[mirror]\nmap = [[1, 0], [0, 1]]", "mirror.map[0][2]: is missing"),
    (
        "[mirror]\nmap = [[1, 0, 0], [0, 1, 0], [1, 1, 0]]",
        "mirror.map = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [1.0, 1.0, 0.0]]: must be a matrix that can be",
    ),
    (
        "[mirror]\ndistance_mm = 900\nmap = [[1, 0, 0], [0, 1, 0], [0, 0, 900]]",
        "mirror.distance_mm = 900.0: must be left out where map is given",
    ),
    ("[mirror]\npark_mrad = [0, 300]", "mirror.park_mrad = [0.0, 300.0]: must be within limit_mrad = 250"),
    ("[mirror]\nlimit_deg = 3", "mirror.limit_deg = 3: unknown key; did you mean limit_mrad?"),
    ("[recorder]\ndriver = 'nidaqmx'", 'recorder.driver = "nidaqmx": must be "virtual"'),
    ("[recorder]\nresponse_range_v = 0", "recorder.response_range_v = 0: must be above 0"),
    (
        "[recorder]\ninter_channel_delay_us = 5",
        "recorder.inter_channel_delay_us = 5: unknown key; did you mean",
    ),
    ("[recorder]\ninter_channel_delay_s = 5", "recorder.inter_channel_delay_s = 5: must be at most 0.001"),
    (
        "[player]\nchannels = [0, 1]",
        "player.channels = [0, 1]: must have one entry per actuator, 20 in all, has 2",
    ),
    ("[player]\nloopback_channel = 3", "player.loopback_channel = 3: is already the channel of actuator 3"),
    ("[player]\nlimit_v = 6", "player.limit_v = 6.0: must be at most full_scale_v = 5"),
    ("[player]\nlimit_v = -1", "player.limit_v = -1: must be above 0"),
    (
        "[vibrometer]\nsensitivity_mm_s_per_v = 5",
        "vibrometer.sensitivity_mm_s_per_v = 5: unknown key; did you mean",
    ),
    ("[camera]\ndriver = 'x'", "camera = { driver }: unknown key; allowed: rig, surface, actuators, mirror"),
    ("actuators = 3", "actuators = 3: must be a table"),
    ("player = []", "player = []: must be a table"),
    ("surface = 'x'", 'surface = "x": must be a table'),
]


@pytest.mark.parametrize(("text", "complaint"), MISTAKES, ids=[complaint[:40] for _, complaint in MISTAKES])
def test_mistake_in_a_rig_file_is_one_line_with_file_key_value_and_what_is_allowed(
    tmp_path: Path, text: str, complaint: str
) -> None:
    file = tmp_path / "rig.toml"
    file.write_text(text)
    with pytest.raises(InputError) as told:
        load_rig(file)
    assert str(told.value).startswith(f"{file}: {complaint}")
    assert str(told.value).isprintable()


def test_channel_used_twice_names_both_actuators(tmp_path: Path) -> None:
    file = tmp_path / "rig.toml"
    file.write_text("[actuators]\nposition_mm = [[0, 0], [1, 1]]\n[player]\nchannels = [4, 4]")
    with pytest.raises(InputError, match=r"player\.channels\[1\] = 4: is already the channel of actuator 0"):
        load_rig(file)
