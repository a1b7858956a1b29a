"""Messages about a campaign: real addresses of a real web server on this machine, through apprise."""

import http.server
import json
import threading

import pytest

from tests.lab_files import POSITIONS, write_positions
from tests.system.captures import captured, refused, wavefocus
from tests.system.conftest import add_to_rig
from tests.system.lines import wait_until
from wavefocus.acquisition.event_wording import sentence
from wavefocus.config.messages.campaign import Drift, Fault, SessionEnded, State, StateChanged
from wavefocus.config.rig import MessagesSection
from wavefocus.configuration import load_rig
from wavefocus.rig.unattended import AppriseOutbox, Messenger, message_findings

PASSWORD = "secret-word-7"


class Office(http.server.ThreadingHTTPServer):
    """A web server that takes messages; `busy` lets it refuse them."""

    busy = False

    def __init__(self):
        super().__init__(("127.0.0.1", 0), Desk)
        self.taken = []
        self.url = f"json://technician:{PASSWORD}@127.0.0.1:{self.server_port}/night"

    def wait_for(self, count):
        wait_until(lambda: len(self.taken) >= count, f"{count} messages")
        return self.taken

    def messenger(self, folder, **section):
        """What tells this office of a campaign."""
        return Messenger(folder / "plate.h5", MessagesSection(**section), AppriseOutbox([self.url]))


class Desk(http.server.BaseHTTPRequestHandler):
    def do_POST(self):
        self.server.taken.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
        self.send_response(503 if self.server.busy else 200)
        self.end_headers()

    def log_message(self, *_):
        pass


@pytest.fixture
def office():
    with Office() as office:
        thread = threading.Thread(target=office.serve_forever)
        thread.start()
        yield office
        office.shutdown()
        thread.join()


def drift(verdict, occasion="run"):
    return Drift(1.0, 0, -0.7, 0.1, 0.99, verdict, occasion, "the level changed", ())


def ended(state):
    return SessionEnded(7200.0, state, 6, 6, {"not-measured": 0, "valid": 6, "poor": 0})


FAILED = (
    Fault(1.0, "recorder", "reading", "an overrun", "close other programs", 3, 1, retried=True),
    StateChanged(2.0, State.FAILED, "player: playing: no device; plug it in"),
    ended(State.FAILED),
)
FINISHED = (StateChanged(0.0, State.RUNNING, "6 positions to do"), ended(State.FINISHED))
UNCONFIRMED = (drift("stop"), FAILED[0], drift("steady", "repeat"))
DRIFTING = (*map(drift, ("steady", "warn", "warn", "steady")), drift("stop"), drift("warn", "repeat"))


@pytest.mark.parametrize(
    ("about", "events", "titles", "words"),
    [
        ({}, FINISHED, ["finished"], [sentence(ended(State.FINISHED))]),
        ({}, FAILED, ["failed"], ["player: playing: no device", "plug it in", "wavefocus resume plate.h5"]),
        # When it begins, and not again.
        ({}, (*DRIFTING, ended(State.FINISHED)), ["drift", "drift", "finished"], ["level -0.70 dB", "level changed"]),
        ({}, (*UNCONFIRMED, ended(State.FINISHED)), ["finished"], []),
        ({"about": ("failed",)}, (drift("warn"), *FINISHED), [], []),
    ],
    ids=["finished", "failed", "drift", "drift not confirmed", "only failures"],
)
def test_given_a_campaign_s_events_then_those_that_are_asked_for_are_told(
    office, tmp_path, about, events, titles, words
):
    with office.messenger(tmp_path, **about) as messenger:
        for event in events:
            messenger(event)
    assert [message["title"] for message in office.taken] == [f"plate.h5: {title}" for title in titles]
    for word in words:
        assert word in office.taken[0]["message"]
    assert not any("close other programs" in message["message"] for message in office.taken)


def test_given_a_wait_longer_than_allowed_then_it_is_told_once_and_so_is_its_end(office, tmp_path):
    with office.messenger(tmp_path, suspended_after_min=0.002) as messenger:
        messenger(StateChanged(1.0, State.RECOVERING, "mirror: unplugged"))
        assert "mirror: unplugged" in office.wait_for(1)[0]["message"]
        messenger(StateChanged(9.0, State.RUNNING, "mirror is connected again after 8 s"))
        assert office.wait_for(2)[1]["title"] == "plate.h5: goes on"
        messenger(StateChanged(10.0, State.RECOVERING, "mirror: unplugged"))
        messenger(StateChanged(10.1, State.RUNNING, "mirror is connected again"))
    assert len(office.taken) == 2


def test_given_an_address_that_takes_nothing_then_it_is_told_without_the_address(office, tmp_path, capsys):
    office.busy = True
    with office.messenger(tmp_path) as messenger:
        messenger(ended(State.FINISHED))
    told = capsys.readouterr().err
    assert "messages: not taken by 1 of the addresses (json)" in told
    assert PASSWORD not in told


def test_given_an_address_of_no_kind_then_its_number_key_and_variable_are_named(tmp_path, monkeypatch, capsys):
    (tmp_path / "run.toml").write_text("[grid]\nspacing_mm = 60\n", encoding="utf-8")
    monkeypatch.setenv("WAVEFOCUS_MESSAGES", f"json://127.0.0.1 {PASSWORD}")
    told = refused(capsys, "capture", tmp_path / "run.toml", "--bank", tmp_path / "plate.h5")
    assert "messages.urls, WAVEFOCUS_MESSAGES: address 1" in told
    assert PASSWORD not in told


# Mistaken tables of messages: without a kind before it, a password looks like any other text.
MISTAKEN = [
    "[messages]\nurls = '{0}'",
    "[messages]\nurls = ['a', '{0}', 3]",
    "[messages]\nurls = [['{0}']]",
    "[messages]\nurls = {{ '{0}' = 1 }}",
    "[messages]\nurl = '{0}'",
    "[messages]\nabout = '{0}'",
    "[messages]\nabout = ['{0}']",
    "[messages]\nsuspended_after_min = '{0}'",
    "[messages]\n'{0}' = 1",
    "[messages]\n'json://{0}@host' = 1",
    "[[messages.urls]]\n'{0}' = '{0}'",
    "messages = '{0}'",
    "urls = '{0}'",
    "[[messages]]\nurls = '{0}'",
    "[message]\nurls = '{0}'",
    "[player]\nurls = ['{0}']",
]


def test_given_a_password_in_a_mistaken_table_of_messages_then_no_command_shows_it(tmp_path, capsys):
    (tmp_path / "run.toml").write_text('rig = "rig.toml"\n', encoding="utf-8")
    for text in MISTAKEN:
        (tmp_path / "rig.toml").write_text(text.format(PASSWORD) + "\n", encoding="utf-8")
        told = refused(capsys, "plan", tmp_path / "run.toml")
        assert "rig.toml: " in told
        assert PASSWORD not in told, text


def test_the_doctor_sends_to_each_address_and_names_the_one_that_takes_none(office, tmp_path):
    urls = [office.url, "json://127.0.0.1:9/nobody"]
    (tmp_path / "rig.toml").write_text(f"[messages]\nurls = {urls}\n", encoding="utf-8")
    rig = load_rig(tmp_path / "rig.toml")
    found = list(message_findings(rig, "rig.toml", send=True))
    assert [one.verdict for one in found] == ["ok", "fail"]
    assert [message["title"] for message in office.taken] == ["rig.toml: test"]
    assert [one.verdict for one in message_findings(rig, "rig.toml", send=False)] == ["ok"]
    assert len(office.taken) == 1


def test_addresses_stand_nowhere_and_resume_takes_them_from_the_environment(office, lab, capsys, monkeypatch):
    add_to_rig(lab, f'[messages]\nurls = ["{office.url}"]\n')
    write_positions(lab, POSITIONS[:2])
    told = captured(capsys, lab)
    assert [message["title"] for message in office.taken] == ["plate.h5: finished"]
    monkeypatch.setenv("WAVEFOCUS_MESSAGES", office.url)
    assert wavefocus("remeasure", lab / "plate.h5", "--positions", "1") == 0
    assert [message["title"] for message in office.taken] == ["plate.h5: finished"] * 2
    assert PASSWORD not in "".join((told.out, told.err, *capsys.readouterr()))
    for file in lab.iterdir():
        if file.name != "rig.toml":
            assert PASSWORD.encode() not in file.read_bytes(), file
