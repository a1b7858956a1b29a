"""What the window can do about a finding: a word for the button, and which deed it is."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

# What the doctor calls a deed, and what stands on its button; {on} is what it concerns.
_WORDS = {
    "calibrate": "Calibrate {on}…",
    "edit-rig": "Open the rig file",
    "open-folder": "Open the folder",
    "reset-usb": "Reset its USB…",
    "run": "Copy the command",
    "test-message": "Send a test",
}


@dataclass(frozen=True, slots=True)
class Finding:
    """One row of the doctor's table.

    Parameters
    ----------
    instrument, check, verdict, what, remedy : str
        As the doctor told them.
    do, on : str
        The deed that a program can do, and what it concerns; empty where there is none.
    """

    instrument: str
    check: str
    verdict: str
    what: str
    remedy: str
    do: str
    on: str

    @classmethod
    def told(cls, told: Mapping[str, object]) -> Finding:
        """From the doctor's JSON."""
        instrument, check, verdict, what, remedy = (
            str(told.get(key) or "") for key in ("instrument", "check", "verdict", "what", "remedy")
        )
        act = told.get("act")
        do, on = (str(act.get("do") or ""), str(act.get("on") or "")) if isinstance(act, dict) else ("", "")
        known = do if do in _WORDS else ""  # a deed of a later doctor is a remedy in words here
        return cls(instrument, check, verdict, what, remedy, known, on)

    @property
    def bad(self) -> bool:
        """Whether something is to be done about it."""
        return self.verdict in ("fail", "warn")

    @property
    def deed(self) -> tuple[str, str] | None:
        """Deed and word of its button; None where nothing is to be done."""
        if self.do:
            return self.do, _WORDS[self.do].format(on=self.on).replace(" …", "…")
        return ("again", "Check again") if self.bad else None
