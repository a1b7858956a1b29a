"""Signs of life to a file and a real web server; the request to the system to stay awake."""

import http.server
import os
import stat
import subprocess
import sys
import threading
import time

import pytest

from tests.system.lines import wait_until
from wavefocus.config.rig import MessagesSection
from wavefocus.rig.unattended import AliveSignal, alive_findings, kept_awake
from wavefocus.storage.errors import InputError


class Handler(http.server.BaseHTTPRequestHandler):
    """Notes at its server when it was asked; `hangs` lets it never answer."""

    def do_GET(self):
        self.server.asked.append(self.path)
        if self.server.hangs.is_set():
            time.sleep(30)
        self.send_response(self.server.status, f"nothing wanted {self.path}")
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture
def watch():
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), Handler)
    server.daemon_threads, server.block_on_close = True, False
    server.asked, server.hangs, server.status = [], threading.Event(), 200
    server.url = f"http://127.0.0.1:{server.server_port}/secret-check"
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    yield server
    server.shutdown()
    thread.join()
    server.server_close()


@pytest.mark.parametrize("hangs", [False, True])
def test_file_and_address_receive_signs_of_life_and_no_server_holds_up_the_end(watch, tmp_path, hangs):
    file = tmp_path / "alive"
    if hangs:
        watch.hangs.set()
    with AliveSignal(MessagesSection(alive_url=watch.url, alive_file=str(file)), every_s=0.05):
        wait_until(lambda: len(watch.asked) >= (1 if hangs else 3) and file.exists(), "a sign of life")
        os.utime(file, (0, 0))
        wait_until(lambda: file.stat().st_mtime > 1e9, "a new sign of life")
        began_s = time.monotonic()
    assert time.monotonic() - began_s < 5.0
    assert set(watch.asked) == {"/secret-check"}
    watch.hangs.clear()
    time.sleep(0.2)
    count = len(watch.asked)
    time.sleep(0.2)
    assert len(watch.asked) == count


def test_given_no_server_or_folder_then_it_is_said_once_and_without_the_address(watch, tmp_path, capsys):
    watch.status = 500
    section = MessagesSection(alive_url=watch.url, alive_file=str(tmp_path / "none" / "alive"))
    with AliveSignal(section, every_s=0.05):
        wait_until(lambda: len(watch.asked) >= 3, "a sign of life")
    said = capsys.readouterr().err
    assert said.count("messages.alive_url") == said.count("messages.alive_file") == 1
    assert "secret-check" not in said
    assert {one.verdict for one in alive_findings(section)} == {"fail"}
    assert [one.verdict for one in alive_findings(MessagesSection(alive_file=str(tmp_path)))] == ["fail"]  # a folder
    with pytest.raises(InputError, match="alive_url"):
        AliveSignal(MessagesSection(alive_url="ftp://secret-check"))
    assert "secret-check" not in section.model_dump_json()


@pytest.mark.skipif(sys.platform != "linux", reason="systemd-inhibit")
def test_session_manager_then_it_is_told_reason_and_released_however_run_ends(tmp_path, monkeypatch):
    noted = tmp_path / "noted"
    stand_in = tmp_path / "systemd-inhibit"  # takes the same options and starts the command, as the real one does
    stand_in.write_text(f'#!/bin/sh\necho "$@" >> {noted}\nshift 4\n"$@"\necho over >> {noted}\n')
    stand_in.chmod(stand_in.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("PATH", f"{tmp_path}{os.pathsep}{os.environ['PATH']}")
    with kept_awake("measuring plate.h5") as accepted:
        assert accepted
        wait_until(noted.exists, "the request")
        assert "--who=wavefocus --why=measuring plate.h5" in noted.read_text()
    assert noted.read_text().endswith("over\n")
    noted.unlink()
    hold = "import time; from wavefocus.rig.unattended import kept_awake\nwith kept_awake('x'): time.sleep(100)"
    with subprocess.Popen([sys.executable, "-c", hold]) as holder:
        wait_until(noted.exists, "the request")
        holder.kill()
    wait_until(lambda: "over" in noted.read_text(), "the release")
