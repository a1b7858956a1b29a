"""Tables of a rig file whose keys depend on the driver, which states its own: see `wavefocus.drivers.registry`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from types import UnionType
from typing import (
    TYPE_CHECKING,
    Annotated,
    Any,
    ClassVar,
    Literal,
    TypeVar,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

from pydantic import Field, create_model, model_validator

from wavefocus.config.fields import ALWAYS, FREE, Finite, Table, Text, Whole, like, mistake, plan_mark
from wavefocus.config.loading import shown
from wavefocus.drivers.registry import KeyMistakeError, Registry

Section = TypeVar("Section", bound="DriverTable")


class DriverTable(Table):
    """A table with a key ``driver``, keys of every driver, and keys of single ones, which are None elsewhere.

    Attributes
    ----------
    drivers : mapping from name to data class
        The drivers that have keys.
    shared_keys : mapping from key to str
        Keys that each of these has; what is missing, if it is needed, else empty. A driver is without those that it
        names in an attribute ``without_keys``.
    left_out : mapping from name to str
        Drivers of other distributions that cannot be used, and why.
    """

    drivers: ClassVar[Mapping[str, type[Any]]] = {}
    shared_keys: ClassVar[Mapping[str, str]] = {}
    left_out: ClassVar[Mapping[str, str]] = {}

    driver: Annotated[str, ALWAYS] = "virtual"

    if TYPE_CHECKING:

        def __getattr__(self, key: str) -> Any: ...

    def make_driver(self) -> Any:
        """The driver, with its keys. Raises KeyMistakeError where they do not go together."""
        driver = self.drivers[self.driver]
        values = {key.name: getattr(self, key.name) for key in fields(driver)}
        return driver(**{key: value for key, value in values.items() if value is not None})

    def _unused_in_plan(self) -> frozenset[str]:
        """Keys of other drivers."""
        own = {key.name for key in fields(self.drivers[self.driver])} if self.driver in self.drivers else set()
        return frozenset(key.name for driver in self.drivers.values() for key in fields(driver)) - own

    def _plan_default(self, key: str) -> object:
        """The driver's own default of its key."""
        driver = self.drivers.get(self.driver)
        own = {key.name: key.default for key in fields(driver)} if driver is not None else {}
        return own[key] if own.get(key, MISSING) is not MISSING else super()._plan_default(key)

    @model_validator(mode="before")
    @classmethod
    def _driver_defaults(cls, data: Any) -> Any:
        """Fill in the driver's own defaults, so that the validated table says everything outright."""
        default = cls.model_fields["driver"].default
        name = data.get("driver", default) if isinstance(data, dict) else None
        if not isinstance(name, str) or name not in cls.drivers:
            if isinstance(name, str) and name in cls.left_out and name != default:
                raise mistake("driver", name, f"cannot be used: {cls.left_out[name]}")
            return data
        driver = cls.drivers[name]
        own = {key.name: key.default for key in fields(driver) if key.default not in (MISSING, None)}
        own |= getattr(driver, "table_defaults", {})
        given = {key: value for key, value in data.items() if value is not None or key not in own}
        return {**own, **given}

    @model_validator(mode="after")
    def _driver_keys(self: Section) -> Section:
        """Refuse keys that belong to another driver, and miss those that this one cannot do without."""
        owners = {
            key: [name for name, driver in self.drivers.items() if key not in getattr(driver, "without_keys", ())]
            for key in self.shared_keys
        }
        needed = {(name, key): text for key, text in self.shared_keys.items() if text for name in owners[key]}
        for name, driver in self.drivers.items():
            for field in fields(driver):
                owners.setdefault(field.name, []).append(name)
                if field.default is MISSING:
                    needed[name, field.name] = field.metadata["description"]
        for key, names in owners.items():
            value = getattr(self, key)
            if value is not None and self.driver not in names:
                belongs = _either([shown(name) for name in names])
                raise mistake(key, value, f"belongs to driver {belongs}; the driver here is {shown(self.driver)}")
            if value is None and (self.driver, key) in needed:
                wanted = needed[self.driver, key]
                raise mistake(key, None, f"is missing; driver {shown(self.driver)} needs {wanted}")
        if self.driver in self.drivers:
            try:
                self.make_driver()
            except KeyMistakeError as wrong:
                raise mistake(wrong.key, wrong.value, wrong.allowed) from None
            except Exception as failure:  # of another distribution's driver
                raise mistake("driver", self.driver, f"cannot be used: {_words(failure)}") from failure
        return self


def with_drivers(section: type[Section], registry: Registry[Any]) -> type[Section]:
    """The table with the keys of all its drivers; two drivers with a key of one name mean the same by it.

    Another distribution's driver with a key of the table's own, or with keys that are none, is left out.
    """
    default = section.model_fields["driver"].default
    for name, driver in list(registry.all().items()):
        taken = [key.name for key in fields(driver) if key.name in section.model_fields]
        if taken:
            registry.leave_out(name, f"has a key that the table has: {', '.join(taken)}")
        elif name == default:
            registry.leave_out(name, f"has the name of a driver that is there already: {name}")
        elif name in registry.sources:
            try:
                create_model("Keys", **_keys(driver))
            except Exception as failure:
                registry.leave_out(name, f"has keys that cannot be read: {_words(failure)}")
    drivers = registry.all()
    mark = plan_mark(section.model_fields["driver"])
    keys: dict[str, Any] = {"driver": (Annotated[Literal[(default, *drivers)], mark], default)}
    for driver in drivers.values():
        keys |= _keys(driver)
    module = section.__module__
    made = create_model(section.__name__, __base__=section, __doc__=section.__doc__, __module__=module, **keys)
    made.drivers = drivers
    made.left_out = registry.failures
    return made


def _keys(driver: type[Any]) -> dict[str, Any]:
    """The keys of a driver as `create_model` takes them."""
    hints, keys = get_type_hints(driver), {}
    for key in fields(driver):
        about = key.metadata
        described = Field(default=None, description=about["description"])
        checked: Any = Union[_checked(hints[key.name], about), None]  # noqa: UP007
        mark = {"free": FREE, "always": ALWAYS}.get(about["in_plan"])
        keys[key.name] = (Annotated[checked, mark] if mark else checked, described)
    return keys


def _words(failure: Exception) -> str:
    return f"{type(failure).__name__}: {failure}".partition("\n")[0]


def _checked(hint: Any, about: Mapping[str, Any]) -> Any:
    """A type as strict as those of every table, within the bounds of a key."""
    parts = tuple(part if part is Ellipsis else _checked(part, about) for part in get_args(hint))
    if get_origin(hint) in (Union, UnionType):
        return Union[parts]  # noqa: UP007  # made here
    if get_origin(hint) is tuple:
        return tuple[parts]  # type: ignore[valid-type]  # made here
    if hint is str and about["pattern"] is not None:
        return Annotated[Text, like(*about["pattern"])]
    strict = {float: Finite, int: Whole, str: Text}.get(hint, hint)
    return Annotated[strict, Field(**about["bounds"])] if about["bounds"] else strict


def _either(names: Sequence[str]) -> str:
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} or {names[-1]}"
