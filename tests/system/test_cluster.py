"""Fields and banks made on a cluster of processes: the same to the byte as those made here."""

import subprocess
import sys
import time
from contextlib import contextmanager, suppress

import distributed
import h5py
import numpy as np
import pytest

from tests.lab_files import write_arrays
from tests.system.lines import python
from tests.system.raw_script import Sweep, echoes, swept, write
from wavefocus import cluster
from wavefocus.__main__ import run
from wavefocus.cluster import field_parts, identity_of
from wavefocus.storage.drive_file import Drive, write_drive
from wavefocus.storage.errors import InputError, WavefocusError

SCHEDULER = """
import sys
import time
from distributed import LocalCluster
if __name__ == "__main__":
    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address="127.0.0.1:0") as cluster:
        print(cluster.scheduler_address, flush=True)
        sys.stdin.readline()
"""


@pytest.fixture(scope="module")
def address(tmp_path_factory):
    """A scheduler with two worker processes, as on other machines."""
    script = tmp_path_factory.mktemp("cluster") / "cluster.py"
    script.write_text(SCHEDULER, encoding="utf-8")
    command = [sys.executable, str(script)]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen(command, text=True, **pipes) as scheduler:
        yield scheduler.stdout.readline().strip()
        scheduler.stdin.write("\n")
        scheduler.stdin.flush()
        assert scheduler.wait(60) == 0


@pytest.fixture
def lab(tmp_path):
    """A bank of 60 positions, one not measured, and a drive."""
    random = np.random.default_rng(3)
    green = (random.standard_normal((60, 4, 200)) * np.exp(-np.arange(200) / 40)).astype(np.float32)
    green[7] = 0.0
    write_arrays(tmp_path / "bank.h5", green, np.column_stack([4.0 * np.arange(60), np.zeros(60)]))
    none = np.zeros(0, np.int64)
    drive_v = random.standard_normal((4, 3000))
    write_drive(tmp_path / "drive.h5", Drive(drive_v, 2000.0, -0.1, "sampled", 1.0, 0.0, none, none, none))
    return tmp_path


def wavefocus(*arguments):
    """Run a command in a process of its own to its good end; what it told people."""
    done = python("-W", "error", "-m", "wavefocus", *arguments)
    assert done.returncode == 0, done.stderr
    return done.stderr


@pytest.mark.nightly
@pytest.mark.parametrize("rate", [(), ("--rate", "500")])
def test_given_a_cluster_then_the_field_is_the_same_to_the_byte(lab, address, rate):
    predict = ["predict", lab / "drive.h5", "--bank", lab / "bank.h5", *rate, "--out"]
    assert "2 workers" in wavefocus(*predict, lab / "there.h5", "--cluster", address)
    wavefocus(*predict, lab / "here.h5")
    assert (lab / "there.h5").read_bytes() == (lab / "here.h5").read_bytes()
    with h5py.File(lab / "there.h5") as file:
        assert file["position_index"][:].tolist() == [row for row in range(60) if row != 7]


@pytest.mark.nightly
@pytest.mark.parametrize("where", ["address", "local"])
def test_given_a_cluster_then_the_estimated_bank_is_the_same_to_the_byte(tmp_path, request, where):
    band_hz = (50.0, 1000.0)
    records = [swept(Sweep(band_hz, 0.8), row[None], 5000.0, 40.0) for row in echoes(2, 200)]
    raw = write(tmp_path / "a.raw.h5", records, 200, 5000.0, band_hz, positions=2)
    cluster = "local:2" if where == "local" else request.getfixturevalue("address")
    wavefocus("estimate", raw, "--bank", tmp_path / "here.h5")
    wavefocus("estimate", raw, "--bank", tmp_path / "there.h5", "--cluster", cluster)
    assert (tmp_path / "there.h5").read_bytes() == (tmp_path / "here.h5").read_bytes()


@pytest.mark.parametrize(
    ("address", "installed", "told"),
    [
        ("local:0", True, "--cluster local:0: local:N starts N processes here, 1 to 256"),
        ("local:two", True, "--cluster local:two: local:N starts N processes here, 1 to 256"),
        ("local", False, "pip install 'dask[distributed]'"),
        pytest.param("nonsense://here:1", True, "--cluster nonsense://here:1", marks=pytest.mark.nightly),
    ],
)
def test_a_cluster_of_no_size_or_scheduler_or_without_dask_then_one_sentence(
    lab, capsys, monkeypatch, address, installed, told
):
    if not installed:
        monkeypatch.setitem(sys.modules, "distributed", None)
    predict = ["predict", str(lab / "drive.h5"), "--bank", str(lab / "bank.h5"), "--out", str(lab / "field.h5")]
    assert run([*predict, "--cluster", address]) == 2
    assert told in capsys.readouterr().err.splitlines()[-1]
    assert not (lab / "field.h5").exists()


def test_given_a_worker_without_the_files_or_with_others_then_it_says_which(lab):
    drive, bank = identity_of(lab / "drive.h5"), identity_of(lab / "bank.h5")
    assert [one.shape for one in field_parts(drive, bank, None, [[3, 1], [2]])] == [(2, 3199), (1, 3199)]
    with pytest.raises(InputError, match="another file there"):
        field_parts(drive, (bank[0], bank[1] + 1, bank[2]), None, [[3]])
    (lab / "drive.h5").unlink()
    with pytest.raises(InputError, match="does not exist there"):
        field_parts(drive, bank, None, [[3]])


def test_given_a_scheduler_that_cancels_then_it_is_said_to_be_gone():
    class Gone:  # Before distributed 2024.7, CancelledError is what a future raises.
        nthreads, submit = staticmethod(dict), lambda self, *_, **__: self

        def result(self, timeout):
            raise distributed.CancelledError

    with pytest.raises(WavefocusError, match="scheduler of the cluster is gone"):
        list(cluster.spread(Gone(), time.sleep, [(0.2,)], stopped="estimating plate"))


@pytest.mark.nightly
@pytest.mark.parametrize("lost", ["scheduler", "worker"])
def test_given_a_cluster_that_dies_then_one_sentence_says_so(tmp_path, lost, capfd, monkeypatch):
    monkeypatch.setattr(cluster, "GIVES_UP_S", 1.0)  # a constant, so that the test need not wait for a minute
    script = tmp_path / "cluster.py"
    script.write_text(SCHEDULER.replace("n_workers=2, threads_per_worker=1", "n_workers=0"), encoding="utf-8")
    quiet = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([sys.executable, str(script)], text=True, **quiet) as scheduler:
        address = scheduler.stdout.readline().strip()
        words = ["-m", "distributed.cli.dask_worker", address, "--no-nanny", "--nthreads", "1", "--no-dashboard"]
        with subprocess.Popen([sys.executable, *words], **quiet) as worker:
            with _joined(address) as client:
                results = cluster.spread(client, time.sleep, [(0.2,)] * 1000, stopped="estimating plate")
                next(results)
                (scheduler if lost == "scheduler" else worker).kill()
                with pytest.raises(WavefocusError, match=f"estimating plate: .*{lost} of the cluster is"):
                    list(results)
            worker.kill()
            scheduler.kill()
    said = capfd.readouterr().err
    assert "Traceback" not in said
    assert "object at 0x" not in said


@contextmanager
def _joined(address):
    """A client of a cluster, as soon as it has a worker."""
    for _ in range(120):
        with suppress(InputError), cluster.cluster_client(address) as client:
            yield client
            return
        time.sleep(0.5)
    pytest.fail("no worker came")
