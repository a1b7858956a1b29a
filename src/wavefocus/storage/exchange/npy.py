"""Arrays in NPY form (numpy.lib.format); pickled ones are never read."""

from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError

MAGIC = b"\x93NUMPY"


def mapped_array(path: Path) -> NDArray[Any]:
    """The array of an NPY file, read as it is used; a pickled one is refused."""
    with path.open("rb") as file:
        _, declared = array_header(file, path)
        held = path.stat().st_size
    if declared > held:
        raise InputError(f"{path} is truncated: it declares {declared} bytes and holds {held}")
    return np.asarray(np.load(path, mmap_mode="r", allow_pickle=False))


def array_header(file: IO[bytes], path: Path) -> tuple[np.dtype[Any], int]:
    """Type and bytes of an array in NPY form."""
    version = np.lib.format.read_magic(file)
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, _, dtype = read_header(file)
    if dtype.hasobject:
        raise InputError(f"{path} holds pickled objects, which are never read; save plain numbers")
    return dtype, int(np.prod([int(extent) for extent in shape], dtype=object)) * dtype.itemsize
