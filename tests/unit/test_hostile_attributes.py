"""Attributes and datasets of every kind of file that hold something else than they should."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest

from tests.unit.test_mutations import MAKERS
from wavefocus.calibration.check import check_file
from wavefocus.storage.errors import InputError

VALUES: list[object] = [
    "x",
    "",
    b"\xff\xfe",
    -1,
    0,
    1e308,
    5e-324,
    np.nan,
    np.array([], np.float64),
    np.zeros((3, 3)),
    h5py.Empty("f8"),
    True,
    np.array([(1, 2.0)], [("a", "i4"), ("b", "f8")]),
    1 + 2j,
    2**63,
    np.array(["a", "b"], dtype=h5py.string_dtype()),
]


def with_attribute(path: Path, name: str, key: str, value: object) -> None:
    with h5py.File(path, "r+") as file:
        file[name].attrs[key] = value


def keys_of(path: Path) -> list[tuple[str, str]]:
    found = []
    with h5py.File(path, "r") as file:
        found += [("/", key) for key in file.attrs]
        file.visititems(lambda name, item: found.extend((name, key) for key in item.attrs))
    scales = {"DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME"}
    return [(name, key) for name, key in [*found, *unlisted(found)] if key not in scales]


def unlisted(found: list[tuple[str, str]]) -> list[tuple[str, str]]:
    """Attributes that files of others may have."""
    datasets = {name for name, _ in found if name != "/"}
    return [(name, key) for name in datasets for key in ("scale_factor", "add_offset", "_FillValue", "volts_per_count")]


@pytest.mark.parametrize("kind", MAKERS)
@pytest.mark.parametrize("checked", [True, False])
def test_a_hostile_attribute_then_never_ends_in_a_traceback(tmp_path: Path, kind: str, *, checked: bool) -> None:
    path, made = tmp_path / "file.h5", tmp_path / "made.h5"
    MAKERS[kind](made)
    content = made.read_bytes()
    keys = keys_of(made)
    rng = np.random.default_rng(3)
    for number in rng.permutation(len(keys) * len(VALUES))[:60].tolist():
        (name, key), value = keys[number // len(VALUES)], VALUES[number % len(VALUES)]
        path.write_bytes(content)
        with_attribute(path, name, key, value)
        if not checked:  # so that each value is met by what reads it, not by a checksum before
            with h5py.File(path, "r+") as file:
                file.attrs.pop("contents_sha256", None)
        try:
            check_file(path)
        except InputError as refusal:
            told = str(refusal)
        else:
            told = ""
        assert "\n" not in told, (name, key, value)
