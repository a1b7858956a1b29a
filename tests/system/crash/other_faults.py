"""Disks that fill or fail, bytes that flip, and second processes."""

import os
import signal
import time
from pathlib import Path

import numpy as np

from tests.system.crash.campaign import acknowledged, badly_told
from tests.system.crash.processes import How, HungError, Order, Processes
from tests.unit.mutations import stored_bytes

WRONG_INPUT, FAILED, BUSY = 2, 3, 75


def failing_disk(how, error, campaign, chance, share):
    """Let each call fail once, or with all after it; a full disk lets names go, and has space again afterwards."""
    calls = campaign.calls
    for call in share.of(range(1, calls + 1), calls):
        campaign.clear()
        ended = campaign.processes.run(*campaign.capture, order=Order(how, call, error=error))
        yield 1, badly_told(ended, {0, WRONG_INPUT, FAILED}) + campaign.outcome(acknowledged(ended.out))


def flipped_bytes(campaign, chance, share):
    """Flip bits of a byte anywhere in a bank: it is harmless, repaired or named, and no more is lost."""
    campaign.clear()
    assert campaign.processes.run(*campaign.capture, order=Order(How.KILL_BEFORE, campaign.calls * 3 // 5)).killed
    unfinished = campaign.bank.read_bytes()
    whole = campaign.captured[campaign.bank.name]
    places = _places(campaign)
    while True:
        before, name = chance.choice(((whole, "whole"), (unfinished, "half")))
        kind = chance.choice(sorted(places))
        start, size = chance.choice(places[kind])
        at = start + chance.randrange(size)
        bits = chance.randrange(1, 256)
        content = bytearray(before)
        content[at] ^= bits
        campaign.put({campaign.bank.name: bytes(content)})
        what = f"byte {at} of {kind}, {name}, xor {bits:#x}"
        yield 1, [f"{what}: {note}" for note in _flipped(campaign, content, at)]


def _flipped(campaign, content, at):
    notes = []
    try:
        for command in (("check", campaign.bank), ("status", campaign.bank), campaign.resume):
            ended = campaign.processes.run(*command)
            notes += badly_told(ended, {0, 1, WRONG_INPUT})
            if ended.code == WRONG_INPUT and str(campaign.bank) not in ended.err.splitlines()[-1]:
                notes.append("the refusal does not name the file")
    except HungError as error:
        notes.append(str(error))
    found = campaign.bank.read_bytes()
    if notes or ended.code:
        return notes or (["different: the bank was refused, and changed"] if found != content else [])
    wanted = campaign.captured[campaign.bank.name]
    harmless = bytearray(wanted)
    harmless[at] = content[at]
    if found not in (wanted, harmless):
        notes.append("different: resume went on and did not end as the uninterrupted run")
    return notes + campaign.judge(set(range(len(campaign.rows))))


def _places(campaign):
    """Where a bank keeps what: runs of bytes of datasets, and what HDF5 itself keeps, all else that is not zero."""
    campaign.put(campaign.captured)
    values = stored_bytes(campaign.bank)
    content = np.frombuffer(campaign.captured[campaign.bank.name], np.uint8).copy()
    for start, size in values:
        content[start : start + size] = 0
    # As likely as all datasets together: it is what HDF5 reads before anything can be checked.
    return {"values": values, "metadata": [(int(at), 1) for at in np.flatnonzero(content)]}


def second_process(campaign, chance, share):
    """Start a second process while the first is stopped at a call; then let that go on, or kill it meanwhile."""
    rivals_folder = campaign.folder / "rival"
    rivals_folder.mkdir(exist_ok=True)
    calls = campaign.calls
    with Processes(rivals_folder, campaign.lab) as rival:
        rival.warm_up(["resume", campaign.folder / "warm" / campaign.bank.name])
        while True:
            campaign.clear()
            call, kill = chance.randrange(1, calls + 1), chance.random() < 0.5
            pid = campaign.processes.start(*campaign.capture, order=Order(How.STOP_BEFORE, call))
            if not _stopped(pid):
                campaign.processes.wait()
                continue
            named = campaign.bank.with_name(campaign.bank.name + ".owner")
            # Between its making and its writing the name is empty: the owner is another process, unnamed.
            owned = campaign.bank.exists() and named.exists() and named.stat().st_size > 0
            rival.start(*(campaign.resume if owned else campaign.capture))
            if kill:
                time.sleep(chance.uniform(0, 0.15))
                os.kill(pid, signal.SIGKILL)
                second = rival.wait()
            else:
                second = rival.wait()
                os.kill(pid, signal.SIGCONT)
            first = campaign.processes.wait()
            promised = acknowledged(first.out) | acknowledged(second.out)
            notes = badly_told(second, {BUSY} if owned and not kill else {0, BUSY})
            # Before the bank has its owner either may become it; a maker that comes second goes on with it.
            notes += badly_told(first, {0} if owned or first.killed else {0, BUSY})
            if owned and not kill and f"process {pid} " not in second.err:
                notes.append(f"the owner is not named: {second.err.splitlines()[-1]}")
            yield 1, notes + campaign.outcome(promised)


def _stopped(pid):
    stat = Path(f"/proc/{pid}/stat")
    deadline_s = time.monotonic() + 20.0
    while time.monotonic() < deadline_s:
        try:
            state = stat.read_text(encoding="ascii").rsplit(")", 1)[1].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return False
        if state in "TZ":
            return state == "T"
        time.sleep(0.001)
    return False
