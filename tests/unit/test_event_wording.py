"""Every event has one sentence, which the terminal and the window show alike."""

from __future__ import annotations

from datetime import UTC, datetime

import pytest

from wavefocus.acquisition.event_wording import sentence
from wavefocus.campaign.status import CampaignView
from wavefocus.config.messages import tag
from wavefocus.config.messages.campaign import (
    ConditionsSeen,
    CrosstalkMeasured,
    Drift,
    Event,
    Fault,
    Logged,
    PassStarted,
    PositionCommitted,
    PositionKept,
    PositionRepeated,
    PositionStarted,
    Progress,
    ReconnectTried,
    RecordTaken,
    ScheduleSettled,
    SessionEnded,
    SessionStarted,
    State,
    StateChanged,
)
from wavefocus.gui.campaign.model import line_of

# Events that a person at the terminal sees, and those that only the window lists.
AT_THE_TERMINAL: tuple[Event, ...] = (
    SessionStarted(0.0, "plate.h5", 6, 3, 2, 4, 60.0, ()),
    StateChanged(0.0, State.PAUSED, "as asked"),
    PositionCommitted(0.0, 7, 4, 2, 12.0, -9.0, 0.0, 0.0, reason="it differs", defects=("neighbour level",)),
    PositionRepeated(0.0, 7, 1, "a burst", (), 2.0, (0.3, 0.4)),
    PositionKept(0.0, 7, 2, "no better"),
    PassStarted(0.0, (3, 4, 5)),
    Fault(0.0, "mirror", "moving", "it is gone", "plug it in", 5, 1, True),
    ReconnectTried(0.0, "mirror", "mirror", 2, False, "no answer", 5.0, 60.0),
    CrosstalkMeasured(0.0, -30.0, 0.0, 0.03, 9.0, True, (), (1, 2), "a cable leaks"),
    Drift(0.0, 0, -0.7, 0.1, 0.99, "warn", "run", "the level changed", ()),
    ConditionsSeen(0.0, {"temperature": 30.0}, False, "temperature is 30"),
    SessionEnded(0.0, State.FINISHED, 6, 6, {"valid": 6}),
)
IN_THE_WINDOW: tuple[Event, ...] = (
    ScheduleSettled(0.0, 3, "staggered", "it is quicker", 2.0, ()),
    PositionStarted(0.0, 7, 2, 4.0, 0.0),
    PositionCommitted(0.0, 7, 1, 1, 41.25, float("nan"), 0.0, 0.0),
    CrosstalkMeasured(0.0, -90.0, 0.0, 0.0, 1.0, False),
    ConditionsSeen(0.0, {}, True, "all is back"),
)
SHOWN_OTHERWISE = {Progress, RecordTaken}


def test_each_kind_of_event_has_an_example_here() -> None:
    kinds = {type(event) for event in (*AT_THE_TERMINAL, *IN_THE_WINDOW)} | SHOWN_OTHERWISE
    assert {kind.__name__ for kind in Event.__subclasses__()} == {kind.__name__ for kind in kinds}


@pytest.mark.parametrize("event", [*AT_THE_TERMINAL, *IN_THE_WINDOW], ids=lambda event: type(event).__name__)
def test_given_an_event_then_terminal_and_window_show_its_one_sentence(
    event: Event, capsys: pytest.CaptureFixture[str]
) -> None:
    text = sentence(event)
    assert text != tag(event)
    assert "nan" not in text
    line = line_of(Logged(datetime.now(UTC), event))
    assert line is not None
    assert line.text == text
    CampaignView(lambda done, total, note="": None)(event)
    shown = capsys.readouterr().err
    assert shown.startswith(text) if event in AT_THE_TERMINAL else shown == ""
