"""A session that is asked to stop, to pause or to end at once, at every moment that it reports."""

from contextlib import suppress
from itertools import pairwise

import pytest

from tests.lab_files import POSITIONS, change_text, write_positions
from tests.system.conftest import with_faults, write_lab
from wavefocus.acquisition.drift_watch import DriftError
from wavefocus.acquisition.engine.campaign import Campaign
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.campaign.blueprint import blueprint_from_files
from wavefocus.config.messages.campaign import (
    CrosstalkMeasured,
    Drift,
    Fault,
    PositionCommitted,
    PositionStarted,
    ReconnectTried,
    SessionEnded,
    State,
    StateChanged,
)
from wavefocus.drivers.errors import InstrumentError
from wavefocus.rig.setup import open_setup
from wavefocus.storage.bank.writer import BankWriter, create_bank

WATCH = """
[watch]
probe_every_s = 1.0
give_up_after_s = 60.0
[watch.noise]
leaves_above = 0.01
settle_s = 2.0
"""
# In turn: a lost mirror, darkness over some records, a recorder that is lost while it is dark.
FAULTS = (
    'role = "mirror"\noperation = "move_to"\nkind = "unplugged"\nat_call = 2\ntries = 1',
    'role = "recorder"\noperation = "read"\nkind = "dark"\nat_call = 6\ncount = 8',
    'role = "recorder"\noperation = "read"\nkind = "unplugged"\nat_call = 11\ntries = 1',
)


@pytest.fixture(scope="module")
def blueprint(tmp_path_factory):
    lab = write_lab(tmp_path_factory.mktemp("run"))
    write_positions(lab, POSITIONS[:3])
    change_text(lab / "rig.toml", "[actuators]", f"{WATCH}[actuators]")
    change_text(lab / "run.toml", "averages = 2", "averages = 1")
    change_text(lab / "run.toml", "[virtual]", "[drift]\nevery_positions = 2\n[virtual]")
    with_faults(lab, *FAULTS)
    return blueprint_from_files(lab / "run.toml")


class TrialSession:
    """One session, in which something is done at one of the events that it publishes."""

    def __init__(self, blueprint, bank, at, act, unvouched=()):
        self.stop, self.events = StopRequest(), []
        self._at, self._act = at, act
        if not bank.exists():
            create_bank(bank, blueprint.bank_header())
        configuration = blueprint.configuration
        with (
            # A mirror that is gone at the end cannot be parked; a sentinel measured in the dark is not what it was.
            suppress(InstrumentError, DriftError),
            BankWriter.open(bank, plan_sha256=blueprint.plan.sha256) as writer,
            open_setup(configuration.rig, configuration.run) as setup,
        ):
            try:
                Campaign(blueprint.plan, setup, writer, self._publish, self.stop, unvouched=unvouched).run()
            finally:
                self.measured = writer.status.copy()

    def _publish(self, event):
        self.events.append(event)
        if isinstance(event, StateChanged) and event.state is State.PAUSED:
            self.stop.go_on()
        if len(self.events) - 1 == self._at:
            self._act(self)


def at_once(_session):
    raise KeyboardInterrupt


# Each is tried at every so many moments; of the nightly run at each.
ACTS = {
    "stop": (lambda session: session.stop.finish_position(), 6),
    "pause": (lambda session: session.stop.pause(), 12),
    "pause and go on": (lambda session: (session.stop.pause(), session.stop.go_on()), 14),
    "pause and stop": (lambda session: (session.stop.pause(), session.stop.finish_position()), 13),
    "at once": (at_once, 9),
}


@pytest.fixture(scope="module")
def moments(blueprint, tmp_path_factory):
    """Where events of an undisturbed session differ from all before in kind or state; the last two tell of the end."""
    whole = TrialSession(blueprint, tmp_path_factory.mktemp("whole") / "whole.h5", -1, at_once)
    states = [one.state for one in whole.events if isinstance(one, StateChanged)]
    assert states[-1] is State.FINISHED
    assert {State.RECOVERING, State.SUSPENDED} <= set(states)
    assert any(isinstance(one, Fault | ReconnectTried) for one in whole.events)
    seen, course = {}, State.IDLE
    for at, event in enumerate(whole.events[:-2]):
        course = event.state if isinstance(event, StateChanged) else course
        seen.setdefault((type(event), course), at)
    return sorted(seen.values())


@pytest.mark.parametrize(
    ("act", "every"),
    [
        *(
            pytest.param(*one, marks=() if name in ("stop", "at once") else pytest.mark.long)
            for name, one in ACTS.items()
        ),
        *(pytest.param(act, 1, marks=pytest.mark.nightly) for act, _ in ACTS.values()),
    ],
    ids=[*ACTS, *(f"{name}, each" for name in ACTS)],
)
def test_a_request_at_any_event_changes_states_by_the_table_and_ends(blueprint, moments, tmp_path, act, every):
    for at in moments[::every]:
        session = TrialSession(blueprint, tmp_path / f"{at}.h5", at, act)
        course = [State.IDLE, *(one.state for one in session.events if isinstance(one, StateChanged))]
        assert all(after in Session.FOLLOWS[before] for before, after in pairwise(course))
        assert not Session.FOLLOWS[course[-1]]
        assert isinstance(session.events[-1], SessionEnded)
        # Nothing that was measured in the dark is in the bank.
        assert not set(session.measured.tolist()) - {0, 1}


DARK = 'role = "recorder"\noperation = "read"\nkind = "dark"\nattempt = 1\nposition = '
# In the pass, one position becomes valid and the next ten do not: it ends before the last one.
FUTILE = (lambda session: None, PositionStarted, 13, (1, *(f"{at}\ncount = 9" for at in range(2, 13))))
STOPPED, PAUSED = ((ACTS[name][0], PositionStarted, 2, ()) for name in ("stop", "pause"))


@pytest.mark.parametrize(
    ("act", "kind", "positions", "dark"),
    [
        STOPPED,
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (PAUSED, (at_once, CrosstalkMeasured, 2, ()), FUTILE)
        ),
    ],
)
def test_a_campaign_finishes_only_after_a_look_at_the_sentinel(tmp_path, act, kind, positions, dark):
    lab = write_lab(tmp_path)
    write_positions(lab, [(2.0 * x, 0.0) for x in range(positions)])
    change_text(lab / "run.toml", "[quality]", "[quality]\nmax_attempts = 1")
    with_faults(lab, *(f"{DARK}{one}" for one in dark))
    blueprint = blueprint_from_files(lab / "run.toml")
    whole = TrialSession(blueprint, lab / "whole.h5", -1, act).events
    last = max(at for at, event in enumerate(whole) if isinstance(event, kind))
    events = TrialSession(blueprint, lab / "plate.h5", last, act).events
    if events[-1].state is State.STOPPED:
        events += TrialSession(blueprint, lab / "plate.h5", -1, act, unvouched=range(2)).events
    assert events[-1].state is State.FINISHED
    assert isinstance([one for one in events if isinstance(one, Drift | PositionCommitted)][-1], Drift)
