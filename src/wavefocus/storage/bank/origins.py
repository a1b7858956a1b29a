"""Banks that rows of a bank were taken over from."""

import json
from dataclasses import dataclass

from wavefocus.storage.bank.reading import Bank
from wavefocus.storage.errors import InputError


@dataclass(frozen=True, slots=True)
class Origin:
    """Which bank rows were taken over from, as the bank's attribute `origins` states it.

    bank: File name of the bank.
    plan_sha256: Its plan.
    software: Program and version that made it.
    rows: Rows of the new bank, as ``"0-371"``.
    """

    bank: str
    plan_sha256: str
    software: str
    rows: str


def origins_of(bank: Bank) -> tuple[Origin, ...]:
    """Where the rows of a bank come from that it did not measure itself; empty where it has none."""
    try:
        held = json.loads(bank.origins or "[]")
        return tuple(Origin(**{key: str(origin[key]) for key in Origin.__slots__}) for origin in held)
    except (ValueError, TypeError, KeyError, RecursionError):
        raise InputError(f"{bank.path}: attribute origins is not as this program writes it") from None
