"""Units of drives and responses, as texts."""

from __future__ import annotations

_VOLTS = ("V", "volt", "volts")
_ONE = ("", "1")


def response_unit(green_unit: str, drive_unit: str = "V") -> str:
    """Unit of a response: that of the Green's functions times that of the drive.

    green_unit: Unit of g, as ``"m/s/V"``, ``"(m/s)/V"``, ``"Pa per V"`` or ``"m s-1 V-1"``. One that is not per drive
        unit is taken to be the response's own.
    drive_unit: Unit of the drive.
    """
    unit, drive = green_unit.strip(), drive_unit.strip()
    for one in _VOLTS if drive in _VOLTS else (drive,):
        if one in _ONE:
            continue
        for ending in (
            f"/{one}",
            f"/ {one}",
            f"/({one})",
            f" per {one}",
            *(f"{one}{power}" for power in ("-1", "^-1", "⁻¹")),
        ):
            if unit.endswith(ending):
                rest = unit.removesuffix(ending)
                if ending[0] == one[0] and rest and rest[-1] not in " ·*.":
                    continue  # the end of a longer word
                rest = rest.rstrip(" ·*.")
                bare = rest[1:-1] if rest.startswith("(") and rest.endswith(")") else rest
                return bare.strip() or "1"
    return unit or "1"


def quantity(number: str, unit: str) -> str:
    """A number and its unit; the number alone where the unit is 1."""
    return number if unit in _ONE else f"{number} {unit}"
