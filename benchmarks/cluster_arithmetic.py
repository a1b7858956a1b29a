"""The arithmetic of large banks on paper: bytes and operations of a prediction, and hours from measured rates."""

from __future__ import annotations

from dataclasses import dataclass
from math import ceil, log2

FFT_SAMPLES = 4096
DISK_BYTES_PER_S = 1e9


@dataclass(frozen=True, slots=True)
class Work:
    """A prediction in float64: P positions, N actuators, L taps, S samples of drive.

    Parameters
    ----------
    positions, actuators, taps, samples : int
        P, N, L < 4096, S.
    """

    positions: int
    actuators: int
    taps: int = 2000
    samples: int = 5000

    @property
    def blocks(self) -> int:
        """B: a transform of F samples takes F - L + 1 new ones."""
        return ceil(self.samples / (FFT_SAMPLES - self.taps + 1))

    @property
    def bank_bytes(self) -> float:
        """4 P N L."""
        return 4.0 * self.positions * self.actuators * self.taps

    @property
    def field_bytes(self) -> float:
        """4 P (S + L - 1)."""
        return 4.0 * self.positions * (self.samples + self.taps - 1)

    @property
    def transforms(self) -> float:
        """Operations of transforming rows and of transforming blocks back, 2.5 P (N + B) F log2 F."""
        return 2.5 * self.positions * (self.actuators + self.blocks) * FFT_SAMPLES * log2(FFT_SAMPLES)

    @property
    def products(self) -> float:
        """Operations of the products per bin, 8 P N B F / 2."""
        return 8.0 * self.positions * self.actuators * self.blocks * FFT_SAMPLES / 2.0

    @property
    def row_bytes(self) -> float:
        """A row in float64 and its spectra: 8 N L + 8 N F."""
        return 8.0 * self.actuators * (self.taps + FFT_SAMPLES)

    @property
    def drive_bytes(self) -> float:
        """The drive and its spectra, which are kept as real matrices: 8 N S + 16 N F B."""
        return 8.0 * self.actuators * (self.samples + 2 * FFT_SAMPLES * self.blocks)


WORKS = {"1500 x 20": Work(1500, 20), "10,000 x 20": Work(10_000, 20), "10,000 x 10,000": Work(10_000, 10_000)}


def table(operations_per_s: float) -> list[str]:
    """Lines of the table, in Markdown.

    Parameters
    ----------
    operations_per_s : float
        Operations a second and core, as measured.
    """
    works = WORKS.values()
    rows: list[tuple[str, list[str]]] = [
        ("bank, 4 P N L bytes", [size(work.bank_bytes) for work in works]),
        ("field, 4 P (S + L - 1) bytes", [size(work.field_bytes) for work in works]),
        ("transforms, 2.5 P (N + B) F log2 F operations", [f"{work.transforms:.1e}" for work in works]),
        ("products per bin, 8 P N B F / 2 operations", [f"{work.products:.1e}" for work in works]),
        ("a row and its spectra, 8 N (L + F) bytes", [size(work.row_bytes) for work in works]),
        ("a worker: the drive, its spectra, one row", [size(work.drive_bytes + work.row_bytes) for work in works]),
        (
            f"reading the bank at {DISK_BYTES_PER_S / 1e9:g} GB/s",
            [span(work.bank_bytes / DISK_BYTES_PER_S) for work in works],
        ),
        (
            f"operations at {operations_per_s:.1e} a second and core",
            [span((work.transforms + work.products) / operations_per_s) for work in works],
        ),
    ]
    lines = ["| what | " + " | ".join(WORKS) + " |", "|---|" + "---|" * len(WORKS)]
    return lines + [f"| {what} | " + " | ".join(cells) + " |" for what, cells in rows]


def cores_that_one_disk_feeds(operations_per_s: float) -> float:
    """Cores that read a bank of 10,000 x 10,000 as fast as they compute with it."""
    work = WORKS["10,000 x 10,000"]
    return (work.transforms + work.products) / operations_per_s / (work.bank_bytes / DISK_BYTES_PER_S)


def size(count: float) -> str:
    """Bytes in words."""
    return f"{count / 1e9:.3g} GB" if count >= 1e8 else f"{count / 1e6:.2g} MB"


def span(seconds: float) -> str:
    """A time in words."""
    if seconds < 100:
        return f"{seconds:.2g} s"
    return f"{seconds / 60:.2g} min" if seconds < 6000 else f"{seconds / 3600:.2g} hours"
