"""Commands and captures in this process, what they report, and a listener that reacts to it."""

import io
import json
from dataclasses import dataclass

import h5py

from tests.system.lines import Lines
from wavefocus.__main__ import run
from wavefocus.campaign.blueprint import blueprint_from_files
from wavefocus.storage.bank.writer import create_bank


def wavefocus(*arguments):
    """Run a command in this process; its exit code."""
    return run([str(argument) for argument in arguments])


def said_by(capsys, *arguments, code=0):
    """What a command writes to standard output, `out`, and to standard error, `err`."""
    capsys.readouterr()
    assert wavefocus(*arguments) == code, arguments
    return capsys.readouterr()


def answered(capsys, *arguments, code=0):
    """What a command answers to a program: its one object."""
    return dict(json.loads(said_by(capsys, *arguments, "--json", code=code).out))


def refused(capsys, *arguments, code=2):
    """The one sentence with which a command ends; nothing is on standard output."""
    told = said_by(capsys, *arguments, code=code)
    (line,) = [line for line in told.err.splitlines() if line.startswith("wavefocus: ")]
    assert (told.out, "Traceback" in told.err) == ("", False)
    return line


def events_of(text, kind=""):
    """The events among lines of JSON: all, or those of a kind."""
    return [event for event in map(json.loads, text.splitlines()) if kind in ("", event["event"])]


def empty_bank(lab, name):
    """A bank of the lab's run as it is now; faults put into the run file later leave no trace in it."""
    create_bank(lab / name, blueprint_from_files(lab / "run.toml").bank_header())
    return lab / name


def capture(lab, bank):
    """Capture into a bank in this process, its events on standard output; the exit code."""
    return run(["capture", str(lab / "run.toml"), "--bank", str(bank), "--json"])


@dataclass(frozen=True, slots=True)
class Told:
    """What a campaign told: events for programs, and lines for people."""

    out: str
    err: str

    def of(self, *kinds):
        """The events of some kinds; all where none is given."""
        return [event for event in events_of(self.out) if not kinds or event["event"] in kinds]

    @property
    def states(self):
        """The states of the session, in order."""
        return [event["state"] for event in self.of("state_changed")]

    @property
    def last(self):
        """The last line that people are told."""
        return self.err.splitlines()[-1]


def told_by(capsys, *command, code=0):
    """What a command that measures tells."""
    return Told(*said_by(capsys, *command, "--json", code=code))


def captured(capsys, lab, *options, code=0):
    """What a capture into the lab's bank tells."""
    return told_by(capsys, "capture", lab / "run.toml", "--bank", lab / "plate.h5", *options, code=code)


def held(bank, name="status"):
    """What a bank holds of its positions."""
    with h5py.File(bank, "r") as file:
        return list(file[name][...].tolist())


def capture_process(lab, bank, environment=None):
    """A capture in a process of its own."""
    return Lines("capture", lab / "run.toml", "--bank", bank, "--json", environment=environment)


def resumed_after_a_kill(lab, bank, *events):
    """Kill a capture once it has told these events, one by one, and go on to the end; what the kill left."""
    with capture_process(lab, bank) as child:
        for event in events:
            child.hear(event)
        child.process.kill()
    left = held(bank)
    assert wavefocus("resume", bank) == 0
    return left


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
