"""The conditions that a rig is watched for: bands, their thresholds and where the values come from."""

from __future__ import annotations

from itertools import pairwise
from typing import Annotated, Any

from pydantic import Field, model_validator

from config.fields import Finite, NonNegative, Positive, Table, mistake
from config.rig_recorder import AnalogInput

# Without thresholds of its own a condition must come back by this share of its limit.
INSIDE = 0.1


class BandSection(Table):
    """Where a value must stay, and within which thresholds it is back."""

    leaves_below: Finite | None = None
    leaves_above: Finite | None = None
    returns_above: Finite | None = None
    returns_below: Finite | None = None
    settle_s: Annotated[NonNegative, Field(le=86_400)] = 60.0

    @model_validator(mode="before")
    @classmethod
    def _thresholds(cls, data: Any) -> Any:
        """Fill in the inner thresholds, so that the validated rig says them outright."""
        if not isinstance(data, dict):
            return data
        data = dict(data)
        for leaves, returns, inwards in (
            ("leaves_below", "returns_above", 1.0),
            ("leaves_above", "returns_below", -1.0),
        ):
            limit = data.get(leaves)
            if isinstance(limit, int | float) and not isinstance(limit, bool) and data.get(returns) is None:
                data[returns] = limit + inwards * INSIDE * abs(limit)
        return data

    @model_validator(mode="after")
    def _hysteresis(self) -> BandSection:
        if self.leaves_below is None and self.leaves_above is None:
            raise mistake("leaves_below", None, "is needed, or leaves_above, or both")
        edges = (self.leaves_below, self.returns_above, self.returns_below, self.leaves_above)
        names = ("leaves_below", "returns_above", "returns_below", "leaves_above")
        known = [(name, edge) for name, edge in zip(names, edges, strict=True) if edge is not None]
        for (lower_name, lower), (name, edge) in pairwise(known):
            if edge < lower:
                raise mistake(name, edge, f"must be at least {lower_name} = {lower:g}")
        return self


class RoomSection(BandSection):
    """Room temperature: a transmitter's voltage at an input of the recorder's box."""

    input: AnalogInput = "ai2"
    celsius_per_v: Finite = 100.0
    celsius_at_0_v: Finite = 0.0


class WatchSection(Table):
    """What is watched while a campaign is under way; nothing, if absent."""

    probe_every_s: Annotated[Positive, Field(le=86_400)] = 30.0
    give_up_after_s: Annotated[NonNegative, Field(le=7 * 86_400)] = 7200.0
    reference: BandSection | None = None
    noise: BandSection | None = None
    light: BandSection | None = None
    room: RoomSection | None = None
