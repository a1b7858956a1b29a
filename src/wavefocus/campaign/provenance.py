"""How a bank came to be, by the log of its campaign: sessions, and the instruments they were measured with."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path

from wavefocus.campaign.sidecar_files import log_path
from wavefocus.config.messages.campaign import (
    Drift,
    Event,
    Fault,
    PositionCommitted,
    PositionRepeated,
    SessionEnded,
    SessionStarted,
    read_event,
)
from wavefocus.config.rig import RigConfig
from wavefocus.drivers.protocols import DeviceIdentity


@dataclass(slots=True)
class SessionRecord:
    """A session of a campaign: when, with which devices by role, how it ended, and how often what happened."""

    started: datetime
    ended: datetime
    devices: dict[str, DeviceIdentity]
    outcome: str = "no end is logged"
    done: int = 0
    total: int = 0
    counts: Counter[str] = field(default_factory=Counter)

    def note(self, at: datetime, event: Event) -> None:
        """Count one of its events."""
        self.ended = at
        match event:
            case PositionCommitted():
                self.counts["positions measured"] += 1
            case PositionRepeated():
                self.counts["repeated attempts"] += 1
            case Fault():
                self.counts["faults of instruments"] += 1
            case Drift():
                self.counts["comparisons with the sentinel position"] += 1
                self.counts["of them not steady"] += event.verdict != "steady"
            case SessionEnded():
                self.outcome, self.done, self.total = str(event.state), event.done, event.total

    @property
    def summary(self) -> str:
        """One line for people."""
        bank = [f"{self.done} of {self.total} positions in the bank"] if self.total else []
        return "; ".join([self.outcome, *bank, *(f"{what}: {count}" for what, count in self.counts.items() if count)])


def sessions_of(bank: Path) -> list[SessionRecord]:
    """The sessions in the log next to a bank, oldest first; none where there is no log. Torn lines are passed over."""
    sessions: list[SessionRecord] = []
    if not log_path(bank).is_file():
        return sessions
    with log_path(bank).open("rb") as log:
        for line in log:
            if (logged := read_event(line)) is None:
                continue
            if isinstance(logged.event, SessionStarted):
                sessions.append(SessionRecord(logged.at, logged.at, dict(logged.event.devices)))
            elif sessions:
                sessions[-1].note(logged.at, logged.event)
    return sessions


def devices_of(rig: RigConfig, sessions: list[SessionRecord]) -> dict[str, DeviceIdentity]:
    """Who the instruments are, by role: as they said in the sessions, in the calibration, or by the rig's drivers.

    A serial number that no device states comes from the rig's list of USB devices. Addresses and ports stay out.
    """
    devices = {
        role: DeviceIdentity("", getattr(rig, role).driver) for role in ("mirror", "recorder", "player", "vibrometer")
    }
    if rig.vibrometer.driver == "fixed":  # a sensitivity that somebody typed in, and no device
        del devices["vibrometer"]
    if (measured := rig.calibration.measured) is not None:
        parts = {"mirror": measured.mirror, "recorder": measured.inputs, "player": measured.outputs}
        devices |= {role: part.identity for role, part in parts.items() if part and part.identity}
    for session in sessions:
        devices |= session.devices
    for device in rig.usb:
        if device.serial_number and device.role in devices and not devices[device.role].serial:
            known = devices[device.role]
            devices[device.role] = DeviceIdentity(known.maker, known.product, device.serial_number)
    return devices
