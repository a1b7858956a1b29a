"""Reading a field file a few rows at a time, for fields that do not fit into memory."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import h5py
import numpy as np
from numpy.typing import NDArray

from storage import hdf5_digest, hdf5_safety
from storage.errors import InputError
from storage.field_file import FORMAT, VERSION, LowPass, read_low_pass
from storage.labelled_hdf5 import require_sample_times

AT_ONCE_BYTES = 32 << 20


class FieldRowReader:
    """A field file open for reading; a context manager.

    Parameters
    ----------
    path : str or Path
        The file.

    Raises
    ------
    InputError
        The file is missing, damaged, no field file, or of a future version.
    """

    position_index: NDArray[np.int64]
    """Bank row of each row of the field."""
    samples: int
    sample_rate_hz: float
    start_s: float
    response_unit: str
    low_pass: LowPass | None
    """What it lost to a rate below the bank's."""
    verified: bool
    """Whether the file carries checksums of all its values."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with ExitStack() as stack:
            file = stack.enter_context(hdf5_safety.opened(self.path))
            hdf5_safety.require_format(file, self.path, FORMAT, VERSION)
            hdf5_safety.require_sound_texts(file, self.path)
            self._field: h5py.Dataset = hdf5_safety.plain_dataset(file, "/field", self.path)
            if self._field.ndim != 2 or not self._field.size:
                raise InputError(f"{self.path}: /field has shape {self._field.shape}; (position, sample) is needed")
            hdf5_safety.require_rows(self._field, self.path)
            rows = len(self._field)
            self.position_index = hdf5_safety.read_integers(file, "/position_index", self.path, (rows,))
            self.samples = int(self._field.shape[1])
            self.sample_rate_hz = hdf5_safety.number(file, "sample_rate_hz", self.path)
            self.start_s = hdf5_safety.number(file, "start_s", self.path)
            self.response_unit = hdf5_safety.text(file, "response_unit", self.path) or ""
            self.low_pass = read_low_pass(file, self.path)
            if not self.sample_rate_hz > 0:
                raise InputError(f"{self.path}: sample_rate_hz is {self.sample_rate_hz}; a rate above 0 is needed")
            require_sample_times(file, self.path, self.samples, self.sample_rate_hz, self.start_s)
            hdf5_digest.require_contents(file, self.path)
            self.verified = hdf5_digest.require_datasets(file, self.path, {"/field"})
            self._expected = hdf5_digest.expected_sha256(self._field, self.path)
            self._open = stack.pop_all()

    def blocks(self) -> Iterator[tuple[int, NDArray[Any]]]:
        """Give the first row's number and the values (rows, samples) of some rows at a time.

        Raises
        ------
        InputError
            A row cannot be read, or holds NaN or infinities; after the last one, their checksum does not hold.
        """
        digest = hdf5_digest.RunningDigest(self._field.dtype)
        at_once = max(1, AT_ONCE_BYTES // (8 * self.samples))
        for first in range(0, len(self.position_index), at_once):
            try:
                values = np.asarray(self._field[first : first + at_once])
            except (OSError, RuntimeError) as error:
                complaint = hdf5_safety.hdf5_complaint(error)
                raise InputError(f"{self.path}: /field from row {first} {complaint}") from error
            if values.dtype.kind != "f" or not np.isfinite(values).all():
                raise InputError(f"{self.path}: /field from row {first} holds something else than finite numbers")
            if self._expected is not None:
                digest.update(values)
            yield first, values
        if self._expected is not None:
            hdf5_digest.require_values(digest.hexdigest(), self._expected, "/field", self.path)
            self._expected = None  # once is enough

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._open.close()
