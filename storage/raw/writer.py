"""Keeping raw recordings, as durably as the bank."""

from __future__ import annotations

import struct
import zlib

import numpy as np
from numpy.typing import NDArray

from storage.errors import InputError
from storage.ledger.pages import ROW_HEAD, sealed
from storage.ledger.writer import LedgerWriter
from storage.raw.header import RAW, RawHeader
from storage.raw.layout import create_raw, read_raw_layout

__all__ = ["RawWriter", "create_raw"]

Float32Array = NDArray[np.float32]


class RawWriter(LedgerWriter):
    """The one process that records into a raw file; a context manager, made by :meth:`open`."""

    header: RawHeader
    _format = RAW
    _read_layout = staticmethod(read_raw_layout)
    _create = staticmethod(create_raw)

    @property
    def recorded(self) -> NDArray[np.bool_]:
        """Which positions (P,) are kept; a row that is damaged is not."""
        return self._measured.copy()

    def commit(self, position: int, reference_v: Float32Array, response_v: Float32Array) -> None:
        """Keep the recordings of one position for good; when this returns, no crash loses them.

        position: Row of the file, 0 to P - 1.
        reference_v, response_v, float32 (records, samples): The two DAQ channels in volts, a record per row; whole
            multiples of the header's volts per count, within the range of 16 bits.

        Raises InputError, FileLostError, WavefocusError: as `storage.bank.writer.BankWriter.commit`.
        """
        self._require_position(position)
        steps = self.header.volts_per_count
        chunks = [
            self._counts("reference", reference_v, steps[0]),
            self._counts("response", response_v, steps[1]),
        ]
        row = bytearray(self._shape.row_head(position).ljust(self._shape.row_bytes, b"\0"))
        struct.pack_into("<2I", row, ROW_HEAD.size, *map(zlib.crc32, chunks))
        self._commit(position, chunks, sealed(row))

    def _counts(self, name: str, volts: Float32Array, step_v: float) -> bytes:
        if np.shape(volts) != self._shape.dimensions:
            raise InputError(f"the {name} has shape {np.shape(volts)}; {self._shape.dimensions} is needed")
        counts = np.multiply(volts, 1 / step_v, dtype=np.float64)
        rounded = np.rint(counts)
        if not (np.isfinite(counts).all() and rounded.min() >= -32768 and rounded.max() <= 32767):
            raise InputError(
                f"the {name} holds values that are not finite or beyond {32768 * step_v:g} V; "
                "those of the header's converter are needed"
            )
        return rounded.astype("<i2").tobytes()

    def _recover(self) -> NDArray[np.bool_]:
        layout, shape = self._layout, self._shape
        return shape.decode(self._read(layout.ledger_offset, layout.positions * shape.row_bytes)).holds
