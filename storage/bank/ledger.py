"""The ledger row that makes a position count as measured, and the journal that lets one be replaced.

A ledger row fills whole pages. Its own CRC-32 covers all its bytes, and it carries the CRC-32 of the
position's Green's functions; only where both hold is the position measured. The journal holds one (Green's
functions, ledger row) pair while it overwrites an older one.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from storage.durable import PAGE
from storage.errors import InputError
from storage.page_crc import seal_holds, sealed

Float32Array = NDArray[np.float32]

FIRST_QUALITY_NAMES = ("snr_db", "residual_db", "coherence", "peak_v", "attempts")
LATER_QUALITY_NAMES = ("moved_mm", "reference_db")
"""One figure per position, which banks of the first edition do not have."""
QUALITY_NAMES = FIRST_QUALITY_NAMES + LATER_QUALITY_NAMES
_PER_ACTUATOR = FIRST_QUALITY_NAMES[:-1]
VALID, OVER_RANGE, POOR_SIGNAL, FAILED, DISABLED = 1, 2, 4, 8, 16
_ALL_BITS = 31
# The ledger's status field holds `PointRecord.judged` above its lowest byte.
_STATUS_BITS, _STATUS_MASK = 8, 255

_LEDGER_MAGIC = b"WFLEDGER"
_JOURNAL_MAGIC = b"WFREPLAC"
# The later figures are whole numbers, in steps of 0.001 mm and 0.001 dB; 0 is a row that has none.
_STEP = 1e-3
_REFERENCE_ZERO = 32768
_HEAD = struct.Struct("<8sIIQIIIII")  # the fields of ledger_dtype before the quality
_QUALITY_AT = 48


@dataclass(frozen=True, slots=True, eq=False)
class PointRecord:
    """What was found out about one position besides its Green's functions.

    Parameters
    ----------
    status : int
        Bits: 1 valid, 2 over-range, 4 poor signal, 8 failed, 16 disabled by the user.
    attempts : int
        How often it was measured until this record, >= 0.
    snr_db, residual_db, coherence, peak_v : array (N,)
        Signal-to-noise ratio, what the fitted FIRs leave unexplained, coherence (0 to 1) and largest
        response in DAQ volts per actuator; NaN where unknown.
    moved_mm : float
        How far beside the position the laser was, 0 to 65 mm; NaN where unknown.
    reference_db : float
        Level of the reference in dB of its calibration, median over the records; NaN where unknown.
    judged : int
        Number of positions that were judged against their neighbours together, on those that were marked for it and on
        the last of them; 0 elsewhere.

    Raises
    ------
    InputError
        When status holds no bit or an unknown one, or attempts is negative.
    """

    status: int
    attempts: int
    snr_db: Float32Array
    residual_db: Float32Array
    coherence: Float32Array
    peak_v: Float32Array
    moved_mm: float = float("nan")
    reference_db: float = float("nan")
    judged: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.status <= _ALL_BITS:
            raise InputError(f"status is {self.status}; a sum of 1, 2, 4, 8 and 16 is needed")
        if not 0 <= self.attempts < 1 << 24:
            raise InputError(f"attempts is {self.attempts}; 0 or more is needed")
        for name in _PER_ACTUATOR:
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), np.float32))


def round_to_page(size: int) -> int:
    """Round a size in bytes up to whole pages."""
    return -(-size // PAGE) * PAGE


def ledger_row_bytes(actuators: int) -> int:
    """Bytes of one ledger row: a page, or more where the quality of many actuators needs it."""
    return round_to_page(_QUALITY_AT + 16 * actuators)


def ledger_dtype(actuators: int) -> np.dtype[np.void]:
    """Return the layout of one ledger row."""
    return np.dtype(
        {
            "names": [
                "magic", "crc", "version", "position", "actuators", "taps",
                "status", "attempts", "green_crc", "moved", "reference", "quality", "rms",
            ],
            "formats": ["S8", "<u4", "<u4", "<u8", "<u4", "<u4", "<u4", "<u4", "<u4", "<u2", "<u2",
                        ("<f4", (4, actuators)), ("<f8", (_rms_figures(actuators),))],
            "offsets": [0, 8, 12, 16, 24, 28, 32, 36, 40, 44, 46, _QUALITY_AT, _QUALITY_AT + 16 * actuators],
            "itemsize": ledger_row_bytes(actuators),
        }
    )  # fmt: skip


def _rms_figures(actuators: int) -> int:
    """Number of rms figures in a ledger row: all actuators, or none where the row has no room for them."""
    return actuators if _QUALITY_AT + 24 * actuators <= ledger_row_bytes(actuators) else 0


def encode_row(position: int, record: PointRecord, green: Float32Array) -> bytes:
    """Encode the ledger row of a position's Green's functions, float32 (N, L)."""
    actuators, taps = green.shape
    for name in _PER_ACTUATOR:
        shape = getattr(record, name).shape
        if shape != (actuators,):
            raise InputError(f"{name} of position {position} has shape {shape}; ({actuators},) is needed")
    row = np.zeros((), ledger_dtype(actuators))
    row["magic"], row["version"], row["position"] = _LEDGER_MAGIC, 1, position
    row["actuators"], row["taps"] = actuators, taps
    row["status"], row["attempts"] = record.status | record.judged << _STATUS_BITS, record.attempts
    row["moved"] = _counted(record.moved_mm, 1)
    row["reference"] = _counted(record.reference_db, _REFERENCE_ZERO)
    row["green_crc"] = zlib.crc32(green.astype("<f4", copy=False).data)
    for index, name in enumerate(_PER_ACTUATOR):
        row["quality"][index] = getattr(record, name)
    row["rms"] = np.sqrt(np.square(green, dtype=np.float64).mean(axis=1))[: _rms_figures(actuators)]
    return sealed(bytearray(row.tobytes()))


@dataclass(frozen=True, slots=True, eq=False)
class Ledger:
    """All ledger rows, decoded.

    Parameters
    ----------
    holds : bool array (P,)
        Rows whose checksum holds and that belong to their position.
    empty : bool array (P,)
        Rows never written, all zeros.
    green_crc : uint32 array (P,)
        Checksum of the Green's functions, 0 where the row does not hold.
    status, judged : uint8 and int64 arrays (P,)
        Status bits, 0 where the row does not hold.
    quality : dict of float32 arrays
        As ``/quality``: (P, N); ``attempts``, ``moved_mm`` and ``reference_db`` (P,).
    rms : float64 array (P, N)
        Root mean square over the taps of each Green's function; NaN where the row does not hold, is silent, or was
        written by an older version.
    """

    holds: NDArray[np.bool_]
    empty: NDArray[np.bool_]
    green_crc: NDArray[np.uint32]
    status: NDArray[np.uint8]
    judged: NDArray[np.int64]
    quality: dict[str, Float32Array]
    rms: NDArray[np.float64]

    @property
    def damaged(self) -> NDArray[np.bool_]:
        """Rows that were written and whose checksum does not hold."""
        return ~self.holds & ~self.empty


def decode_rows(content: bytes | bytearray | memoryview, actuators: int, taps: int, first: int = 0) -> Ledger:
    """Decode ledger rows, of positions ``first`` onwards."""
    size = ledger_row_bytes(actuators)
    view = memoryview(content)
    rows = np.frombuffer(content, ledger_dtype(actuators))
    whole = np.array([seal_holds(view[at : at + size]) for at in range(0, len(view), size)], bool)
    holds = whole & (rows["magic"] == _LEDGER_MAGIC) & (rows["version"] == 1)
    holds &= (rows["position"] == first + np.arange(len(rows))) & (rows["actuators"] == actuators)
    status, judged = rows["status"] & _STATUS_MASK, rows["status"] >> _STATUS_BITS
    holds &= (rows["taps"] == taps) & (status >= 1) & (status <= _ALL_BITS)
    rms = np.full((len(rows), actuators), np.nan)
    stored = holds & rows["rms"].any(axis=1)
    rms[:, : rows["rms"].shape[1]] = np.where(stored[:, None], rows["rms"], np.nan)
    return Ledger(
        holds=holds,
        empty=np.asarray(np.frombuffer(content, np.uint64).reshape(len(rows), -1).max(axis=1) == 0),
        green_crc=np.where(holds, rows["green_crc"], 0).astype(np.uint32),
        status=np.where(holds, status, 0).astype(np.uint8),
        judged=np.where(holds, judged, 0).astype(np.int64),
        quality=_quality_of(rows, holds),
        rms=rms,
    )


def _counted(figure: float, zero: int) -> int:
    """A figure as it is kept: in steps from `zero`, at least 1; 0 where it is unknown."""
    return 0 if np.isnan(figure) else int(np.clip(round(figure / _STEP) + zero, 1, 65535))


def green_crc_of_row(row: bytes | bytearray, position: int, actuators: int, taps: int) -> int | None:
    """Return the Green's functions' checksum from one ledger row; None when the row does not hold."""
    magic, _, version, found, row_actuators, row_taps, status, _, crc = _HEAD.unpack_from(row)
    names = (magic, version, found, row_actuators, row_taps) == (_LEDGER_MAGIC, 1, position, actuators, taps)
    return crc if names and 1 <= status & _STATUS_MASK <= _ALL_BITS and seal_holds(row) else None


def journal_bytes(actuators: int, taps: int) -> int:
    """Bytes of the journal: its own page, the Green's functions and a ledger row."""
    return PAGE + round_to_page(actuators * taps * 4) + ledger_row_bytes(actuators)


def encode_journal(position: int, chunk: bytes, row: bytes) -> bytes:
    """Encode the journal for one replacement; ``chunk`` is padded to whole pages."""
    head = bytearray(PAGE)
    head[:8] = _JOURNAL_MAGIC
    head[16:24] = position.to_bytes(8, "little")
    return sealed(head + chunk + row)


def decode_journal(content: bytes | bytearray, actuators: int, taps: int) -> tuple[int, bytes, bytes] | None:
    """Return (position, padded chunk, ledger row) of a journal that is whole, else None."""
    if content[:8] != _JOURNAL_MAGIC or not seal_holds(content):
        return None
    position = int.from_bytes(content[16:24], "little")
    split = PAGE + round_to_page(actuators * taps * 4)
    chunk, row = bytes(content[PAGE:split]), bytes(content[split:])
    ledger = decode_rows(row, actuators, taps, position)
    if not ledger.holds[0] or zlib.crc32(memoryview(chunk)[: actuators * taps * 4]) != ledger.green_crc[0]:
        return None
    return position, chunk, row


def _quality_of(rows: NDArray[np.void], holds: NDArray[np.bool_]) -> dict[str, Float32Array]:
    quality = {}
    for index, name in enumerate(_PER_ACTUATOR):
        quality[name] = np.where(holds[:, None], rows["quality"][:, index], np.nan).astype(np.float32)
    quality["attempts"] = np.where(holds, rows["attempts"], 0).astype(np.float32)
    for name, field, zero in (("moved_mm", "moved", 1), ("reference_db", "reference", _REFERENCE_ZERO)):
        figures = (rows[field].astype(np.float64) - zero) * _STEP
        quality[name] = np.where(holds & (rows[field] > 0), figures, np.nan).astype(np.float32)
    return quality
