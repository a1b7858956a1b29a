"""Stored numbers that stand for values, as netCDF and its conventions pack them, and values that are missing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError

DEFAULT_FILL: Mapping[str, Any] = {
    "f4": np.float32(2.0**123 * 0.9375), "f8": np.float64(2.0**123 * 0.9375), "i2": -32767, "i4": -2147483647,
    "i8": -9223372036854775806, "u2": 65535, "u4": 4294967295, "u8": 18446744073709551614,
}  # fmt: skip
"""What netCDF's library writes where nothing was written (netcdf.h, NC_FILL_...), by type; bytes have none."""
KEYS = ("scale_factor", "add_offset", "_FillValue", "missing_value")
"""Attributes of a variable that say how it is packed."""
UNREAD = ("valid_range", "valid_min", "valid_max", "_Unsigned")
"""Those that are refused."""


@dataclass(frozen=True, slots=True)
class Packing:
    """How stored numbers stand for values: ``value = stored * scale + offset``; NaN for those that are `absent`."""

    scale: float = 1.0
    offset: float = 0.0
    absent: tuple[Any, ...] = ()

    @property
    def is_scaled(self) -> bool:
        """Whether stored numbers are other than the values."""
        return (self.scale, self.offset) != (1.0, 0.0)

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
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.array(stored, self.dtype_of(stored.dtype))
            if self.is_scaled:
                values = values * self.scale + self.offset
            for number in self.absent:
                # An attribute of fewer digits means the same number: 1e20 in float32 is 1.00000002e20.
                is_float = stored.dtype.kind == "f"
                values[np.isclose(stored, number, rtol=1e-6, atol=0.0) if is_float else stored == number] = np.nan
        return values


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
    """How a variable is packed (CF conventions 1.11, sections 2.5 and 8.1; NetCDF User's Guide, appendix A).

    attributes: The variable's, as numbers, arrays and texts.
    dtype: Type of the stored numbers.
    what: Name of the variable, for messages.
    default_fill: What stands where nothing was written, unless ``_FillValue`` says it.

    Raises InputError: an attribute is one of `UNREAD`, or not a finite number (``_FillValue`` and ``missing_value`` may
    be NaN).
    """
    if unread := next((key for key in UNREAD if key in attributes), None):
        raise InputError(
            f"{what} has the attribute {unread}, which is not read; write its values unpacked, NaN if missing"
        )
    found = {key: _numbers(key, attributes[key], what) for key in KEYS if key in attributes}
    scale, offset = float(found.get("scale_factor", [1.0])[0]), float(found.get("add_offset", [0.0])[0])
    fills = list(found.get("_FillValue", [] if default_fill is None else [default_fill]))
    absent = [number for number in [*fills, *found.get("missing_value", [])] if not np.isnan(number)]
    if dtype.kind == "f":
        with np.errstate(over="ignore"):
            absent = list(np.asarray(absent).astype(dtype))
    return Packing(scale, offset, tuple(absent))


def _numbers(key: str, value: Any, what: str) -> NDArray[Any]:
    found = np.asarray(value).reshape(-1)
    may_be_nan = key in ("_FillValue", "missing_value")
    is_few = 1 <= found.size <= (1000 if key == "missing_value" else 1)
    if found.dtype.kind not in "fiu" or not is_few or not (may_be_nan or np.isfinite(found).all()):
        raise InputError(f"{what} has the {key} {np.asarray(value).tolist()!r}; a finite number is needed")
    return found
