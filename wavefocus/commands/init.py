"""``wavefocus init``: commented configuration files to start from."""

from __future__ import annotations

from pathlib import Path

from config.templates import write_templates
from wavefocus.console import say


def init(folder: Path, rig: str) -> None:
    """Write rig.toml, run.toml and scene.toml into `folder`; existing files are never touched."""
    for path in write_templates(folder, rig):
        say(f"wrote {path}")
    rig_file = folder / "rig.toml"
    nexts = {
        "virtual": f"wavefocus plan {folder / 'run.toml'}",
        "template": f"fill in {rig_file}, then wavefocus doctor {rig_file}",
        "emulated": f"wavefocus emulate {rig_file}, and wavefocus doctor {rig_file} in another terminal",
    }
    say(f"next: {nexts[rig]}")
