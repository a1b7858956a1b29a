import re
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from tests.lab_files import change_text, no_room_beyond
from tools import key_tables
from wavefocus import GreenArray, InputError, load_scene
from wavefocus.benchmarks.rig_bank import true_bank
from wavefocus.commands.init import write_templates
from wavefocus.config.emulation import ANYWHERE, CORRUPTING
from wavefocus.config.fields import fields_of, tables_of
from wavefocus.config.rig import RigConfig, default_rig
from wavefocus.config.run import RunConfig, Virtual
from wavefocus.config.scene import SceneConfig
from wavefocus.config.trials import TrialsConfig
from wavefocus.configuration import Configuration, load_rig, load_run
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.trials.design import load_trials


def test_virtual_templates_are_the_defaults(tmp_path):
    write_templates(tmp_path, "virtual")
    written = load_run(tmp_path / "run.toml")
    assert written.rig == default_rig()
    assert written.run.virtual == Virtual()
    assert written.run.model_copy(update={"rig": "virtual", "virtual": None}) == RunConfig()
    defaults = Configuration(RunConfig(), default_rig(), written.position_mm)
    assert written.plan_sha256 == defaults.plan_sha256


@pytest.mark.may_skip("limits of files are POSIX")
def test_given_a_full_disk_then_no_empty_folder_of_templates_is_left(tmp_path):
    with no_room_beyond(100), pytest.raises(InputError, match="cannot be written"):
        write_templates(tmp_path / "lab", "virtual")
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("kind", ["template", "emulated"])
def test_rigs_to_fill_in_or_emulate_have_real_drivers_around_the_default_plate(tmp_path, kind):
    write_templates(tmp_path, kind)
    rig = load_rig(tmp_path / "rig.toml")
    assert (rig.is_virtual, rig.emulation.is_flawless) == (False, kind == "template")
    assert load_run(tmp_path / "run.toml").rig == rig
    if kind == "template":
        assert rig.rig.name == "my plate"
        assert (rig.surface, rig.actuators) == (default_rig().surface, default_rig().actuators)
        assert (rig.mirror.driver, rig.recorder.driver, rig.player.driver) == ("asi-tiger", "nidaqmx", "sounddevice")


@pytest.mark.parametrize("kind", ["template", "virtual", "emulated"])
def test_every_key_of_a_template_is_explained_and_every_line_commented_out_is_a_key(tmp_path, kind):
    for path in write_templates(tmp_path, kind):
        lines, table, explained = path.read_text(encoding="utf-8").splitlines(), "", set()
        for before, line in zip(["", *lines], lines, strict=False):
            table = line if line.startswith("[") else table
            if " = " in line and not line.startswith(("#", " ", "name")):
                key = table.split("]")[0], line.split(" = ")[0]
                assert "#" in line or before.startswith("#") or line.startswith("rig") or key in explained, line
                explained.add(key)
    rig, table = load_rig(tmp_path / "rig.toml"), ""
    models = {name: type(getattr(rig, name)) for name in ("mirror", "recorder", "player", "vibrometer", "emulation")}
    for line in (tmp_path / "rig.toml").read_text(encoding="utf-8").splitlines():
        if heading := re.match(r"#? ?\[+(\w+)\]+ ", f"{line} "):
            table = heading[1]
        elif (key := re.match(r"# (\w+) = ", line)) and table in models:
            assert key[1] in models[table].model_fields, line


@pytest.mark.long
def test_template_scene_runs_on_positions_for_2_s_clean_with_noise_beyond_the_band(tmp_path):
    write_templates(tmp_path, "virtual")
    scene = load_scene(tmp_path / "scene.toml")
    (source,) = scene.sources
    field_s = source.path.length_mm / source.speed_mm_s + 2 * 0.2  # and a response before and after
    assert 1.5 < field_s < 2.5
    position_mm = load_run(tmp_path / "run.toml").position_mm
    for point_mm in source.path.point_at(np.arange(0.0, source.path.length_mm + 1.0, source.step_mm)):
        assert np.hypot(*(position_mm - point_mm).T).min() < 1e-9
    near = position_mm[(np.abs(position_mm) < (80.0, 6.0)).all(axis=1)]
    bank = true_bank(VirtualRig(), near, None)
    size = np.sqrt(np.square(bank.values).mean(axis=(1, 2), keepdims=True))
    noisy = bank.values + 0.05 * size * np.random.default_rng(1).standard_normal(bank.values.shape)
    drive, report = render_with_report(scene, GreenArray(noisy, near, bank.sample_rate_hz, band_hz=bank.band_hz))
    assert (drive.scale, report.warnings) == (1.0, ())


def test_template_of_trials_is_the_papers_experiment(tmp_path):
    write_templates(tmp_path, "template")
    design = load_trials(tmp_path / "trials.toml")
    player = load_rig(tmp_path / "rig.toml").player
    position_mm = load_run(tmp_path / "run.toml").position_mm
    assert 9 * (design.trials or 0) == 720
    assert Counter((one.speed_mm_s, one.plays) for one in design.stimuli.values()) == {
        (40.0, 1): 2, (100.0, 2): 2, (250.0, 3): 2, (500.0, 4): 2,
    }  # fmt: skip
    for one in design.stimuli.values():
        (source,) = one.scene.sources
        points_mm = source.path.point_at(source.step_mm * np.arange(6.0))
        assert source.path.length_mm == 5 * source.step_mm == 120.0
        assert [np.hypot(*(position_mm - point_mm).T).min() for point_mm in points_mm] == [0.0] * 6
        assert len(source.signal.samples(10_000.0)) / 10_000.0 < source.step_mm / source.speed_mm_s
        assert one.correct == ("right" if points_mm[-1, 0] > points_mm[0, 0] else "left")
    assert design.config.masking is not None
    assert design.config.masking.output not in (*player.channels, player.loopback_channel)


def test_template_of_fingers_keeps_the_others_quiet_each_at_its_level(tmp_path):
    write_templates(tmp_path, "virtual")
    change_text(tmp_path / "fingers.toml", "[10, 0], radius_mm = 0.0, level_db = -30", "[10, 0], level_db = -20")
    design = load_trials(tmp_path / "fingers.toml")
    position_mm = load_run(tmp_path / "run.toml").position_mm
    assert {stimulus.correct for stimulus in design.stimuli.values()} == set(design.config.trials.answers)
    scenes = [stimulus.scene for stimulus in design.stimuli.values()]
    places = {scene.sources[0].path.at_mm for scene in scenes}
    assert all(np.hypot(*(position_mm - place).T).min() == 0.0 for place in places)
    for scene in scenes:
        quiet = {place.path.at_mm: place.level_db for place in scene.quiet}
        others = places - {scene.sources[0].path.at_mm}
        assert quiet == {place: -20.0 if place == (10.0, 0.0) else -30.0 for place in others}


def test_file_that_is_there_is_never_overwritten(tmp_path):
    for name in ("rig.toml", "run.toml", "scene.toml", "trials.toml", "fingers.toml"):
        (tmp_path / name).write_text("mine")
        with pytest.raises(InputError, match=rf"{name}: is there already"):
            write_templates(tmp_path, "virtual")
        assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {name: "mine"}
        (tmp_path / name).unlink()


@pytest.mark.parametrize(
    ("model", "page"), [(RunConfig, "run"), (RigConfig, "rig"), (TrialsConfig, "trials"), (SceneConfig, "scene")]
)
def test_the_reference_page_has_every_key_of_every_table(model, page):
    text = (Path(__file__).parents[2] / "docs" / "reference" / f"{page}-file.md").read_text(encoding="utf-8")
    tables = re.findall(rf"^<!-- keys: {page} ([\w.]+) -->$", text, re.MULTILINE)
    elsewhere = {"settled", "path", "signal", *(SceneConfig.model_fields if page == "trials" else ())}
    assert set(tables) >= {table for table in model.model_fields if tables_of(model, table)} - elsewhere
    for table in tables:
        rows = re.findall(r"^\| `(\w+)`", key_tables.table(page, table), re.MULTILINE)
        assert set(rows) == set(fields_of(model, table)) - {"measured"}  # of a bank alone


def test_a_table_of_keys_states_marks_drivers_defaults_and_what_is_allowed():
    rows = key_tables.table("rig", "mirror").splitlines()
    meaning = "Degrees that the beam turns by per degree of the controller (above 0)"
    assert f"| `beam_per_mirror` # | 2.0 | asi-tiger | {meaning} |" in rows
    assert "| `settle_s` | 0.005 |  | Time that the beam swings after a move (s, 0 or more) |" in rows
    assert any(row.startswith("| `distance_mm` # | 1000.0 |") for row in rows)
    assert any(row.startswith("| `full_scale_mrad` # | needed | mirrorcle-mti |") for row in rows)


def test_every_kind_of_fault_is_in_the_reference_page_of_the_run_file():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "run-file.md").read_text(encoding="utf-8")
    assert all(f'"{kind}"' in page for kind in (*ANYWHERE, *CORRUPTING))
