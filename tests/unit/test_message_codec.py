"""Messages between processes are written and read by one codec."""

import json
import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, get_type_hints

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavefocus.config import messages
from wavefocus.config.messages.operate import OPERATE_EVENTS, ORDERS
from wavefocus.config.messages.rig_checks import CALIBRATE_EVENTS, VERIFY_MESSAGES, Examination, FindingMade

FAMILIES = (ORDERS, OPERATE_EVENTS, CALIBRATE_EVENTS, (FindingMade,), (Examination,), VERIFY_MESSAGES)


FINITE = st.floats(allow_nan=False, allow_infinity=False)
STRATEGIES = {  # figures of events may be NaN, those of orders may not
    float: FINITE,
    float | None: st.none() | FINITE,
    str | int | float | None: st.none() | st.text() | st.integers(),
    messages.Instant: st.datetimes(timezones=st.just(UTC)),
    Mapping[str, Any]: st.just({"format": "wavefocus"}),
}
st.register_type_strategy(messages.Number, st.floats())


@pytest.mark.parametrize(("family", "kind"), [(family, kind) for family in FAMILIES for kind in family])
def test_given_a_message_then_it_is_read_as_it_was_written(family, kind):
    hints = get_type_hints(kind, include_extras=True).items()

    @settings(max_examples=4)
    @given(
        st.builds(
            kind, **{name: STRATEGIES[hint] if hint in STRATEGIES else st.from_type(hint) for name, hint in hints}
        )
    )
    def check(message):
        found = messages.message_of(json.loads(messages.to_line(message)), family)
        assert type(found) is kind
        assert messages.to_record(found) == messages.to_record(message)

    check()


class _Beat(messages.EventMessage, frozen=True, tag="beat"):
    at: messages.Instant
    level_db: messages.Number = math.nan
    count: int = 0


class _Order(messages.OrderMessage, frozen=True, tag="rest"):
    at: messages.Instant
    level_db: float = 0.0


NOW = datetime(2026, 1, 1, tzinfo=UTC)


def test_a_key_of_a_later_version_or_no_figure_is_passed_over_but_in_an_order():
    record = {"event": "beat", "at": NOW.isoformat(), "level_db": None, "colour": 1}
    beat = messages.from_record(_Beat, record)
    assert (beat.at, math.isnan(beat.level_db)) == (NOW, True)
    with pytest.raises(messages.MessageError, match="unknown field `colour`"):
        messages.from_record(_Order, {"order": "rest", "at": NOW.isoformat(), "colour": 1})
    with pytest.raises(messages.MessageError, match="level_db: Expected `float`"):
        messages.from_record(_Order, {"order": "rest", "at": NOW.isoformat(), "level_db": None})


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({}, "missing required field `at`"),
        ({"at": 3}, "at: Expected `datetime`"),
        ({"at": NOW.isoformat(), "count": True}, "count: Expected `int`"),
        ({"at": NOW.isoformat(), "level_db": 10**400}, "level_db: Expected a finite number"),
        ({"at": NOW.isoformat(), "level_db": "1"}, "level_db: Expected a number"),
    ],
)
def test_given_a_wrong_value_then_its_key_is_named_and_what_is_expected(content, sentence):
    with pytest.raises(messages.MessageError, match=sentence):
        messages.from_record(_Beat, content)
