"""Stored numbers that stand for values, as netCDF and its conventions pack them, and values that are missing."""

import operator
from collections.abc import Callable, Mapping
from typing import Any

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


def _alike(values: Any, number: Any) -> Any:
    """Attributes of fewer digits than the numbers mean the same number: 1e20 in float32 is 1.00000002e20."""
    return np.isclose(values, number, rtol=1e-6, atol=0.0)


class Packing:
    """How stored numbers of a variable stand for values: ``value = stored * scale_factor + add_offset``.

    CF conventions 1.11, sections 2.5 and 8.1; NetCDF User's Guide, appendix A: ``missing_value`` and ``valid_range`` in
    the type of the stored numbers are compared with those, in another type with the values.

    attributes: The variable's, as numbers, arrays and texts.
    stored: Type of the stored numbers.
    what: Name of the variable, for messages.
    default_fill: What stands where nothing was written, unless ``_FillValue`` says it.

    dtype: Type of the values: float32 where stored numbers are, and are not scaled; else float64.
    is_scaled: Whether stored numbers are other than the values.
    has_fill: Whether numbers are named that stand for missing values.
    is_plain: Whether stored numbers are the values, and none is missing.

    Raises InputError: an attribute is not a finite number (``_FillValue`` and ``missing_value`` may be NaN).
    """

    def __init__(
        self, attributes: Mapping[str, Any], stored: np.dtype[Any], what: str, default_fill: Any = None
    ) -> None:
        given = {key: _numbers(key, attributes[key], what) for key in KEYS[:-1] if key in attributes}
        kind = stored.kind
        if kind in "iu" and (word := attributes.get("_Unsigned")) is not None:
            text = word.decode("latin-1") if isinstance(word, bytes) else str(word)
            kind = "u" if text.strip("\0 ").lower() == "true" else "i"
        self._counted, native = np.dtype(f"{kind}{stored.itemsize}"), stored.newbyteorder("=")
        self._scale, self._offset = (
            float(given[key][0]) if key in given else default
            for key, default in (("scale_factor", 1.0), ("add_offset", 0.0))
        )
        self.is_scaled = (self._scale, self._offset, kind) != (1.0, 0.0, stored.kind)
        self.dtype = np.dtype(np.float32 if kind == "f" and stored.itemsize <= 4 and not self.is_scaled else np.float64)

        def numbers(key: str) -> tuple[list[Any], bool]:
            """Numbers of an attribute, and whether they are stored ones."""
            found = given.get(key, np.empty(0))
            if kind == "f":
                with np.errstate(over="ignore"):
                    return list(found.astype(self._counted)), True
            counts = found.dtype.kind in "iu"
            return list(found.astype(native).view(self._counted) if counts and kind != stored.kind else found), counts

        same = _alike if kind == "f" else operator.eq
        fills = numbers("_FillValue")[0] or ([] if default_fill is None else [default_fill])
        missing, of_stored = numbers("missing_value")
        absent: list[tuple[Callable[[Any, Any], Any], Any, bool]] = [(same, number, True) for number in fills]
        absent += [(same if of_stored else _alike, number, of_stored) for number in missing]
        absent = [entry for entry in absent if not np.isnan(entry[1])]
        self.has_fill = bool(absent)
        for keys, at, outside in (
            ("valid_min valid_range", 0, operator.lt),
            ("valid_max valid_range", -1, operator.gt),
        ):
            for limits, of_stored in map(numbers, keys.split()):
                absent += [(outside, limits[at], of_stored)] if limits else []
        self._absent = absent
        self.is_plain = not self.is_scaled and not absent

    def unpack(self, stored: NDArray[Any]) -> NDArray[np.floating[Any]]:
        """Values of stored numbers; NaN where they are missing."""
        if self._counted.kind != stored.dtype.kind:
            stored = np.ascontiguousarray(stored, stored.dtype.newbyteorder("=")).view(self._counted)
        with np.errstate(over="ignore", invalid="ignore"):
            values = np.array(stored, self.dtype)
            if self.is_scaled:
                values = values * self._scale + self._offset
            for matches, number, of_stored in self._absent:
                values[matches(stored if of_stored else values, number)] = np.nan
        return values


class UnpackedArray:
    """An array or dataset of stored numbers that gives values where it is indexed."""

    def __init__(self, stored: Any, packing: Packing) -> None:
        self._stored, self._packing = stored, packing
        self.dtype, self.shape, self.ndim, self.size = packing.dtype, tuple(stored.shape), stored.ndim, stored.size
        self.chunks: tuple[int, ...] | None = getattr(stored, "chunks", None)

    def __len__(self) -> int:
        return len(self._stored)

    def __getitem__(self, key: Any) -> NDArray[np.floating[Any]]:
        return self._packing.unpack(np.asarray(self._stored[key]))


def _numbers(key: str, value: Any, what: str) -> NDArray[Any]:
    found = np.asarray(value).reshape(-1)
    counts = {"valid_range": (2,), "missing_value": range(1, 1001)}.get(key, (1,))
    may_be_nan = key in ("_FillValue", "missing_value")
    if found.dtype.kind not in "fiu" or found.size not in counts or not (may_be_nan or np.isfinite(found).all()):
        raise InputError(f"{what} has the {key} {np.asarray(value).tolist()!r}; a finite number is needed")
    return found
