"""User services, read with the platforms' own readers of such files where there are any here."""

from __future__ import annotations

import json
import os
import plistlib
import shutil
import subprocess
import sys
from pathlib import Path
from xml.etree import ElementTree

import pytest

from wavefocus.__main__ import run
from wavefocus.acquisition.run_queue import add_entry
from wavefocus.rig.user_service import user_service

ODD = ["/opt/my python/bin/python3", "-m", "wavefocus", "queue", "run", '/home/a b/50 %n $HOME & "x" <y>.json']


def test_the_unit_of_systemd_is_sound_and_starts_the_very_command(tmp_path: Path) -> None:
    service = user_service("linux", "night one", ODD, tmp_path, tmp_path)
    assert service.file.name == "wavefocus-night-one.service"
    lines = service.content.decode().splitlines()
    (start,) = [line for line in lines if line.startswith("ExecStart=")]
    assert "%%n" in start
    assert "$$HOME" in start
    program = tmp_path / "wavefocus-night-one.service"
    sound = [sys.executable, *ODD[1:]]
    program.write_bytes(user_service("linux", "night one", sound, tmp_path, tmp_path).content)
    assert "RestartForceExitStatus=3" in lines
    if shutil.which("systemd-analyze"):
        command = ["systemd-analyze", "verify", "--user", str(program)]
        environment = {**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}
        checked = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        assert program.name not in checked.stderr


def test_the_agent_of_launchd_is_a_property_list_with_the_very_command(tmp_path: Path) -> None:
    service = user_service("darwin", "night", ODD, tmp_path, tmp_path)
    agent = plistlib.loads(service.content)
    assert service.file == tmp_path / "Library" / "LaunchAgents" / "wavefocus-night.plist"
    assert agent["ProgramArguments"] == ODD
    assert agent["RunAtLoad"] is True
    assert agent["Label"] == service.file.stem


def test_the_task_of_windows_is_xml_with_the_very_command(tmp_path: Path) -> None:
    service = user_service("win32", "night", ODD, tmp_path, tmp_path)
    assert service.content.startswith((b"\xff\xfe", b"\xfe\xff"))
    space = "{http://schemas.microsoft.com/windows/2004/02/mit/task}"
    task = ElementTree.fromstring(service.content.decode("utf-16").partition("?>")[2])
    action = task.find(f"{space}Actions/{space}Exec")
    assert action is not None
    assert action.findtext(f"{space}Command") == ODD[0]
    assert action.findtext(f"{space}Arguments") == subprocess.list2cmdline(ODD[1:])
    assert task.findtext(f"{space}Settings/{space}ExecutionTimeLimit") == "PT0S"


@pytest.mark.skipif(sys.platform != "linux", reason="where the unit is written")
def test_given_a_queue_then_its_service_is_written_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "config"))
    queue = tmp_path / "night.queue.json"
    assert run(["service", "install", str(queue)]) == 2
    add_entry(queue, ["check", "plate.h5"], tmp_path)
    capsys.readouterr()
    assert run(["service", "install", str(queue), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert Path(answer["file"]) == tmp_path / "config" / "systemd" / "user" / "wavefocus-night.service"
    assert answer["command"][-3:] == ["queue", "run", str(queue)]
    assert Path(answer["file"]).is_file()
    assert run(["service", "install", str(queue)]) == 2
    assert run(["service", "install", str(queue), "--force"]) == 0
    assert run(["service", "install", str(queue), "--rig", "rig.toml", "--force"]) == 2
