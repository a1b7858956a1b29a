"""`import wavefocus as wf`: examples of the docstrings, and functions with paths, objects and wrong input."""

import doctest

import numpy as np
import pytest

import wavefocus as wf
from tests.lab_files import stroke_scene
from wavefocus.__main__ import run

SCENE = '[scene]\nname = "stroke"\n' + stroke_scene(
    [-10, 0], [10, 0], 'kind = "sine", frequency_hz = 200.0, duration_s = 0.05', 'emission = "per_point"',
    '[output]\ninterpolation = "bilinear"', step_mm=5.0,
)  # fmt: skip
PLACES_MM = [[x, y] for y in (-5, 0, 5) for x in (-10, -5, 0, 5, 10)]


@pytest.fixture(scope="module")
def measured(tmp_path_factory):
    """A folder with a small bank, its recordings, a scene, its drive and a field."""
    folder = tmp_path_factory.mktemp("lab")
    rig = wf.virtual_rig(position_mm=PLACES_MM, run={"capture": {"keep_raw": True}})
    rig.measure(folder / "plate.h5").close()
    (folder / "scene.toml").write_text(SCENE, encoding="utf-8")
    wf.write_drive(folder / "drive.h5", wf.render(folder / "scene.toml", folder / "plate.h5"))
    wf.write_field(folder / "field.h5", wf.predict(folder / "drive.h5", folder / "plate.h5", [0, 7]))
    return folder


@pytest.fixture
def lab(measured, monkeypatch):
    monkeypatch.chdir(measured)
    return measured


FUNCTIONS = [name for name in wf.__all__ if not isinstance(getattr(wf, name), type)]


@pytest.mark.parametrize("name", FUNCTIONS)
def test_every_function_says_what_it_takes_and_its_example_gives_what_it_shows(lab, name):
    for section in ("Parameters", "Raises", "Examples"):
        assert f"\n    {section}\n    ----" in getattr(wf, name).__doc__
    (example,) = doctest.DocTestFinder(recurse=False).find(getattr(wf, name), name, globs={})
    assert example.examples, f"{name} has no example"
    told = []
    doctest.DocTestRunner(optionflags=doctest.ELLIPSIS).run(example, out=told.append)
    assert not told, "".join(told)


def test_given_the_same_scene_then_python_and_the_command_make_the_same_drive(lab):
    assert run(["render", "scene.toml", "--bank", "plate.h5", "--out", "command.h5", "--force"]) == 0
    with wf.open_bank("plate.h5") as bank:
        drive = wf.render(wf.load_scene("scene.toml"), bank)
    assert np.array_equal(drive.drive_v, wf.read_drive("command.h5").drive_v)


def test_given_a_bank_half_measured_then_measuring_goes_on_with_it(tmp_path):
    path, places_mm = tmp_path / "plate.h5", PLACES_MM[:6]
    with wf.virtual_rig(actuators=2, position_mm=places_mm).measure(path, [0, 1, 2]) as bank:
        assert bank.status.tolist() == [1, 1, 1, 0, 0, 0]
        first = bank.green(1)
    seen = []
    rig = wf.virtual_rig(actuators=2, position_mm=places_mm)
    with rig.measure(path, on_progress=lambda *one: seen.append(one)) as bank:
        assert bank.status.tolist() == [1] * 6
        assert np.linalg.norm(bank.green(1) - first) < 0.01 * np.linalg.norm(first)
    assert seen[-1] == (6, 6)
    assert run(["check", str(path)]) == 0


def test_given_single_steps_then_they_give_what_the_plate_is(tmp_path):
    rig = wf.virtual_rig(actuators=3, position_mm=PLACES_MM[:2], noise_v=1e-5)
    result = rig.estimate(rig.record(1))
    measured, true = (np.fft.rfft(one, axis=1)[:, 5:45] for one in (result.estimate.green, rig.truth(1)))
    assert result.judgement.good
    assert np.linalg.norm(measured - true) < 2e-3 * np.linalg.norm(true)


@pytest.mark.parametrize(
    ("keys", "named"),
    [
        ({"taps": 0}, "capture.taps"),
        ({"plate": "jelly"}, "virtual.plate"),
        ({"position_mm": [[0.0, 400.0]]}, "position_mm"),
        ({"position_mm": [[0.0, 0.0], [0.0, 0.0]]}, "position_mm"),
        ({"position_mm": [1.0, 2.0]}, "position_mm"),
        ({"run": {"sweep": {"stop_hz": 1e5}}}, "sweep.stop_hz"),
        ({"run": {"swep": {}}}, "swep"),
        ({"actuators": [[0.0, 0.0], [0.0, 0.0]]}, "actuators.position_mm"),
    ],
)
def test_given_wrong_keys_of_a_rig_then_the_error_names_them(keys, named):
    with pytest.raises(wf.InputError, match=named):
        wf.virtual_rig(**keys)


@pytest.mark.parametrize(
    "call",
    [
        lambda: wf.open_bank("none.h5"),
        lambda: wf.render("none.toml", "plate.h5"),
        lambda: wf.render("scene.toml", "none.h5"),
        lambda: wf.render("scene.toml", "drive.h5"),
        lambda: wf.render("scene.toml", "plate.h5", device="cuda", tolerance_db=-60.0),
        lambda: wf.predict("none.h5", "plate.h5"),
        lambda: wf.predict("drive.h5", "plate.h5", [99]),
        lambda: wf.focus_figures("drive.h5", "plate.h5", "none.h5"),
        lambda: wf.estimate("none.h5", "new.h5"),
        lambda: wf.estimate("plate.raw.h5", "plate.raw.h5"),
        lambda: wf.import_bank("none.npz", "new.h5"),
        lambda: wf.import_bank("scene.toml", "new.h5", unit="m/s/V"),
        lambda: wf.export_bank("plate.h5", "plate.h5", "mat", force=True),
        lambda: wf.export_bank("plate.h5", "plate.xyz", "xyz"),
        lambda: wf.export_bank("plate.h5", "new.mat", "mat", positions=[99]),
        lambda: wf.virtual_rig(position_mm=PLACES_MM[:2]).measure("plate.h5"),
        lambda: wf.virtual_rig(position_mm=PLACES_MM[:2]).record(2),
    ],
)
def test_given_wrong_input_then_every_function_raises_an_input_error(lab, call):
    with pytest.raises(wf.InputError):
        call()
