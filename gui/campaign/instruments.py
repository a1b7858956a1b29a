"""The instruments of a session and what was last heard of each."""

from __future__ import annotations

from dataclasses import dataclass

from gui.campaign.event_words import Record, instant_s, line_of

ROLES = ("mirror", "recorder", "player")


@dataclass(slots=True)
class Instrument:
    """One instrument.

    Parameters
    ----------
    name : str
        As the session introduced it.
    state : str
        ``"in use"``, ``"at rest"`` (the session is over), ``"faulty"`` or ``"away"``.
    message : str
        The last that was told of it.
    at_s : float
        When, in seconds since 1970; NaN when nothing was told.
    """

    name: str
    state: str = "in use"
    message: str = ""
    at_s: float = float("nan")


class Instruments:
    """Gathers from events how the instruments are."""

    def __init__(self) -> None:
        self.all: list[Instrument] = []

    def take(self, record: Record) -> bool:
        """Take up one event; tells whether anything changed."""
        match record:
            case {"event": "session_started", "instruments": list(names)}:
                self.all = [Instrument(str(name)) for name in names]
            case {"event": "fault", "instrument": str(name)}:
                self._note(name, "faulty", record)
            case {"event": "reconnect_tried", "instrument": str(name), "connected": connected}:
                self._note(name, "in use" if connected else "away", record, str(record.get("role", "")))
            case {"event": "position_committed"}:
                return self._all_become("in use", {"at rest", "faulty", "away"})
            case {"event": "state_changed", "state": "finished" | "stopped" | "failed"}:
                return self._all_become("at rest", {"in use"})
            case _:
                return False
        return True

    def _note(self, name: str, state: str, record: Record, role: str = "") -> None:
        line = line_of(record)
        instrument = self._named(name, role)
        instrument.state, instrument.at_s = state, instant_s(record)
        instrument.message = line.text.removeprefix(f"{name}: ") if line else ""

    def _named(self, name: str, role: str) -> Instrument:
        """The instrument that a message names, by its name or by its role."""
        for wanted in filter(None, (name, role or next((role for role in ROLES if role in name), ""))):
            for instrument in self.all:
                if wanted in instrument.name or instrument.name in wanted:
                    return instrument
        instrument = Instrument(name)
        self.all.append(instrument)
        return instrument

    def _all_become(self, state: str, former: set[str]) -> bool:
        """A position that is in has been through all instruments; a session that is over has put them to rest."""
        concerned = [instrument for instrument in self.all if instrument.state in former]
        for instrument in concerned:
            instrument.state = state
        return bool(concerned)
