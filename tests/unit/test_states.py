"""The states of a session: every change that the table has is made, and no other."""

from pathlib import Path

from wavefocus.acquisition.engine.session import Session
from wavefocus.config.messages.campaign import State


def test_given_the_table_then_the_page_about_states_has_the_same_one():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "states.md").read_text(encoding="utf-8")
    rows = {}
    for line in page.splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if len(cells) == 3 and cells[0].strip("`") in set(State):
            words = [word.strip().strip("`") for word in cells[2].split(",")]
            rows[State(cells[0].strip("`"))] = {State(word) for word in words if word in set(State)}
    assert rows == {state: set(follows) for state, follows in Session.FOLLOWS.items()}
