"""The bank as calculations keep it between edits: open, its median level, the spectra of its rows at a lower rate."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rendering.field.bank_spectra import BankSpectra
from rendering.field.decimation import LARGEST_FACTOR, PASSED
from rendering.field.model import measured_positions
from rendering.greens.regularisation import saturation_threshold
from rendering.scene.model import Regularisation
from storage.bank.reading import Bank, open_bank
from storage.errors import InputError

Int64Array = NDArray[np.int64]

# An edit is noticed between two parts of the field; each takes a fraction of a second.
PART_POSITIONS = 128
MOST_SPECTRA_BYTES = 512 * 2**20
# What the measured band may reach beyond its upper edge, which a sweep's fade leaves behind.
_ROOM = 1.05

_Identity = tuple[Path, int, int, int, int]


class PlateBank:
    """Opens a bank, and keeps what does not depend on the scene until the file changes."""

    def __init__(self) -> None:
        self._bank: Bank | None = None
        self._identity: _Identity | None = None
        self._content: tuple[bytes, bytes] = (b"", b"")
        self._median: float | None = None
        self._spectra: dict[int, BankSpectra] = {}
        self._spectra_bytes = 0
        self.rows: Int64Array = np.zeros(0, np.int64)

    def open(self, path: Path) -> tuple[Bank, bool]:
        """Open a bank, or go on with it; the second answer is whether rows are others than before.

        Raises
        ------
        InputError
            It is not there or cannot be read.
        """
        identity = identity_of(path)
        if self._bank is not None and identity == self._identity:
            return self._bank, False
        before = None if self._identity is None else self._identity[0]
        self.close()
        bank = open_bank(path)
        try:
            bank.require_sound()
        except InputError:
            bank.close()
            raise
        self._bank, self._identity = bank, identity
        attempts = bank.quality.get("attempts")
        content = bank.status.tobytes(), b"" if attempts is None else np.asarray(attempts).tobytes()
        anew = before != path or content != self._content
        # Another program's bank does not tell what it changed.
        anew |= not content[1] or bank.plan_sha256 is None
        if anew:
            self._content, self._median, self._spectra, self._spectra_bytes = content, None, {}, 0
            self.rows, _ = measured_positions(bank)
        return bank, anew

    def changed(self, path: Path) -> bool:
        """Whether the file is another than when it was opened. Raises InputError where it is gone."""
        return identity_of(path) != self._identity

    def close(self) -> None:
        """Let go of the file."""
        if self._bank is not None:
            with suppress(OSError):
                self._bank.close()
        self._bank = self._identity = None

    def absolute(self, regularisation: Regularisation) -> Regularisation:
        """The same regularisation with C itself; the median that it may be a fraction of is found once.

        Raises
        ------
        InputError
            The median is 0.
        """
        if not regularisation.saturation:
            return regularisation
        assert self._bank is not None
        if self._median is None:
            self._median = saturation_threshold(Regularisation(saturation=1.0), self._bank)
        threshold = float(np.float64(regularisation.saturation) * self._median)
        return Regularisation(saturation_absolute=threshold, normalise=regularisation.normalise)

    @property
    def factor(self) -> int:
        """By how much the field's rate may be below the bank's without losing any of the band; 1 without a band."""
        assert self._bank is not None
        if self._bank.band_hz is None:
            return 1
        most = PASSED * self._bank.sample_rate_hz / 2.0 / (_ROOM * self._bank.band_hz[1])
        return int(np.clip(most, 1, LARGEST_FACTOR))

    @property
    def rate_hz(self) -> float:
        """The field's rate."""
        assert self._bank is not None
        return self._bank.sample_rate_hz / self.factor

    def parts(self) -> list[Int64Array]:
        """The rows of the field, in parts."""
        return [self.rows[first : first + PART_POSITIONS] for first in range(0, len(self.rows), PART_POSITIONS)]

    def spectra(self, part: int, rows: Int64Array) -> BankSpectra:
        """Spectra of one part's rows; kept as long as there is room for them."""
        kept = self._spectra.get(part)
        if kept is not None:
            return kept
        assert self._bank is not None
        made = BankSpectra(self._bank, rows, rate_hz=self.rate_hz)
        if self._spectra_bytes + made.size_bytes <= MOST_SPECTRA_BYTES:
            self._spectra[part] = made
            self._spectra_bytes += made.size_bytes
        return made


def identity_of(path: Path) -> _Identity:
    """What tells one state of a file from another.

    Raises
    ------
    InputError
        It is not there.
    """
    try:
        found = path.stat()
    except FileNotFoundError:
        raise InputError(
            f"{path} is not there; it has been deleted or moved: put it back, or open another bank"
        ) from None
    return path, found.st_dev, found.st_ino, found.st_mtime_ns, found.st_size
