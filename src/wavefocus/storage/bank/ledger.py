"""What a bank keeps of each position: status bits and their words, quality, and the ledger row that holds them.

The row also holds the rms of the position's Green's functions, and their checksum.
"""

import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntFlag
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.storage.errors import InputError
from wavefocus.storage.ledger.pages import Bytes, LedgerFormat, RowShape, round_to_page, sealed


class Status(IntFlag):
    """Status bits of a position, as the bank's contract and scanning vibrometers have them."""

    NOT_MEASURED = 0
    VALID = 1
    OVER_RANGE = 2
    POOR_SIGNAL = 4
    FAILED = 8
    DISABLED = 16


USABLE = Status.VALID | Status.OVER_RANGE | Status.POOR_SIGNAL
"""Bits of a row that holds a measurement."""
DOUBTFUL = Status.OVER_RANGE | Status.POOR_SIGNAL
REFUSED = Status.FAILED | Status.DISABLED

STATUS_WORDS: dict[str, Status] = {
    "not-measured": Status.NOT_MEASURED,
    "valid": Status.VALID,
    "over-range": Status.OVER_RANGE,
    "poor": Status.POOR_SIGNAL,
    "failed": Status.FAILED,
    "disabled": Status.DISABLED,
}


def usable(status: NDArray[np.uint8]) -> NDArray[np.bool_]:
    """Rows that hold a measurement that may be used, bool (positions,)."""
    return np.asarray(((status & USABLE) != 0) & ((status & REFUSED) == 0))


def status_words(status: int) -> str:
    """The words of a status, as ``"poor"`` or ``"valid+over-range"``."""
    return "+".join(word for word, bit in STATUS_WORDS.items() if status & bit) or "not-measured"


def status_counts(status: NDArray[np.uint8]) -> dict[str, int]:
    """Positions per status word; a position with several bits counts under each."""
    counts = {word: int(np.count_nonzero(status & bit)) for word, bit in STATUS_WORDS.items() if bit}
    return {"not-measured": int(np.count_nonzero(status == 0)), **counts}


def not_valid(status: NDArray[np.uint8]) -> list[int]:
    """Bank rows that were measured and are not valid, those that a person has excluded left out."""
    return np.flatnonzero((status != 0) & (status & (Status.VALID | Status.DISABLED) == 0)).tolist()


def median_of_pairs(figures: NDArray[np.floating] | None, status: NDArray[np.uint8]) -> float | None:
    """Median of a figure over all measured pairs (position, actuator); None where none is known."""
    if figures is None:
        return None
    known = figures[status > 0]
    known = known[np.isfinite(known)]
    if not known.size:
        return None
    ordered = np.sort(known)  # np.median would load numpy.ma, which `wavefocus status` has no other use for
    return float(np.mean(ordered[[(known.size - 1) // 2, known.size // 2]]))


def row_ranges(rows: Sequence[int]) -> str:
    """Bank rows as ``--positions`` takes them: ``"3,5-9"``."""
    ranges: list[list[int]] = []
    for row in sorted(set(rows)):
        if ranges and row == ranges[-1][1] + 1:
            ranges[-1][1] = row
        else:
            ranges.append([row, row])
    return ",".join(f"{first}-{last}" if last > first else f"{first}" for first, last in ranges)


Float32Array = NDArray[np.float32]

QUALITY = {
    "snr_db": ("dB", "signal-to-noise ratio"),
    "residual_db": ("dB", "energy that the filters leave unexplained"),
    "coherence": ("1", "coherence of repeats"),
    "peak_v": ("V", "largest response at the recorder's input"),
    "attempts": ("1", "number of measurements of the position"),
    "moved_mm": ("mm", "distance of the laser from the position"),
    "reference_db": ("dB", "level of the reference relative to its calibration"),
    "leak_db": ("dB", "level of the loopback's leak into the response input, at the look before"),
}
"""Unit and meaning of each figure of ``/quality``."""
QUALITY_NAMES = tuple(QUALITY)
FIRST_QUALITY_NAMES, LATER_QUALITY_NAMES = QUALITY_NAMES[:5], QUALITY_NAMES[5:]
"""The later ones, one figure per position, are not in all banks of earlier versions."""
_PER_ACTUATOR = FIRST_QUALITY_NAMES[:-1]
_ALL_BITS = 31
# Bits of the ledger's status field: 8 of status, 22 of `neighbour_round`, `suspect`, `unjudgeable`.
_STATUS_MASK, _ROUND_AT, _SUSPECT_AT, _UNJUDGEABLE_AT = 255, 8, 30, 31
_MAX_ROUND = (1 << _SUSPECT_AT - _ROUND_AT) - 1

# The later figures are whole numbers: their step, and the number that stands for zero; 0 is a row that has none.
_LATER = {"moved_mm": (1e-3, 1), "reference_db": (1e-3, 32768), "leak_db": (1e-2, 32768)}
_QUALITY_AT = 48


@dataclass(frozen=True, slots=True, eq=False)
class PointRecord:
    """Status and quality of one position; out of range, InputError.

    status: Bits: 1 valid, 2 over-range, 4 poor signal, 8 failed, 16 disabled by the user; at least one.
    attempts: How often it was measured until this record, >= 0.
    snr_db, residual_db, coherence, peak_v, (N,): Signal-to-noise ratio, what the fitted FIRs leave unexplained,
        coherence (0 to 1) and largest response in DAQ volts per actuator; NaN where unknown.
    moved_mm: Distance of the laser from the position, 0 to 65 mm; NaN where unknown.
    reference_db: Level of the reference in dB of its calibration, median over the records; NaN where unknown.
    leak_db: Level of the loopback's leak into the response input at the look before, in dB re the loopback, -200 where
        none was seen; NaN where unknown.
    neighbour_round: Number of positions that were judged against their neighbours together, on those that were marked
        for it and on the last of them; 0 elsewhere.
    suspect: Whether the sentinel position had changed when it was measured next.
    unjudgeable: Whether it was marked because neighbours could not judge it.
    """

    status: int
    attempts: int
    snr_db: Float32Array
    residual_db: Float32Array
    coherence: Float32Array
    peak_v: Float32Array
    moved_mm: float = float("nan")
    reference_db: float = float("nan")
    leak_db: float = float("nan")
    neighbour_round: int = 0
    suspect: bool = False
    unjudgeable: bool = False

    def __post_init__(self) -> None:
        if not 1 <= self.status <= _ALL_BITS:
            raise InputError(f"status is {self.status}; a sum of 1, 2, 4, 8 and 16 is needed")
        if not 0 <= self.attempts < 1 << 24:
            raise InputError(f"attempts is {self.attempts}; 0 or more is needed")
        if not 0 <= self.neighbour_round <= _MAX_ROUND:
            raise InputError(f"neighbour_round is {self.neighbour_round}; 0 to {_MAX_ROUND} is needed")
        for name in _PER_ACTUATOR:
            object.__setattr__(self, name, np.ascontiguousarray(getattr(self, name), np.float32))


@dataclass(frozen=True, slots=True, eq=False)
class LedgerFigures:
    """What the ledger says of all positions.

    status, neighbour_round, suspect, unjudgeable, arrays (P,): See `PointRecord`; 0 where the row does not hold.
    quality: As ``/quality``: (P, N); the others (P,).
    rms, float64 (P, N): Root mean square over the taps of each Green's function; NaN where the row does not hold, is
        silent, or was written by an older version.
    """

    status: NDArray[np.uint8]
    neighbour_round: NDArray[np.int64]
    suspect: NDArray[np.bool_]
    unjudgeable: NDArray[np.bool_]
    quality: dict[str, Float32Array]
    rms: NDArray[np.float64]


def _file_figures(rows: Bytes, holds: NDArray[np.bool_], shape: RowShape) -> dict[str, NDArray[Any]]:
    """``/status`` and ``/quality``."""
    found = figures_of(rows, holds, shape.dimensions[0])
    return {"/status": found.status, **{f"/quality/{name}": found.quality[name].astype("<f4") for name in QUALITY}}


BANK = LedgerFormat(
    name="wavefocus-bank",
    kind="bank",
    datasets=("/green",),
    dtype="<f4",
    row_name=b"WFLEDGER",
    journal_name=b"WFREPLAC",
    crc_at=40,
    remedy="measure it again with: wavefocus resume {path}, or restore a copy",
    figures=_file_figures,
)


def bank_row_shape(actuators: int, taps: int) -> RowShape:
    """Sizes of a bank's rows: a ledger row is a page, or more where the quality of many actuators needs it."""
    return RowShape(BANK, (actuators, taps), round_to_page(_QUALITY_AT + 16 * actuators))


def _row_dtype(actuators: int) -> np.dtype[np.void]:
    size = round_to_page(_QUALITY_AT + 16 * actuators)
    with_rms = actuators if _QUALITY_AT + 24 * actuators <= size else 0  # where the row has room for it
    used = _QUALITY_AT + 16 * actuators + 8 * with_rms
    fields = {
        "status": ("<u4", 32), "attempts": ("<u4", 36), "green_crc": ("<u4", 40), "moved_mm": ("<u2", 44),
        "reference_db": ("<u2", 46), "quality": (("<f4", (4, actuators)), _QUALITY_AT),
        "rms": (("<f8", (with_rms,)), _QUALITY_AT + 16 * actuators),
    }  # fmt: skip
    if used + 2 <= size:
        fields["leak_db"] = ("<u2", size - 2)  # at the end of the page, where earlier versions have zeros
    names, formats, offsets = list(fields), [kind for kind, _ in fields.values()], [at for _, at in fields.values()]
    return np.dtype({"names": names, "formats": formats, "offsets": offsets, "itemsize": size})


def encode_row(position: int, record: PointRecord, green: Float32Array) -> bytes:
    """Encode the ledger row of a position's Green's functions, float32 (N, L)."""
    actuators, taps = green.shape
    for name in _PER_ACTUATOR:
        shape = getattr(record, name).shape
        if shape != (actuators,):
            raise InputError(f"{name} of position {position} has shape {shape}; ({actuators},) is needed")
    row = np.zeros((), _row_dtype(actuators))
    marks = record.suspect << _SUSPECT_AT | record.unjudgeable << _UNJUDGEABLE_AT
    row["status"] = record.status | record.neighbour_round << _ROUND_AT | marks
    row["attempts"] = record.attempts
    for name, (step, zero) in _LATER.items():
        figure = getattr(record, name)
        if name in (row.dtype.names or ()):
            row[name] = 0 if np.isnan(figure) else int(np.clip(np.rint(figure / step) + zero, 1, 65535))
    row["green_crc"] = zlib.crc32(green.astype("<f4", copy=False).data)
    for index, name in enumerate(_PER_ACTUATOR):
        row["quality"][index] = getattr(record, name)
    row["rms"] = np.sqrt(np.square(green, dtype=np.float64).mean(axis=1))[: row["rms"].size]
    content = bytearray(row.tobytes())
    head = bank_row_shape(actuators, taps).row_head(position)
    content[: len(head)] = head
    return sealed(content)


def figures_of(content: Bytes, holds: NDArray[np.bool_], actuators: int) -> LedgerFigures:
    """What ledger rows say of their positions, where they hold."""
    rows = np.frombuffer(content, _row_dtype(actuators))
    status = rows["status"] & _STATUS_MASK
    holds = holds & (status >= 1) & (status <= _ALL_BITS)
    quality = {}
    for index, name in enumerate(_PER_ACTUATOR):
        quality[name] = np.where(holds[:, None], rows["quality"][:, index], np.nan).astype(np.float32)
    quality["attempts"] = np.where(holds, rows["attempts"], 0).astype(np.float32)
    for name, (step, zero) in _LATER.items():
        whole = rows[name] if name in (rows.dtype.names or ()) else np.zeros(len(rows), "<u2")
        values = (whole.astype(np.float64) - zero) * step
        quality[name] = np.where(holds & (whole > 0), values, np.nan).astype(np.float32)
    rms = np.full((len(rows), actuators), np.nan)
    stored = holds & rows["rms"].any(axis=1)
    rms[:, : rows["rms"].shape[1]] = np.where(stored[:, None], rows["rms"], np.nan)
    held = np.where(holds, rows["status"], 0)
    return LedgerFigures(
        (held & _STATUS_MASK).astype(np.uint8),
        (held >> _ROUND_AT & _MAX_ROUND).astype(np.int64),
        (held >> _SUSPECT_AT & 1).astype(bool),
        (held >> _UNJUDGEABLE_AT & 1).astype(bool),
        quality,
        rms,
    )
