from __future__ import annotations

import json
import re
from pathlib import Path
from typing import get_args

import pytest
from pydantic import BaseModel
from pydantic_core import PydanticUndefined

from config.rig import RigConfig, default_rig
from config.run import RunConfig, Virtual, default_run
from config.scene import SceneConfig
from mocks.virtual.faults import ANYWHERE, CORRUPTING
from rendering.scene.loading import load_scene
from storage.errors import InputError
from wavefocus.commands.init import write_templates
from wavefocus.configuration import Configuration, load_rig, load_run


def test_virtual_templates_are_the_defaults(tmp_path: Path) -> None:
    write_templates(tmp_path, "virtual")
    written = load_run(tmp_path / "run.toml")
    assert written.rig == default_rig()
    assert written.run.virtual == Virtual()
    assert written.run.model_copy(update={"rig": "virtual", "virtual": None}) == default_run()
    defaults = Configuration(default_run(), default_rig(), written.position_mm)
    assert written.plan_sha256 == defaults.plan_sha256


def test_rig_to_fill_in_has_real_instruments_around_the_default_plate(tmp_path: Path) -> None:
    write_templates(tmp_path, "template")
    rig = load_rig(tmp_path / "rig.toml")
    assert (rig.rig.name, rig.is_virtual) == ("my plate", False)
    assert (rig.surface, rig.actuators) == (default_rig().surface, default_rig().actuators)
    assert (rig.mirror.driver, rig.recorder.driver, rig.player.driver) == ("asi-tiger", "nidaqmx", "sounddevice")
    assert load_run(tmp_path / "run.toml").rig == rig


def test_rig_to_emulate_has_real_drivers_and_something_to_find_out(tmp_path: Path) -> None:
    write_templates(tmp_path, "emulated")
    rig = load_rig(tmp_path / "rig.toml")
    assert not rig.is_virtual
    assert not rig.emulation.is_flawless
    assert load_run(tmp_path / "run.toml").rig == rig


@pytest.mark.parametrize("kind", ["template", "virtual", "emulated"])
def test_every_line_that_is_commented_out_is_a_key_that_the_file_may_have(tmp_path: Path, kind: str) -> None:
    write_templates(tmp_path, kind)
    rig, table = load_rig(tmp_path / "rig.toml"), ""
    models = {name: type(getattr(rig, name)) for name in ("mirror", "recorder", "player", "vibrometer", "emulation")}
    for line in (tmp_path / "rig.toml").read_text(encoding="utf-8").splitlines():
        if heading := re.match(r"#? ?\[+(\w+)\]+ ", f"{line} "):
            table = heading[1]
        elif (key := re.match(r"# (\w+) = ", line)) and table in models:
            assert key[1] in models[table].model_fields, line


def test_template_scene_moves_on_a_circle_for_about_two_seconds(tmp_path: Path) -> None:
    write_templates(tmp_path, "virtual")
    (source,) = load_scene(tmp_path / "scene.toml").sources
    field_s = source.path.length_mm / source.speed_mm_s + 2 * 0.2  # and a response before and after
    assert 1.5 < field_s < 2.5


@pytest.mark.parametrize("kind", ["virtual", "template", "emulated"])
def test_every_key_of_every_template_is_explained(tmp_path: Path, kind: str) -> None:
    for path in write_templates(tmp_path, kind):
        lines = path.read_text(encoding="utf-8").splitlines()
        for before, line in zip(["", *lines], lines, strict=False):
            if " = " in line and not line.startswith(("#", " ", "name")):
                assert "#" in line or before.startswith("#") or line.startswith("rig"), line


@pytest.mark.parametrize("name", ["rig.toml", "run.toml", "scene.toml"])
def test_file_that_is_there_is_never_overwritten(tmp_path: Path, name: str) -> None:
    (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match=rf"{name}: is there already"):
        write_templates(tmp_path, "virtual")
    assert [path.name for path in tmp_path.iterdir()] == [name]
    assert (tmp_path / name).read_text() == "mine"


def test_folder_is_made_and_a_file_in_its_place_is_told(tmp_path: Path) -> None:
    assert [path.name for path in write_templates(tmp_path / "a" / "b", "virtual")] == [
        "rig.toml",
        "run.toml",
        "scene.toml",
    ]
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file"):
        write_templates(tmp_path / "file", "virtual")


def models_of(annotation: object) -> list[type[BaseModel]]:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return [annotation]
    return [model for inner in get_args(annotation) for model in models_of(inner)]


@pytest.mark.parametrize(("model", "page"), [(RigConfig, "rig"), (RunConfig, "run"), (SceneConfig, "scene")])
def test_every_key_of_a_file_is_in_its_reference_page(model: type[BaseModel], page: str) -> None:
    text = (Path(__file__).parents[2] / "docs" / "reference" / f"{page}-file.md").read_text(encoding="utf-8")
    for name, field in model.model_fields.items():
        if name == "settled":  # of a bank alone
            continue
        assert f"[{name}]" in text or f"`{name}`" in text
        left = models_of(field.annotation)
        while left:
            table = left.pop()
            for key, one in table.model_fields.items():
                assert f"`{key}`" in text or (name, key) in (("calibration", "measured"), ("source", "kind")), key
                left += [] if key == "measured" else models_of(one.annotation)


def test_every_default_of_the_run_file_is_in_its_reference_page() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "run-file.md").read_text(encoding="utf-8")
    for name, field in RunConfig.model_fields.items():
        if name in {"rig", "settled"}:  # no table of the file
            continue
        section = page.split(f"## [{name}]")[1].split("A fault:")[0].split("\n## ")[0]
        lines = [line for line in section.splitlines() if line.startswith("|")]
        rows = {key: line for line in lines for key in re.findall(r"`(\w+)`", line.split("|")[1])}
        for key, one in models_of(field.annotation)[0].model_fields.items():
            if one.default is not PydanticUndefined and one.default not in (None, ()):
                assert json.dumps(one.default) in rows[key], f"{name}.{key}"
    assert all(f'"{kind}"' in page for kind in (*ANYWHERE, *CORRUPTING))
