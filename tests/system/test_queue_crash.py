"""The queue file after a kill, a full and a failing disk at each call of an edit: the older one or the newer one."""

from __future__ import annotations

import errno
import json
import shutil
import sys
from pathlib import Path

import pytest

from tests.system.crash.processes import How, Order, Processes
from wavefocus.acquisition.run_queue import add_entry, read_queue

pytestmark = [
    pytest.mark.skipif(sys.platform != "linux", reason="LD_PRELOAD is Linux's"),
    pytest.mark.may_skip("what is loaded before the program sees the calls of Linux"),
]


@pytest.mark.parametrize(
    ("how", "error", "codes"),
    [
        (How.KILL_BEFORE, 0, {0, -9}),
        pytest.param(How.KILL_AFTER, 0, {0, -9}, marks=pytest.mark.long),
        pytest.param(How.KILL_WITHIN, 0, {0, -9}, marks=pytest.mark.long),
        (How.FAIL_ON, errno.ENOSPC, {0, 2}),
        pytest.param(How.FAIL_ONCE, errno.EIO, {0, 2}, marks=pytest.mark.long),
    ],
)
def test_given_a_fault_at_each_call_of_an_edit_then_the_queue_is_the_older_or_the_newer_one(
    tmp_path: Path, how: How, error: int, codes: set[int]
) -> None:
    folder, kept = tmp_path / "lab", tmp_path / "kept.json"
    folder.mkdir()
    queue = folder / "night.json"
    for name in ("a.h5", "b.h5"):
        add_entry(queue, ["check", name], folder)
    shutil.copy(queue, kept)
    edit = ("queue", "move", queue, 2, 1)
    processes = Processes(tmp_path, folder)
    try:
        processes.warm_up(["queue", "list", queue])
        calls = processes.run(*edit).calls or 0
        assert calls > 5
        faults = 0
        for call in range(1, calls + 1):
            shutil.copy(kept, queue)
            ended = processes.run(*edit, order=Order(how, call, error=error or errno.ENOSPC))
            assert ended.code in codes, (call, ended)
            assert "Traceback" not in ended.err
            order = [entry.number for entry in read_queue(queue)]
            assert order in ([1, 2], [2, 1]), call
            faults += ended.code != 0
            assert ended.code != 0 or order == [2, 1], call
            # What a process that was killed has left behind keeps nobody from the next edit.
            assert processes.run("queue", "add", queue, "check", "c.h5").code == 0
            assert len(json.loads(queue.read_text())["runs"]) == 3
            assert {path.name for path in folder.iterdir()} == {"night.json"}
        assert faults
    finally:
        processes.close()
