"""Messages between processes are written and read by one codec."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, fields
from datetime import UTC, datetime

import pytest
from hypothesis import given
from hypothesis import strategies as st

from wavefocus.config.messages.codec import Message, MessageError, from_record, message_of, to_line, to_record
from wavefocus.config.messages.operate import OPERATE_EVENTS, ORDERS, Jog, LevelMeasured, MirrorMoved, Reconnect
from wavefocus.config.messages.rig_checks import CALIBRATE_EVENTS, VERIFY_MESSAGES, Examination, FindingMade

FAMILIES = (ORDERS, OPERATE_EVENTS, CALIBRATE_EVENTS, (FindingMade,), (Examination,), VERIFY_MESSAGES)


@pytest.mark.parametrize(("family", "kind"), [(family, kind) for family in FAMILIES for kind in family])
def test_given_a_message_then_it_is_read_as_it_was_written(family: tuple[type[Message], ...], kind: type[Message]):
    values = {"calibration": st.just({"format": "wavefocus"}), "at": st.datetimes(timezones=st.just(UTC))}
    given_values = {field.name: values[field.name] for field in fields(kind) if field.name in values}

    @given(st.builds(kind, **given_values))
    def check(message: Message) -> None:
        found = message_of(json.loads(to_line(message)), family)
        assert type(found) is kind
        assert to_record(found) == to_record(message)

    check()


@dataclass(frozen=True)
class _Beat(Message, event="beat"):
    at: datetime
    level_db: float = math.nan
    count: int = 0


NOW = datetime(2026, 1, 1, tzinfo=UTC)


def test_given_fixed_keys_and_an_infinite_figure_then_the_record_is_plain_json() -> None:
    assert to_record(_Beat(NOW, math.inf)) == {
        "event": "beat", "at": "2026-01-01T00:00:00+00:00", "level_db": None, "count": 0,
    }  # fmt: skip


def test_given_a_key_of_a_later_version_then_it_is_passed_over_unless_strict() -> None:
    record = {"event": "beat", "at": NOW.isoformat(), "level_db": None, "colour": 1}
    beat = from_record(_Beat, record)
    assert (beat.at, math.isnan(beat.level_db)) == (NOW, True)
    with pytest.raises(MessageError, match="colour is not known; allowed: at, level_db, count"):
        from_record(_Beat, record, strict=True)


@pytest.mark.parametrize(
    ("content", "sentence"),
    [
        ({}, "at is missing"),
        ({"at": 3}, "at is 3; allowed: an instant"),
        ({"at": NOW.isoformat(), "count": True}, "count is True; allowed: a whole number"),
        ({"at": NOW.isoformat(), "level_db": 10**400}, "allowed: a finite number"),
        ({"at": NOW.isoformat(), "level_db": "1"}, "level_db is '1'"),
    ],
)
def test_given_a_wrong_value_then_key_and_value_are_named(content: dict[str, object], sentence: str) -> None:
    with pytest.raises(MessageError, match=sentence):
        from_record(_Beat, content)


def test_given_nested_and_chosen_values_then_they_are_checked_too() -> None:
    channel = {"rms_v": 1, "peak_v": 1, "offset_v": 0, "range_v": 10, "over_range": 0}
    with pytest.raises(MessageError, match="over_range is 0; allowed: true, false"):
        from_record(LevelMeasured, {"reference": channel, "response": channel})
    with pytest.raises(MessageError, match="instrument is 'laser'; allowed: mirror, recorder, player"):
        from_record(Reconnect, {"order": "reconnect", "instrument": "laser"})


def test_given_another_kind_then_there_is_no_message() -> None:
    assert message_of({"event": "opening"}, (MirrorMoved,)) is None
    assert message_of({"order": "jog", "x_mm": 1}, ORDERS) == Jog(x_mm=1.0)
