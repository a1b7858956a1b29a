"""User services that carry on with a run after a reboot: systemd, launchd, the Windows Task Scheduler."""

from __future__ import annotations

import os
import plistlib
import re
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

from wavefocus.exits import Exit


@dataclass(frozen=True, slots=True)
class UserService:
    """A service as a platform wants it.

    file: Where the platform looks for it; on Windows any place will do.
    content: What the file holds.
    next_commands: Command lines that switch it on.
    """

    file: Path
    content: bytes
    next_commands: tuple[str, ...]


def user_service(platform: str, label: str, command: Sequence[str], folder: Path, home: Path) -> UserService:
    """Describe the service that runs a command when its user's session begins, on Linux when the computer starts.

    platform: As `sys.platform`.
    label: Name of what it carries on with.
    command: Program and arguments, with full names of files.
    folder: Working directory.
    home: The user's folder.
    """
    name = "wavefocus-" + re.sub(r"[^A-Za-z0-9_.-]", "-", label)
    if platform == "win32":
        return _task(name, command, folder)
    if platform == "darwin":
        return _agent(name, command, folder, home)
    return _unit(name, command, folder, home)


def _unit(name: str, command: Sequence[str], folder: Path, home: Path) -> UserService:
    """A user unit of systemd, see systemd.service(5)."""
    config = Path(os.environ.get("XDG_CONFIG_HOME") or home / ".config")
    line = " ".join(_quoted(word) for word in command)
    content = f"""[Unit]
Description={name}: carries on after a reboot
StartLimitIntervalSec=3600
StartLimitBurst=20

[Service]
Type=exec
WorkingDirectory={str(folder).replace("%", "%%")}
ExecStart={line}
Restart=on-abnormal
RestartForceExitStatus={int(Exit.INSTRUMENT_FAILED)}
RestartSec=30

[Install]
WantedBy=default.target
"""
    commands = (
        "systemctl --user daemon-reload",
        f"systemctl --user enable {name}.service",
        "loginctl enable-linger",  # else it starts when the user logs in
    )
    return UserService(config / "systemd" / "user" / f"{name}.service", content.encode(), commands)


def _quoted(word: str) -> str:
    """A word for ExecStart: specifiers and variables are not expanded."""
    escaped = word.replace("\\", "\\\\").replace('"', '\\"').replace("%", "%%").replace("$", "$$")
    return f'"{escaped}"'


def _agent(name: str, command: Sequence[str], folder: Path, home: Path) -> UserService:
    """An agent of launchd, see launchd.plist(5)."""
    agent = {
        "Label": name,
        "ProgramArguments": list(command),
        "WorkingDirectory": str(folder),
        "RunAtLoad": True,
        "KeepAlive": False,
        "StandardErrorPath": str(folder / f"{name}.said"),
    }
    file = home / "Library" / "LaunchAgents" / f"{name}.plist"
    return UserService(file, plistlib.dumps(agent), (f"launchctl load -w {file}",))


def _task(name: str, command: Sequence[str], folder: Path) -> UserService:
    """A task of the Windows Task Scheduler, in its XML of version 1.2; it starts when the user logs on."""
    program, *arguments = command
    content = f"""<?xml version="1.0" encoding="UTF-16"?>
<Task version="1.2" xmlns="http://schemas.microsoft.com/windows/2004/02/mit/task">
  <Triggers><LogonTrigger><Enabled>true</Enabled></LogonTrigger></Triggers>
  <Settings>
    <DisallowStartIfOnBatteries>false</DisallowStartIfOnBatteries>
    <StopIfGoingOnBatteries>false</StopIfGoingOnBatteries>
    <ExecutionTimeLimit>PT0S</ExecutionTimeLimit>
    <StartWhenAvailable>true</StartWhenAvailable>
  </Settings>
  <Actions>
    <Exec>
      <Command>{escape(program)}</Command>
      <Arguments>{escape(subprocess.list2cmdline(arguments))}</Arguments>
      <WorkingDirectory>{escape(str(folder))}</WorkingDirectory>
    </Exec>
  </Actions>
</Task>
"""
    file = folder / f"{name}.task.xml"
    create = subprocess.list2cmdline(["schtasks", "/Create", "/TN", name, "/XML", str(file)])
    return UserService(file, content.encode("utf-16"), (create,))
