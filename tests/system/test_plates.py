"""Every virtual plate is captured, killed, resumed and verified like the first."""

import json

import pytest

from tests.system.captures import capture_process
from wavefocus.__main__ import run
from wavefocus.storage.bank.reading import open_bank

RIG = """
[surface]
kind = "{kind}"
length_mm = {length}
width_mm = {width}

[actuators]
position_mm = [[39.0, 0.0], [10.0, 24.0], [-38.0, 8.0], [-5.0, -24.0]]
"""

RUN = """
rig = "rig.toml"

[grid]
spacing_mm = {spacing}
margin_mm = {margin}

[sweep]
duration_s = 0.3

[capture]
averages = 2
taps = 2000

[virtual]
plate = "{plate}"
"""

SCENE = """
[[source]]
speed_mm_s = 80.0
step_mm = 4.0
path = { kind = "line", start_mm = [-15, 1], end_mm = [16, -3] }
signal = { kind = "impulse" }

[output]
limit_v = 1.0
interpolation = "kernel"
"""


@pytest.mark.parametrize(
    ("plate", "kind", "size"),
    [
        pytest.param("soft", "stadium", (90.0, 60.0, 4.0, 22.0), marks=pytest.mark.nightly),
        ("stadium", "rectangle", (90.0, 60.0, 4.0, 22.0)),
        pytest.param("thin", "rectangle", (300.0, 200.0, 20.0, 18.0), marks=pytest.mark.nightly),
        pytest.param("thin, infinite", "stadium", (300.0, 200.0, 20.0, 18.0), marks=pytest.mark.nightly),
        pytest.param("solid", "stadium", (90.0, 60.0, 4.0, 22.0), marks=pytest.mark.nightly),
    ],
)
def test_given_a_plate_then_it_is_captured_killed_resumed_and_verified(tmp_path, monkeypatch, plate, kind, size):
    monkeypatch.setenv("WAVEFOCUS_CACHE", str(tmp_path / "cache"))
    name, _, edge = plate.partition(", ")
    rig, campaign = RIG.replace("{kind}", kind), RUN.replace("{plate}", name)
    for key, value in zip(("{length}", "{width}", "{spacing}", "{margin}"), size, strict=True):
        rig, campaign = rig.replace(key, str(value)), campaign.replace(key, str(value))
    campaign += {
        "soft": 'loss = "springpot"\n',
        "thin": "quality = 8.0\n",
        "solid": "force_deg = 30.0\noscillation_deg = 60.0\n",
    }.get(name, "")
    campaign += f'edge = "{edge}"\n' if edge else ""
    if name == "thin":  # its waves are longer than the distance of two positions, 20 mm
        campaign += "[tolerance]\nfocus_error_mm = 10.0\n"
    for name, text in (("rig.toml", rig), ("run.toml", campaign), ("scene.toml", SCENE)):
        (tmp_path / name).write_text(text, encoding="utf-8")
    quiet, bank = tmp_path / "quiet.h5", tmp_path / "plate.h5"
    assert run(["capture", str(tmp_path / "run.toml"), "--bank", str(quiet)]) == 0
    with capture_process(tmp_path, bank) as child:
        while child.hear("progress")["done"] < 3:
            pass
        child.process.kill()
    assert run(["resume", str(bank)]) == 0
    assert bank.read_bytes() == quiet.read_bytes()
    assert run(["check", str(bank)]) == 0
    with open_bank(bank) as measured:
        assert measured.directions_deg == ((30.0, 60.0) if plate == "solid" else None)
    out = tmp_path / "verify"
    assert run(["verify", str(tmp_path / "scene.toml"), "--bank", str(bank), "--rig", str(tmp_path / "rig.toml"),
                "--out", str(out)]) == 0  # fmt: skip
    percent = {figure["name"]: figure["value"] for figure in json.loads((out / "verify.json").read_text())["figures"]}
    assert percent["normalised error"] < 1.0


def test_kept_recordings_of_solid_then_bank_estimated_from_them_has_its_directions(tmp_path):
    (tmp_path / "grid.csv").write_text("x_mm,y_mm\n0,0\n4,0\n", encoding="utf-8")
    text = RUN.replace("{plate}", "solid").replace('rig = "rig.toml"\n', "").replace("taps", "keep_raw = true\ntaps")
    text = text.replace("spacing_mm = {spacing}\nmargin_mm = {margin}", 'positions_file = "grid.csv"')
    (tmp_path / "run.toml").write_text(text + "force_deg = 30.0\n", encoding="utf-8")
    assert run(["capture", str(tmp_path / "run.toml"), "--bank", str(tmp_path / "plate.h5")]) == 0
    assert run(["estimate", str(tmp_path / "plate.raw.h5"), "--bank", str(tmp_path / "again.h5")]) == 0
    with open_bank(tmp_path / "again.h5") as bank:
        assert bank.directions_deg == (30.0, 0.0)
