"""Units of drives and responses, as texts."""

import re
from collections.abc import Iterable
from pathlib import Path

from wavefocus.storage.errors import InputError

METRES = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "ft": 0.3048}
"""Units of places, in metres."""
LENGTH_WORDS = {
    **{
        f"{prefix}{word}": f"{short}m"
        for prefix, short in (("", ""), ("centi", "c"), ("milli", "m"), ("micro", "u"))
        for word in ("metre", "metres", "meter", "meters")
    },
    "µm": "um", "μm": "um", "inch": "in", "inches": "in", "foot": "ft", "feet": "ft",
}  # fmt: skip
"""Words for units of places; both signs of the micrometre are written, that of micro and the Greek letter."""

PLAYED_UNITS = ("V", "1")
"""Units of drives that are played as volts; 1 is that of a bank without a unit."""
_ONE = ("", "1")
_NAMES = {"volt": "V", "volts": "V", "Volt": "V", "Volts": "V", "newton": "N", "newtons": "N", "ampere": "A",
          "amperes": "A", "second": "s", "seconds": "s", "sec": "s", "S": "s", "pascal": "Pa", "millivolt": "mV",
          "millivolts": "mV", "g_n": "g", **LENGTH_WORDS}  # fmt: skip
_TIMES = ("s", "ms", "us", "min")
_FACTOR = re.compile(r"(.*?[^\d^+-])\^?([+-]?\d+)")
Factors = tuple[tuple[str, int], ...]


def response_unit(green_unit: str, drive_unit: str = "V") -> str:
    """Unit of a response: that of the Green's functions times that of the drive.

    green_unit: Unit of g, as ``"m/s/V"``, ``"(m/s)/V"``, ``"Pa per V"`` or ``"m s-1 V-1"``. One that is not per drive
        unit is taken to be the response's own.
    drive_unit: Unit of the drive.
    """
    unit, drive = green_unit.strip(), drive_unit.strip()
    factors = _factors(unit)
    if (found := (_NAMES.get(drive, drive), -1)) in factors:
        return _text(factor for factor in factors if factor != found)
    return unit or "1"


def drive_of(green_unit: str, stated: str | None = None) -> str:
    """Unit of the drive of a Green's function's unit: N of ``"m/s/N"``, mV of ``"m/s per mV"``; V where it names none.

    green_unit: Unit of g in any of the forms of `response_unit`.
    stated: Unit of the drive as it is given elsewhere; None or empty where it is not.

    Raises InputError: the two are different units.
    """
    named = _drive_of(_factors(green_unit))
    if not (stated := (stated or "").strip()):
        return _text(named, 1) if named else "V"
    drive = _NAMES.get(stated, stated)
    certain = [factor for factor in named if factor[0] not in _LENGTHS]  # um/m is a strain and no drive in metres
    if certain and _text(certain, 1) != _text(((name, -power) for name, power in _factors(drive)), 1):
        raise InputError(
            f"response_unit is {green_unit!r}, per {_text(certain, 1)}, and drive_unit is {stated!r}; both must name"
            " the same drive"
        )
    return drive


def green_unit(unit: str, drive_unit: str) -> str:
    """Unit of a Green's function as response over drive, as ``"m/s/N"``, from any form of the two texts.

    Raises InputError: as `drive_of`.
    """
    drive = drive_of(unit, drive_unit)
    over = _text(_factors(response_unit(unit, drive)))
    return "1" if (over, drive) == ("1", "1") else f"{over}/{drive}"


def quantity(number: str, unit: str) -> str:
    """A number and its unit; only the number where the unit is 1."""
    return number if unit in _ONE else f"{number} {unit}"


def limited_unit(drive_unit: str) -> tuple[str, float]:
    """Unit in which a drive is held against its limits: volts where its own is one of voltage, and its own in volts.

    A drive in another unit, as N or A, is held against the limits' numbers in that unit, with a factor of 1.
    """
    unit = "V" if drive_unit in PLAYED_UNITS else _text(_factors(drive_unit))
    return next((("V", size) for prefix, size in _PREFIXES.items() if unit == f"{prefix}V"), (unit, 1.0))


_LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "nm": 1e-9, "pm": 1e-12, "in": 0.0254, "ft": 0.3048}
MOTIONS = {
    **{f"{name}{per}": (order, m) for order, per in enumerate(("", "/s", "/s^2")) for name, m in _LENGTHS.items()},
    "g": (2, 9.80665),
}
"""Units of motion: derivatives of a displacement (1: velocity), and their size in m, m/s or m/s^2."""
_PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6}
_OTHER_RESPONSES = ("Pa", "V", "A", "N", "W", "rad", "rad/s", "1")
_DRIVES = ("V", "A", "N", "Pa", "W", "lbf", "1")


def split_unit(unit: str) -> tuple[str, str]:
    """Unit of the response and unit of the drive of a Green's function's unit, as ``"mm/s/V"`` or ``"g/N"``.

    Raises InputError: the text does not end with the unit of a drive, or begins with no unit of a response.
    """
    factors = _factors(unit)
    named = _drive_of(factors)
    over, under = _text(factor for factor in factors if factor not in named), _text(named, 1)
    if not named and (unit.strip() == "1" or unit.rstrip().endswith("/1")):
        under = "1"
    elif not named:
        under = ""
    if not _is_one_of(under, _DRIVES) or (over not in MOTIONS and not _is_one_of(over, _OTHER_RESPONSES)):
        raise InputError(
            f"the unit is {unit!r}; RESPONSE/DRIVE is needed, as m/s/V: responses {', '.join(MOTIONS)},"
            f" {', '.join(_OTHER_RESPONSES)}; drives {', '.join(_DRIVES)}, also as mV, kN, uA"
        )
    return over, under


def _is_one_of(unit: str, units: Iterable[str]) -> bool:
    return any(unit == prefix * (name not in ("1", "lbf")) + name for name in units for prefix in _PREFIXES)


def _drive_of(factors: Factors) -> Factors:
    """The factors that a unit is divided by, but for times."""
    return tuple((name, power) for name, power in factors if power < 0 and name not in _TIMES)


def _text(factors: Iterable[tuple[str, int]], sign: int = 0) -> str:
    """Factors as a text, ``"m/s^2"``; of those that are divided by, with `sign` 1, ``"V"``."""
    power_of = [(name, -power if sign else power) for name, power in factors]
    over = " ".join(name + (f"^{power}" if power > 1 else "") for name, power in power_of if power > 0) or "1"
    return over + "".join(f"/{name}" + (f"^{-power}" if power < -1 else "") for name, power in power_of if power < 0)


def _factors(unit: str) -> Factors:
    """Names and powers of the factors of a unit; those that stand above and below a line are both kept, as in V/V."""
    text = unit.strip()[:255]
    for theirs, ours in (("⁻", "^-"), ("¹", "1"), ("²", "^2"), ("^-^", "^-"), ("µ", "u"), ("μ", "u"), ("**", "^")):
        text = text.replace(theirs, ours)
    text = re.sub(r"[·⋅*]|(?<=[^\W\d])\.(?=[^\W\d])|(?<=\d)\.(?=[^\W\d])", " ", text)
    text = re.sub(r"\bper\b", "/", text)
    found: dict[tuple[str, bool], int] = {}
    signs, sign = [1], 1
    for token in re.findall(r"[()/]|[^\s()/]+", text):
        if token == "/":
            sign = -sign if sign == signs[-1] else sign
            continue
        if token == "(":
            signs.append(sign)
            continue
        if token == ")":
            if len(signs) > 1:
                signs.pop()
        else:
            match = _FACTOR.fullmatch(token)
            name, power = (match[1], int(match[2])) if match else (token, 1)
            name = _NAMES.get(name, name)
            if name != "1" and power:
                key = (name, sign * power > 0)
                found[key] = found.get(key, 0) + sign * power
        sign = signs[-1]
    return tuple((name, power) for (name, _), power in found.items())


RATES_HZ = (10.0, 1e9)
"""Rates of responses, from a seismometer's to a fast digitiser's; what lies outside is a unit that was mistaken."""


def require_meant_rate(rate_hz: float, source: str) -> None:
    """Refuse a sample rate that no instrument has. Raises InputError."""
    if not RATES_HZ[0] <= rate_hz <= RATES_HZ[1]:
        raise InputError(
            f"{source}: the sample rate is {rate_hz:.6g} Hz; {RATES_HZ[0]:g} to {RATES_HZ[1]:g} Hz are allowed:"
            " times are in s and frequencies in Hz"
        )


def require_unit(path: Path, name: str, stated: str) -> None:
    """Refuse units that are not those of an array's name: ``time_s`` in ms, ``position_mm`` in m."""
    wanted = name.rsplit("_", 1)[-1]
    words: dict[str, tuple[str, ...]] = {"s": ("s", "sec", "second", "seconds"), "hz": ("hz", "hertz", "1/s", "s-1")}
    words |= {unit: (unit, *(word for word, one in LENGTH_WORDS.items() if one == unit)) for unit in METRES}
    if stated and wanted in words and stated.strip().lower() not in words[wanted]:
        raise InputError(
            f"{path}: {name} states the units {stated[:40]!r}; its name says {wanted}: convert the values, or correct"
            " the attribute"
        )
