"""A session as documents of bluesky's event model, in JSON lines as its `JSONLinesWriter` writes them.

A session is a run: a start document, a descriptor of its one stream ``primary`` with an event for each committed
position, a stream resource that names the bank, and a stop document. Source: event-model 1.x of bluesky, the schemas of
start, descriptor, event, stream resource, stream datum and stop.
"""

from __future__ import annotations

import json
import uuid
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

from wavefocus.acquisition.plan import Plan
from wavefocus.config.messages.campaign import Event, PositionCommitted, SessionEnded, SessionStarted, State

EXIT_STATUS = {State.FINISHED: "success", State.STOPPED: "abort"}
_UNITS = {"x_mm": "mm", "y_mm": "mm", "snr_db": "dB", "residual_db": "dB"}


class Documents:
    """Turns the events of one session into documents; a subscriber.

    write: Takes a line with its end.
    """

    def __init__(self, write: Callable[[str], object], plan: Plan, bank: Path) -> None:
        self._write, self._plan, self._bank = write, plan, bank
        self._run, self._stream, self._resource = (str(uuid.uuid4()) for _ in range(3))
        self._count = 0

    def __call__(self, event: Event) -> None:
        """Write the documents of an event, if it has any."""
        if isinstance(event, SessionStarted):
            self._begin(event)
        elif isinstance(event, PositionCommitted):
            self._position(event)
        elif isinstance(event, SessionEnded):
            self._end(event)

    def _begin(self, event: SessionStarted) -> None:
        plan = self._plan
        self._document(
            "start", uid=self._run, scan_id=1, plan_name="wavefocus capture", plan_args={"sha256": plan.sha256},
            num_points=event.to_do, motors=["x_mm", "y_mm"], detectors=["green"],
            hints={"dimensions": [[["x_mm", "y_mm"], "primary"]]}, versions={"wavefocus": version("wavefocus")},
            instruments=list(event.instruments),
        )  # fmt: skip
        keys: dict[str, dict[str, Any]] = {
            name: {"source": "wavefocus", "dtype": dtype, "shape": [], "units": _UNITS.get(name)}
            for name, dtype in (
                ("position", "integer"), ("x_mm", "number"), ("y_mm", "number"), ("status", "integer"),
                ("attempts", "integer"), ("snr_db", "number"), ("residual_db", "number"),
            )
        }  # fmt: skip
        shape = [plan.positions, plan.actuators, plan.taps]
        keys["green"] = {
            "source": "wavefocus", "dtype": "array", "dtype_numpy": "<f4", "shape": shape, "external": "STREAM:",
            "dims": ["position", "actuator", "time_s"],
        }  # fmt: skip
        self._document(
            "descriptor", uid=self._stream, run_start=self._run, name="primary", data_keys=keys, object_keys={},
            configuration={}, hints={},
        )  # fmt: skip
        self._document(
            "stream_resource", uid=self._resource, run_start=self._run, data_key="green", mimetype="application/x-hdf5",
            uri=self._bank.absolute().as_uri(), parameters={"dataset": "green", "chunk_shape": [1, *shape[1:]]},
        )  # fmt: skip

    def _position(self, event: PositionCommitted) -> None:
        now_s = _now_s()
        x_mm, y_mm = self._plan.position_mm[event.position].tolist()
        data = {
            "position": event.position, "x_mm": x_mm, "y_mm": y_mm, "status": event.status, "attempts": event.attempts,
            "snr_db": event.snr_db, "residual_db": event.residual_db,
        }  # fmt: skip
        self._count += 1
        self._document(
            "event", uid=str(uuid.uuid4()), descriptor=self._stream, seq_num=self._count, data=data,
            timestamps=dict.fromkeys(data, now_s), filled={},
        )  # fmt: skip
        self._document(
            "stream_datum", uid=f"{self._resource}/{self._count - 1}", stream_resource=self._resource,
            descriptor=self._stream, seq_nums={"start": self._count, "stop": self._count + 1},
            indices={"start": event.position, "stop": event.position + 1},
        )  # fmt: skip

    def _end(self, event: SessionEnded) -> None:
        self._document(
            "stop", uid=str(uuid.uuid4()), run_start=self._run, exit_status=EXIT_STATUS.get(event.state, "fail"),
            reason=event.failure, num_events={"primary": self._count},
        )  # fmt: skip

    def _document(self, kind: str, **content: Any) -> None:
        if kind not in ("stream_resource", "stream_datum"):
            content["time"] = _now_s()
        self._write(json.dumps({"name": kind, "doc": content}, allow_nan=False) + "\n")


def _now_s() -> float:
    return datetime.now(UTC).timestamp()
