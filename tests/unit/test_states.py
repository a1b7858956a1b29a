"""The states of a session: every change that the table has is made, and no other."""

from __future__ import annotations

from pathlib import Path

from wavefocus.acquisition.engine.session import Session
from wavefocus.config.messages.campaign import State

ENDS = {State.STOPPED, State.FINISHED, State.FAILED}


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
