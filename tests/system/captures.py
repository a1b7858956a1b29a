"""Commands and captures in this process, what they report, and a listener that reacts to it."""

import io
import json

import h5py

from tests.system.lines import Lines
from wavefocus.__main__ import run
from wavefocus.campaign.blueprint import blueprint_from_files
from wavefocus.storage.bank.writer import create_bank


def wavefocus(*arguments):
    """Run a command in this process; its exit code."""
    return run([str(argument) for argument in arguments])


def answered(capsys, *arguments, code=0):
    """What a command answers to a program: its one object."""
    capsys.readouterr()
    assert wavefocus(*arguments, "--json") == code
    return dict(json.loads(capsys.readouterr().out))


def refused(capsys, *arguments, code=2):
    """The one sentence with which a command ends; nothing is on standard output."""
    capsys.readouterr()
    assert wavefocus(*arguments) == code, arguments
    told = capsys.readouterr()
    (line,) = [line for line in told.err.splitlines() if line.startswith("wavefocus: ")]
    assert (told.out, "Traceback" in told.err) == ("", False)
    return line


def of_kind(events, kind):
    """The events of a kind."""
    return [event for event in events if event["event"] == kind]


def events_of(text, kind=""):
    """The events among lines of JSON: all, or those of a kind."""
    return [event for event in map(json.loads, text.splitlines()) if kind in ("", event["event"])]


def states_of(text):
    """The states that lines of JSON tell of, in order."""
    return [event["state"] for event in events_of(text, "state_changed")]


def empty_bank(lab, name):
    """A bank of the lab's run as it is now; faults put into the run file later leave no trace in it."""
    create_bank(lab / name, blueprint_from_files(lab / "run.toml").bank_header())
    return lab / name


def capture(lab, bank):
    """Capture into a bank in this process, its events on standard output; the exit code."""
    return run(["capture", str(lab / "run.toml"), "--bank", str(bank), "--json"])


def held(bank, name="status"):
    """What a bank holds of its positions."""
    with h5py.File(bank, "r") as file:
        return list(file[name][...].tolist())


def capture_process(lab, bank, environment=None):
    """A capture in a process of its own."""
    return Lines("capture", lab / "run.toml", "--bank", bank, "--json", environment=environment)


def resumed_after_a_kill(lab, bank, *events):
    """Kill a capture as soon as it has told these events, one after the other, and go on to the end."""
    with capture_process(lab, bank) as child:
        for event in events:
            child.hear(event)
        child.process.kill()
    assert 0 in held(bank)
    assert wavefocus("resume", bank) == 0


class Listener(io.TextIOBase):
    """Standard output that does something, once each, while the words that it waits for are being told."""

    def __init__(self, *acts):
        self._acts = list(acts)
        self.told = ""

    def write(self, text):
        self.told += text
        if self._acts and self._acts[0][0] in text:
            self._acts.pop(0)[1]()
        return len(text)
