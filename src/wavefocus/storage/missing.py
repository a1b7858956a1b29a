"""Numbers that stand for missing values, as netCDF and its conventions name them; packed numbers are refused."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError

DEFAULT_FILL: Mapping[str, Any] = {
    "f4": np.float32(2.0**123 * 0.9375), "f8": np.float64(2.0**123 * 0.9375), "i2": -32767, "i4": -2147483647,
    "i8": -9223372036854775806, "u2": 65535, "u4": 4294967295, "u8": 18446744073709551614,
}  # fmt: skip
"""What netCDF's library writes where nothing was written (netcdf.h, NC_FILL_...), by type; bytes have none."""
_FILLS = ("_FillValue", "missing_value")
LIMITS = ("valid_range", "valid_min", "valid_max")
_PACKED: Mapping[str, tuple[Any, ...]] = {"scale_factor": (1,), "add_offset": (0,), "_Unsigned": ("false", b"false")}
"""Attributes of packed numbers, and their values that change nothing."""
KEYS = (*_FILLS, *LIMITS, *_PACKED)
"""Attributes of a variable that say which values its stored numbers stand for (CF conventions 1.11, 2.5 and 8.1)."""


def missing_numbers(attributes: Mapping[str, Any], what: str, default_fill: Any = None) -> tuple[Any, ...]:
    """Stored numbers of a variable that stand for missing values.

    attributes: The variable's, of `KEYS`.
    what: Name of the variable, for messages.
    default_fill: What stands where nothing was written, unless ``_FillValue`` says it.

    Raises InputError: other stored numbers are not the values, or an attribute is no number.
    """
    for key in LIMITS:
        if key in attributes:
            raise InputError(
                f"{what} has a {key}; set the stored numbers outside of it to its _FillValue, and delete the attribute"
            )
    for key, harmless in _PACKED.items():
        if key in attributes and np.asarray(attributes[key]).reshape(-1).tolist() not in [[one] for one in harmless]:
            raise InputError(
                f"{what} is packed ({key}); save it unpacked, in Python: ds = xarray.load_dataset(FILE), then "
                "v.encoding = {} for each v in ds.variables.values(), then ds.to_netcdf(NEW)"
            )
    missing = [] if default_fill is None or "_FillValue" in attributes else [default_fill]
    for key in _FILLS:
        found = np.asarray(attributes.get(key, ())).reshape(-1)
        if found.dtype.kind not in "fiu" or found.size > 1000:
            raise InputError(f"{what} has the {key} {found[:4].tolist()!r}; a number is needed")
        missing += found[~np.isnan(found)].tolist()
    return tuple(missing)


def missing_as_nan(stored: NDArray[Any], missing: tuple[Any, ...]) -> NDArray[np.floating[Any]]:
    """Native floats of stored numbers, single precision where those are; NaN where they are missing."""
    with np.errstate(over="ignore"):  # a long double beyond float64 becomes an infinity and is refused as such
        values = np.array(stored, _float_type(stored.dtype))
    # Attributes of fewer digits than the numbers mean the same number: 1e20 in float32 is 1.00000002e20.
    tolerance = 1e-6 if stored.dtype.kind == "f" else 0.0
    for number in missing:
        values[np.isclose(values, number, rtol=tolerance, atol=0.0)] = np.nan
    return values


class WithMissing:
    """An array or dataset that gives floats where it is indexed, NaN where its numbers are missing."""

    def __init__(self, stored: Any, missing: tuple[Any, ...]) -> None:
        self._stored, self._missing = stored, missing
        self.dtype, self.shape, self.size = _float_type(stored.dtype), tuple(stored.shape), stored.size
        self.ndim = stored.ndim
        self.chunks: tuple[int, ...] | None = getattr(stored, "chunks", None)

    def __len__(self) -> int:
        return len(self._stored)

    def __getitem__(self, key: Any) -> NDArray[np.floating[Any]]:
        return missing_as_nan(np.asarray(self._stored[key]), self._missing)


def _float_type(stored: np.dtype[Any]) -> np.dtype[Any]:
    return np.dtype(np.float32 if stored.kind == "f" and stored.itemsize <= 4 else np.float64)
