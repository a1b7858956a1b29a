"""Every virtual plate is captured, measured again and verified like the first."""

import pytest

from tests.lab_files import RUN, stroke_scene
from tests.system.captures import answered, wavefocus
from wavefocus.storage.bank.reading import open_bank

RIG = """
[surface]
kind = "{kind}"
length_mm = {length}
width_mm = {width}

[actuators]
position_mm = [[39.0, 0.0], [10.0, 24.0], [-38.0, 8.0], [-5.0, -24.0]]
"""

OUTPUT = '[output]\nlimit_v = 1.0\ninterpolation = "kernel"'
SCENE = stroke_scene([-15, 1], [16, -3], 'kind = "impulse"', OUTPUT, speed_mm_s=80.0)


SMALL, LARGE = (90.0, 60.0, 4.0, 22.0), (300.0, 200.0, 20.0, 18.0)
LONG_WAVES = "[tolerance]\nfocus_error_mm = 10.0\n"
"""They are longer than the distance of two positions, 20 mm."""


OFTEN = ("stadium", "rectangle", SMALL, "")
AT_NIGHT = [
    ("thin", "rectangle", LARGE, f"quality = 8.0\n{LONG_WAVES}"),
    ("solid", "stadium", SMALL, "force_deg = 30.0\noscillation_deg = 60.0\n"),
]


@pytest.mark.parametrize(
    ("plate", "kind", "size", "keys"),
    [OFTEN, *(pytest.param(*one, marks=pytest.mark.nightly) for one in AT_NIGHT)],
    ids=["stadium", "thin", "solid"],
)
def test_given_a_plate_then_it_is_captured_measured_again_and_verified(
    tmp_path, monkeypatch, capsys, plate, kind, size, keys
):
    monkeypatch.setenv("WAVEFOCUS_CACHE", str(tmp_path / "cache"))
    length, width, spacing, margin = size
    text = RUN.partition("[quality]")[0].replace("decay_s = 0.1\ntaps = 1000", "taps = 2000")
    grid = f"spacing_mm = {spacing}\nmargin_mm = {margin}"
    files = {
        "rig": RIG.format(kind=kind, length=length, width=width),
        "run": text.replace('positions_file = "positions.csv"', grid) + f'[virtual]\nplate = "{plate}"\n{keys}',
        "scene": SCENE,
    }
    for name, text in files.items():
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    rig, run, scene = (tmp_path / f"{name}.toml" for name in files)
    bank = tmp_path / "plate.h5"
    assert wavefocus("capture", run, "--bank", bank) == 0
    assert wavefocus("remeasure", bank, "--positions", 0) == 0  # by the bank alone
    assert wavefocus("check", bank) == 0
    with open_bank(bank) as measured:
        assert measured.directions_deg == ((30.0, 60.0) if plate == "solid" else None)
    verified = answered(capsys, "verify", scene, "--bank", bank, "--rig", rig, "--out", tmp_path / "verify")
    percent = {figure["name"]: figure["value"] for figure in verified["figures"]}
    assert percent["normalised error"] < 1.0
