"""What calculations keep of a bank between edits: open file, surface, median level, decimated spectra of its rows."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from config.scene import Regularisation
from gui.surface.surface import Surface, surface_of
from rendering.field.bank_spectra import LARGEST_FACTOR, PASSED, BankSpectra
from rendering.field.prediction import measured_positions
from rendering.greens.regularisation import saturation_threshold
from storage.bank.reading import Bank, open_bank
from storage.errors import InputError

Int64Array = NDArray[np.int64]

# An edit is noticed between two parts of the field; each takes a fraction of a second.
PART_POSITIONS = 128
MOST_SPECTRA_BYTES = 512 * 2**20
# The measured band may reach beyond its upper edge, which a sweep's fade leaves behind.
_ROOM = 1.05

_Identity = tuple[Path, int, int, int, int]


class BankCache:
    """An open bank, and what does not depend on the scene until the file changes."""

    surface: Surface

    def __init__(self) -> None:
        self._bank: Bank | None = None
        self._identity: _Identity | None = None
        self._content: tuple[bytes, bytes] = (b"", b"")
        self._median: float | None = None
        self._spectra: dict[int, BankSpectra] = {}
        self._spectra_bytes = 0
        self.rows: Int64Array = np.zeros(0, np.int64)

    @property
    def bank(self) -> Bank:
        """The open bank."""
        assert self._bank is not None
        return self._bank

    def open(self, path: Path) -> Bank:
        """Open a bank, or go on with it. Raises InputError where it is missing or cannot be read."""
        identity = _identity_of(path)
        if self._bank is not None and identity == self._identity:
            return self._bank
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
        # Banks of other programs do not say what has changed.
        foreign = not content[1] or bank.plan_sha256 is None
        if foreign or before != path or content != self._content:
            self._content, self._median, self._spectra, self._spectra_bytes = content, None, {}, 0
            self.rows, _ = measured_positions(bank)
            if len(self.rows):
                self.surface = surface_of(bank).with_rows(self.rows)
        return bank

    def changed(self, path: Path) -> bool:
        """Whether the file has changed since it was opened. Raises InputError where it is missing."""
        return _identity_of(path) != self._identity

    def close(self) -> None:
        """Close the file."""
        if self._bank is not None:
            with suppress(OSError):
                self._bank.close()
        self._bank = self._identity = None

    def absolute(self, regularisation: Regularisation) -> Regularisation:
        """The same regularisation with C itself, from the bank's median. Raises InputError where that is 0."""
        if not regularisation.saturation:
            return regularisation
        if self._median is None:
            self._median = saturation_threshold(Regularisation(saturation=1.0), self.bank)
        threshold = float(np.float64(regularisation.saturation) * self._median)
        return Regularisation(saturation_absolute=threshold, normalise=regularisation.normalise)

    @property
    def factor(self) -> int:
        """How many times lower the field's rate may be without losing any of the band; 1 without a band."""
        if self.bank.band_hz is None:
            return 1
        most = PASSED * self.bank.sample_rate_hz / 2.0 / (_ROOM * self.bank.band_hz[1])
        return int(np.clip(most, 1, LARGEST_FACTOR))

    @property
    def rate_hz(self) -> float:
        """The field's rate."""
        return self.bank.sample_rate_hz / self.factor

    def parts(self) -> list[Int64Array]:
        """The rows of the field, in parts of equal size but for the last."""
        return [self.rows[first : first + PART_POSITIONS] for first in range(0, len(self.rows), PART_POSITIONS)]

    def spectra(self, part: int, rows: Int64Array) -> BankSpectra:
        """Spectra of one part's rows, kept while there is room for them."""
        kept = self._spectra.get(part)
        if kept is not None:
            return kept
        made = BankSpectra(self.bank, rows, rate_hz=self.rate_hz)
        if self._spectra_bytes + made.size_bytes <= MOST_SPECTRA_BYTES:
            self._spectra[part] = made
            self._spectra_bytes += made.size_bytes
        return made


def _identity_of(path: Path) -> _Identity:
    try:
        found = path.stat()
    except FileNotFoundError:
        raise InputError(f"{path} is missing (deleted or moved): put it back, or open another bank") from None
    return path, found.st_dev, found.st_ino, found.st_mtime_ns, found.st_size
