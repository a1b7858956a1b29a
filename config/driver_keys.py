"""Keys of the rig file that only some drivers know, and the defaults that they have there."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Protocol

from config.fields import mistake
from config.mistakes import shown


class _Driven(Protocol):
    @property
    def driver(self) -> str: ...


def with_driver_defaults(data: Any, default_driver: str, defaults: Mapping[str, Mapping[str, object]]) -> Any:
    """Fill in a driver's own defaults, so that the validated table says everything outright.

    Parameters
    ----------
    data : mapping or anything
        The table before validation; what is no table is passed on, to be refused by the model.
    default_driver : str
        The driver of a table that names none.
    defaults : mapping from driver to mapping from key to value
        What each driver's keys are where they are left out.
    """
    if not isinstance(data, dict):
        return data
    driver = data.get("driver", default_driver)
    own = defaults.get(driver, {}) if isinstance(driver, str) else {}
    given = {key: value for key, value in data.items() if value is not None or key not in own}
    return {**own, **given}


def check_driver_keys(section: _Driven, drivers_of: Mapping[str, Sequence[str]], needed: Mapping[str, str]) -> None:
    """Refuse keys that belong to another driver, and miss those that this one cannot do without.

    Parameters
    ----------
    section : table with a driver
        After validation; keys that were left out are None.
    drivers_of : mapping from key to drivers
        Which drivers know it.
    needed : mapping from key to str
        Keys that every driver that knows them needs, and what they hold, for the message.

    Raises
    ------
    PydanticCustomError
        A mistake that names the key.
    """
    for key, drivers in drivers_of.items():
        value = getattr(section, key)
        if value is not None and section.driver not in drivers:
            names = _either([shown(driver) for driver in drivers])
            raise mistake(key, value, f"belongs to driver {names}; the driver here is {shown(section.driver)}")
        if value is None and section.driver in drivers and key in needed:
            raise mistake(key, None, f"is missing; driver {shown(section.driver)} needs {needed[key]}")


def _either(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
