"""Units of drives and responses, as texts."""

from __future__ import annotations

from wavefocus.storage.errors import InputError

PLAYED_UNITS = ("V", "1")
"""Units of drives that are played as volts; 1 is that of a bank without a unit."""
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


_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "in": 0.0254, "ft": 0.3048}
MOTIONS = {
    **{name: (0, metres) for name, metres in _LENGTHS.items()},
    **{f"{name}/s": (1, metres) for name, metres in _LENGTHS.items()},
    **{f"{name}/s^2": (2, metres) for name, metres in _LENGTHS.items()},
    "g": (2, 9.80665),
}
"""Units of motion: derivatives of a displacement (1: velocity), and their size in m, m/s or m/s^2."""
OTHER_RESPONSES = ("Pa", "mPa", "V", "mV", "A", "N", "1")
DRIVES = ("V", "mV", "A", "mA", "N", "mN", "kN", "lbf", "Pa", "1")


def split_unit(unit: str) -> tuple[str, str]:
    """Unit of the response and unit of the drive of a Green's function's unit, as ``"mm/s/V"`` or ``"g/N"``.

    Raises InputError: the text does not end with the unit of a drive, or begins with no unit of a response.
    """
    text = unit.strip().replace("²", "^2").replace("s2", "s^2").replace("µ", "u").replace("μ", "u").replace(" ", "")
    over, _, under = ("1", "", "1") if text == "1" else text.rpartition("/")
    over, under = (one[1:-1] if one.startswith("(") and one.endswith(")") else one for one in (over, under))
    over = {"m/s/s": "m/s^2", "g_n": "g"}.get(over, over)
    if under not in DRIVES or (over not in MOTIONS and over not in OTHER_RESPONSES):
        raise InputError(
            f"the unit is {unit!r}; RESPONSE/DRIVE is needed, as m/s/V: responses {', '.join(MOTIONS)},"
            f" {', '.join(OTHER_RESPONSES)}; drives {', '.join(DRIVES)}"
        )
    return over, under
