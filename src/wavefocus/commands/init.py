"""``wavefocus init``: commented configuration files to start from."""

import os
from contextlib import suppress
from importlib.resources import files
from pathlib import Path

from wavefocus.config.fields import Table, with_explanations
from wavefocus.config.loading import printable
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.config.scene import SceneConfig
from wavefocus.config.trials import TrialsConfig
from wavefocus.console import say
from wavefocus.storage.errors import InputError
from wavefocus.storage.output_files import replacement


def init(folder: Path, rig: str) -> None:
    """Write rig.toml, run.toml, scene.toml and two trials files into `folder`; existing files are never touched."""
    names = ", ".join(path.name for path in write_templates(folder, rig))
    rig_file = folder / "rig.toml"
    nexts = {
        "virtual": f"wavefocus plan {folder / 'run.toml'}",
        "template": f"fill in {rig_file}, then wavefocus doctor {rig_file}",
        "emulated": f"wavefocus emulate {rig_file}, and wavefocus doctor {rig_file} in another terminal",
    }
    say(f"wrote {names} to {folder}; next: {nexts[rig]}")


def write_templates(folder: Path, rig: str) -> tuple[Path, ...]:
    """Write rig.toml, run.toml, scene.toml and two trials files with every key explained; nothing is ever overwritten.

    Returns the files written. Raises InputError: one of the files is there already, or the folder cannot be written to.
    """
    templates = files("wavefocus") / "templates"
    models: dict[str, type[Table]] = {
        "rig.toml": RigConfig, "run.toml": RunConfig, "scene.toml": SceneConfig, "trials.toml": TrialsConfig,
        "fingers.toml": TrialsConfig,
    }  # fmt: skip
    named = {name: f"rig-{rig}.toml" if name == "rig.toml" else name for name in models}
    for name in named:
        if os.path.lexists(folder / name):
            there = printable(str(folder / name))
            raise InputError(f"{there}: is there already and is not overwritten; choose another folder")
    made = not folder.is_dir()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name, template in named.items():
            text = with_explanations((templates / template).read_text(encoding="utf-8"), models[name])
            # Real instruments, emulated or not, take no orders from a run's [virtual] table.
            with replacement(folder / name, new=True) as temporary:
                temporary.write_bytes((text if rig == "virtual" else text.partition("\n[virtual]")[0]).encode())
    except OSError as error:
        raise InputError(printable(f"{error.filename or folder}: cannot be written: {error.strerror}")) from None
    finally:
        with suppress(OSError):  # it holds files
            if made:
                folder.rmdir()
    return tuple(folder / name for name in named)
