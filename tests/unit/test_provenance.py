"""How a bank came to be, read from the log next to it."""

from __future__ import annotations

from pathlib import Path

from wavefocus.campaign.provenance import devices_of, sessions_of
from wavefocus.config.messages.campaign import (
    Drift,
    Event,
    PositionCommitted,
    PositionRepeated,
    SessionEnded,
    SessionStarted,
    State,
    event_line,
)
from wavefocus.config.rig import RigConfig
from wavefocus.drivers.protocols import DeviceIdentity

MIRROR = DeviceIdentity("ASI", "Tiger", "T-17")


def write_log(bank: Path, *events: Event) -> None:
    lines = "".join(map(event_line, events))
    bank.with_suffix(".events.jsonl").write_text(lines + '{"at": "2026-', encoding="utf-8")  # torn by a power cut


def committed(position: int) -> PositionCommitted:
    return PositionCommitted(1.0, position, 1, 1, 60.0, -60.0, 0.0, 0.0)


def drift(verdict: str) -> Drift:
    return Drift(1.0, 0, 0.1, 0.0, 1.0, verdict, "run", "", ())


def test_given_a_log_then_its_sessions_are_counted_one_by_one(tmp_path: Path) -> None:
    write_log(
        tmp_path / "plate.h5",
        SessionStarted(0.0, "plate.h5", 3, 2, 0, 3, 60.0, (), {"mirror": MIRROR}),
        committed(0),
        SessionStarted(0.0, "plate.h5", 3, 2, 1, 2, 40.0, ()),
        PositionRepeated(1.0, 1, 1, "noise"),
        committed(1),
        committed(2),
        drift("steady"),
        drift("warn"),
        SessionEnded(9.0, State.FINISHED, 3, 3, {"valid": 3}),
    )
    first, second = sessions_of(tmp_path / "plate.h5")
    assert (first.outcome, first.counts["positions measured"]) == ("no end is logged", 1)
    assert first.devices == {"mirror": MIRROR}
    assert (second.outcome, second.done, second.total) == ("finished", 3, 3)
    assert dict(second.counts) == {
        "repeated attempts": 1,
        "positions measured": 2,
        "comparisons with the sentinel position": 2,
        "of them not steady": 1,
    }
    assert first.started <= first.ended <= second.started <= second.ended


def test_given_no_log_then_there_are_no_sessions(tmp_path: Path) -> None:
    assert sessions_of(tmp_path / "plate.h5") == []


def test_given_devices_of_a_session_then_they_count_and_serial_numbers_of_usb_devices_fill_gaps(
    tmp_path: Path,
) -> None:
    usb = [
        {"role": role, "vendor_id": 1, "product_id": 2, "serial_number": serial}
        for role, serial in (("mirror", "adapter"), ("player", "P-3"))
    ]
    rig = RigConfig.model_validate({"usb": usb})
    write_log(tmp_path / "plate.h5", SessionStarted(0.0, "plate.h5", 3, 2, 0, 3, 60.0, (), {"mirror": MIRROR}))
    devices = devices_of(rig, sessions_of(tmp_path / "plate.h5"))
    assert devices["mirror"] == MIRROR
    assert devices["player"] == DeviceIdentity("", "virtual", "P-3")
    assert set(devices) == {"mirror", "recorder", "player"}  # a sensitivity that was typed in is no device
