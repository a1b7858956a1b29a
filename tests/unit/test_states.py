"""The states of a session: every change that the table has is made, and no other."""

from __future__ import annotations

from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.acquisition.engine.session import IllegalStateError, Session, StopRequest
from wavefocus.config.messages.campaign import State, StateChanged

ENDS = {State.STOPPED, State.FINISHED, State.FAILED}


class Hours:
    """A clock that a test turns on."""

    def __init__(self) -> None:
        self.now = 0.0

    def now_s(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


@given(asked=st.lists(st.tuples(st.sampled_from(State), st.floats(0.0, 100.0)), max_size=40))
def test_any_course_of_events_is_legal_or_refused_and_time_away_is_not_work(asked: list[tuple[State, float]]) -> None:
    clock, told = Hours(), []
    life = Session(clock, told.append, StopRequest())
    worked_s = 0.0
    for state, seconds in asked:
        before = life.state
        clock.sleep(seconds)
        worked_s += seconds if before not in Session.AWAY else 0.0
        if state in Session.FOLLOWS[before]:
            life.enter(state, "why")
            assert told[-1] == StateChanged(clock.now, state, "why")
        else:
            count = len(told)
            with pytest.raises(IllegalStateError, match=f"{state} cannot follow {before}"):
                life.enter(state, "why")
            assert (life.state, len(told)) == (before, count)
        if before in ENDS:
            assert life.state is before
    if life.state not in Session.AWAY:
        assert life.working_s()[0] == pytest.approx(worked_s)


def test_given_the_table_then_every_state_can_be_reached_and_every_one_can_end() -> None:
    def reached_from(start: State) -> set[State]:
        found, left = {start}, [start]
        while left:
            for state in Session.FOLLOWS[left.pop()] - found:
                found.add(state)
                left.append(state)
        return found

    assert reached_from(State.IDLE) == set(State)
    for state in set(State) - ENDS:
        # Whatever happens, an error and an impatient person must be able to end it.
        assert {State.FAILED, State.STOPPED} <= Session.FOLLOWS[state]


def test_given_the_table_then_the_page_about_states_has_the_same_one() -> None:
    page = (Path(__file__).parents[2] / "docs" / "reference" / "states.md").read_text(encoding="utf-8")
    rows = {}
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 3 and cells[0].strip("`") in set(State):
            words = [word.strip().strip("`") for word in cells[2].split(",")]
            rows[State(cells[0].strip("`"))] = {State(word) for word in words if word in set(State)}
    assert rows == {state: set(follows) for state, follows in Session.FOLLOWS.items()}
