"""``wavefocus init``: commented configuration files to start from."""

from __future__ import annotations

from pathlib import Path

from wavefocus.config.templates import write_templates
from wavefocus.console import say


def init(folder: Path, rig: str) -> None:
    """Write rig.toml, run.toml and scene.toml into `folder`; existing files are never touched."""
    for path in write_templates(folder, rig):
        say(f"wrote {path}")
    say(f"next: wavefocus plan {folder / 'run.toml'}")
