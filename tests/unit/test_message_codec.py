"""Messages between processes are written and read by one codec."""

import json
from collections.abc import Mapping
from contextlib import nullcontext
from datetime import UTC
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
def test_a_message_is_read_as_written_and_only_orders_refuse_keys_of_later_versions(family, kind):
    hints = get_type_hints(kind, include_extras=True).items()

    @settings(max_examples=4)
    @given(
        st.builds(
            kind, **{name: STRATEGIES[hint] if hint in STRATEGIES else st.from_type(hint) for name, hint in hints}
        )
    )
    def check(message):
        record = json.loads(messages.to_line(message))
        found = messages.message_of(record, family)
        assert type(found) is kind
        assert messages.to_record(found) == messages.to_record(message)
        with pytest.raises(messages.MessageError, match="unknown field") if family is ORDERS else nullcontext():
            messages.message_of(record | {"of_a_later_version": 1}, family)

    check()


class _Beat(messages.EventMessage, frozen=True, tag="beat"):
    level_db: messages.Number


@pytest.mark.parametrize(("level_db", "sentence"), [(10**400, "Expected a finite number"), ("1", "Expected a number")])
def test_given_a_wrong_number_then_its_key_is_named_and_what_is_expected(level_db, sentence):
    with pytest.raises(messages.MessageError, match=f"level_db: {sentence}"):
        messages.from_record(_Beat, {"level_db": level_db})
