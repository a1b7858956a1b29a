"""Stored numbers that stand for values, as netCDF and its conventions pack them, and values that are missing."""

import operator
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError

DEFAULT_FILL: Mapping[str, Any] = {
    "f4": np.float32(2.0**123 * 0.9375), "f8": np.float64(2.0**123 * 0.9375), "i2": -32767, "i4": -2147483647,
    "i8": -9223372036854775806, "u2": 65535, "u4": 4294967295, "u8": 18446744073709551614,
}  # fmt: skip
"""What netCDF's library writes where nothing was written (netcdf.h, NC_FILL_...), by type; bytes have none."""
KEYS = (
    "scale_factor", "add_offset", "_FillValue", "missing_value", "valid_range", "valid_min", "valid_max", "_Unsigned",
)  # fmt: skip
"""Attributes of a variable that say how it is packed."""
_COMPARED = {"==": operator.eq, "~": lambda values, number: np.isclose(values, number, rtol=1e-6, atol=0.0),
             "<": operator.lt, ">": operator.gt}  # fmt: skip


@dataclass(frozen=True, slots=True)
class Packing:
    """How stored numbers stand for values: ``value = stored * scale + offset``.

    sign: ``"u"`` or ``"i"`` where stored integers count without or with a sign against their type, else empty.
    absent: Comparison, number and whether stored numbers are compared, or else values; what matches is missing.
    """

    scale: float = 1.0
    offset: float = 0.0
    sign: Literal["", "u", "i"] = ""
    absent: tuple[tuple[str, Any, bool], ...] = ()

    @property
    def is_scaled(self) -> bool:
        """Whether stored numbers are other than the values."""
        return (self.scale, self.offset, self.sign) != (1.0, 0.0, "")

    @property
    def is_plain(self) -> bool:
        """Whether stored numbers are the values, and none is missing."""
        return not self.is_scaled and not self.absent

    def dtype_of(self, stored: np.dtype[Any]) -> np.dtype[np.floating[Any]]:
        """Type of the values: float32 where stored numbers are, and are not scaled; else float64."""
        single = stored.kind == "f" and stored.itemsize <= 4 and not self.is_scaled
        return np.dtype(np.float32 if single else np.float64)

    def unpack(self, stored: NDArray[Any]) -> NDArray[np.floating[Any]]:
        """Values of stored numbers; NaN where they are missing."""
        stored = self._signed(stored)
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.array(stored, self.dtype_of(stored.dtype))
            if self.is_scaled:
                values = values * self.scale + self.offset
            for comparison, number, of_stored in self.absent:
                values[_COMPARED[comparison](stored if of_stored else values, number)] = np.nan
        return values

    def _signed(self, stored: NDArray[Any]) -> NDArray[Any]:
        if not self.sign:
            return stored
        return np.ascontiguousarray(stored, stored.dtype.newbyteorder("=")).view(f"{self.sign}{stored.dtype.itemsize}")


@dataclass(frozen=True, slots=True, eq=False)
class UnpackedArray:
    """An array or dataset of stored numbers that gives values where it is indexed."""

    stored: Any
    packing: Packing

    @property
    def dtype(self) -> np.dtype[np.floating[Any]]:
        """Type of the values."""
        return self.packing.dtype_of(self.stored.dtype)

    @property
    def shape(self) -> tuple[int, ...]:
        """Shape of the array."""
        return tuple(self.stored.shape)

    @property
    def ndim(self) -> int:
        """Number of axes."""
        return len(self.shape)

    @property
    def size(self) -> int:
        """Number of values."""
        return int(np.prod(self.shape, dtype=np.int64))

    @property
    def chunks(self) -> tuple[int, ...] | None:
        """Shape of the pieces that are read at once, where there are any."""
        return getattr(self.stored, "chunks", None)

    def __len__(self) -> int:
        return self.shape[0]

    def __getitem__(self, key: Any) -> NDArray[np.floating[Any]]:
        return self.packing.unpack(np.asarray(self.stored[key]))


def packing(attributes: Mapping[str, Any], dtype: np.dtype[Any], what: str, default_fill: Any = None) -> Packing:
    """How a variable is packed.

    CF conventions 1.11, sections 2.5 and 8.1; NetCDF User's Guide, appendix A: ``missing_value`` and ``valid_range`` in
    the type of the stored numbers are compared with those, in another type with the values.

    attributes: The variable's, as numbers, arrays and texts.
    dtype: Type of the stored numbers.
    what: Name of the variable, for messages.
    default_fill: What stands where nothing was written, unless ``_FillValue`` says it.

    Raises InputError: an attribute is not a finite number (``_FillValue`` and ``missing_value`` may be NaN).
    """
    found = {key: _numbers(key, attributes[key], what) for key in KEYS[:-1] if key in attributes}
    sign: Literal["", "u", "i"] = ""
    if dtype.kind in "iu" and "_Unsigned" in attributes:
        word = attributes["_Unsigned"]
        word = str(word.decode("latin-1") if isinstance(word, bytes) else word).strip("\0 ").lower()
        wanted: Literal["u", "i"] = "u" if word == "true" else "i"
        sign = "" if wanted == dtype.kind else wanted
    counted = np.dtype(f"{sign or dtype.kind}{dtype.itemsize}")
    scale, offset = float(found.get("scale_factor", [1.0])[0]), float(found.get("add_offset", [0.0])[0])
    absent: list[tuple[str, Any, bool]] = []

    def numbers(key: str) -> tuple[list[Any], bool]:
        """Numbers of an attribute, and whether they are stored ones."""
        given = found.get(key, np.empty(0))
        if counted.kind == "f":
            with np.errstate(over="ignore"):
                return list(given.astype(counted)), True
        of_stored = given.dtype.kind in "iu"
        return list(given.astype(dtype.newbyteorder("=")).view(counted) if of_stored and sign else given), of_stored

    fills, _ = numbers("_FillValue")
    if not fills and default_fill is not None:
        fills = [default_fill]
    # An attribute of fewer digits than the stored numbers means the same number: 1e20 in float32 is 1.00000002e20.
    alike: Literal["==", "~"] = "~" if counted.kind == "f" else "=="
    absent += [(alike, number, True) for number in fills if not np.isnan(number)]
    missing, of_stored = numbers("missing_value")
    absent += [(alike if of_stored else "~", number, of_stored) for number in missing if not np.isnan(number)]
    for key, at, comparison in (
        ("valid_range", 0, "<"),
        ("valid_range", 1, ">"),
        ("valid_min", 0, "<"),
        ("valid_max", 0, ">"),
    ):
        given, of_stored = numbers(key)
        if given:
            absent.append((comparison, given[at], of_stored))
    return Packing(scale, offset, sign, tuple(absent))


def _numbers(key: str, value: Any, what: str) -> NDArray[Any]:
    found = np.asarray(value).reshape(-1)
    counts = {"valid_range": (2,), "missing_value": range(1, 1001)}.get(key, (1,))
    may_be_nan = key in ("_FillValue", "missing_value")
    if found.dtype.kind not in "fiu" or found.size not in counts or not (may_be_nan or np.isfinite(found).all()):
        raise InputError(f"{what} has the {key} {np.asarray(value).tolist()!r}; a finite number is needed")
    return found
