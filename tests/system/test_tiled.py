"""A bank in a catalogue of tiled: its real server and client, in an environment of their own."""

from __future__ import annotations

import json
import os
import shutil
import socket
import subprocess
import sys
import time
import venv
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.system.test_own_names import checked

ASK = """
import json, sys, time
from tiled.client import from_uri
catalogue = from_uri(sys.argv[1])
until_s = time.monotonic() + 120
while "plate" not in list(catalogue) and time.monotonic() < until_s:  # it is served before its files are registered
    time.sleep(0.2)
bank = catalogue["plate"]
rows = bank["green"][2:4]
data = bank.read(["position_mm", "snr_db"])
print(json.dumps([rows.shape, float(rows[0, 1, 50]), data.position_mm.values.tolist(), data.attrs["response_unit"]]))
"""


@pytest.mark.long
@pytest.mark.timeout(900)
def test_given_a_served_folder_then_tiled_s_client_reads_rows_of_a_bank(bank: Path, tmp_path: Path) -> None:
    import h5py

    environment = tmp_path / "environment"
    venv.create(environment, with_pip=False)
    python = environment / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    pip = [sys.executable, "-m", "pip", "--disable-pip-version-check", "--python", python]
    checked(*pip, "install", "-q", "tiled[server]>=0.2", cwd=tmp_path)
    site = Path(checked(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))", cwd=tmp_path).strip())
    (site / "zz_tests.pth").write_text("\n".join(one for one in sys.path if Path(one).is_dir()), "utf-8")
    folder = tmp_path / "catalogue"
    folder.mkdir()
    shutil.copy2(bank, folder / "plate.h5")
    with _served(python, folder) as address:
        shape, value, position_mm, unit = json.loads(checked(python, "-c", ASK, address, cwd=tmp_path))
    with h5py.File(bank) as file:
        assert shape == [2, *file["green"].shape[1:]]
        assert value == float(file["green"][2, 1, 50])
        assert position_mm == file["position_mm"][...].tolist()
        assert unit == file.attrs["response_unit"]


@contextmanager
def _served(python: Path, folder: Path) -> Iterator[str]:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    command = [
        python, "-m", "tiled", "serve", "directory", folder, "--public", "--port", port, "--include-ext", ".h5",
        "--ext", ".h5=application/x-hdf5", "--adapter", "application/x-hdf5=wavefocus.tiled:FileAdapter",
    ]  # fmt: skip
    environment = {key: value for key, value in os.environ.items() if not key.startswith(("PYTHON", "COVERAGE"))}
    with subprocess.Popen(list(map(str, command)), env=environment, stderr=subprocess.DEVNULL) as server:
        try:
            while server.poll() is None:
                with socket.socket() as client:
                    if client.connect_ex(("127.0.0.1", port)) == 0:
                        break
                time.sleep(0.1)
            assert server.poll() is None
            yield f"http://127.0.0.1:{port}"
        finally:
            server.terminate()
