"""The model of the waves between a bank's positions, kept as a file next to the bank.

It can be computed anew at any time: a file that is missing, damaged, of another version, or of other contents of the
bank than now is not used, and replaced; a file of another kind is left alone. Several processes may write it; each
writes it whole.
"""

from collections.abc import Collection, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage import durable, hdf5_digest, hdf5_reading
from wavefocus.storage.errors import InputError
from wavefocus.storage.hdf5_writing import created
from wavefocus.storage.sidecar_files import staging_dir
from wavefocus.storage.text_file import HDF5_SIGNATURE

FORMAT = "wavefocus-waves"
_KEY = "bank_sha256"


def wave_file(bank: Path) -> Path:
    """Where the model of a bank is kept: ``plate.waves.h5`` for ``plate.h5``."""
    return bank.with_name(f"{bank.stem}.waves.h5")


def write_wave_file(path: Path, key: str, arrays: Mapping[str, NDArray[Any]]) -> bool:
    """Write arrays under the hash of the bank's contents; an older or damaged file of that name is replaced.

    Returns False where the folder does not allow it, or the name belongs to a file of another kind.
    """
    try:
        if _is_of_another_kind(path):
            return False
        with staging_dir(path) as staging:
            with created(staging.temporary, sum(values.nbytes for values in arrays.values())) as file:
                file.attrs["format"], file.attrs["format_version"], file.attrs[_KEY] = FORMAT, 1, key
                for name, values in arrays.items():
                    file.create_dataset(name, data=values, track_times=False)
                hdf5_digest.seal(file)
            durable.sync_path(staging.temporary)
            staging.publish()
    except (InputError, OSError):
        return False
    return True


def _is_of_another_kind(path: Path) -> bool:
    """Whether a file is no HDF5 file, or a sound one of another format; one that cannot be read is a damaged model."""
    if not path.exists():
        return False
    with path.open("rb") as file:
        if file.read(len(HDF5_SIGNATURE)) != HDF5_SIGNATURE:
            return True
    with suppress(InputError):
        return hdf5_digest.format_of(path)[0] != FORMAT
    return False


def read_wave_file(path: Path, key: str, names: Collection[str]) -> dict[str, NDArray[Any]] | None:
    """The arrays of a file, or None where it is missing, damaged or not of these contents of the bank."""
    with suppress(InputError, OSError, KeyError, ValueError), hdf5_reading.opened(path) as file:
        hdf5_reading.require_format(file, FORMAT)
        if hdf5_reading.text(file, _KEY) != key or not hdf5_digest.require_all(file, ""):
            return None
        return {name: np.asarray(hdf5_reading.read_whole(file[name])) for name in names}
    return None
