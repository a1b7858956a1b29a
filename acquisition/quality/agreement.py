"""Whether a new measurement of a position agrees with the valid row that the bank holds of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# A Green's function that is no farther from another than this is the same, whatever the noise.
SAME = 0.02
# Two measurements differ by more than so many times what their noise explains.
OVER_NOISE = 5.0
# Places apart give other responses: on the virtual plate, up to 500 Hz, -27 dB at 0.1 mm and -18 dB at 0.3 mm.
PER_MM = 0.6


@dataclass(frozen=True, slots=True)
class Row:
    """One measurement of a position.

    spectrum, complex128 (actuators, bins): Green's functions in the band of the sweep, as of `in_band`.
    snr_db, float32 (actuators,): Signal-to-noise ratios, NaN where unknown.
    moved_mm: How far beside the position; NaN where unknown.
    """

    spectrum: NDArray[np.complex128]
    snr_db: NDArray[np.float32]
    moved_mm: float = 0.0


@dataclass(frozen=True, slots=True)
class Difference:
    """How two measurements of a position differ.

    actuators: Whose Green's functions differ by more than they may, the farthest beyond first; none where the two
        agree.
    level_db: Energy of the first of them now over then, in dB.
    relative: Norm of its difference over that of the louder one.
    """

    actuators: tuple[int, ...]
    level_db: float = 0.0
    relative: float = 0.0

    def __bool__(self) -> bool:
        return bool(self.actuators)

    def __str__(self) -> str:
        return (
            f"actuator {self.actuators[0]}'s response differs by {100 * self.relative:.1f} %, "
            f"{self.level_db:+.2f} dB" + (f", and {len(self.actuators) - 1} more" if len(self.actuators) > 1 else "")
        )


def in_band(green: NDArray[np.floating], sample_rate_hz: float, band_hz: tuple[float, float]) -> NDArray[np.complex128]:
    """Spectra of Green's functions in the band of the sweep: outside of it, and at its edges, noise is magnified.

    green, (actuators, taps): Green's functions.
    band_hz: Lowest and highest frequency of the sweep in Hz.
    """
    hertz = np.fft.rfftfreq(green.shape[1], 1 / sample_rate_hz)
    inside = (hertz >= band_hz[0]) & (hertz <= band_hz[1])
    return np.asarray(np.fft.rfft(green.astype(np.float64), axis=1)[:, inside])


def difference(then: Row, now: Row) -> Difference:
    """Compare two measurements of a position, actuator by actuator.

    Each may differ by 2 %, or by `OVER_NOISE` times what the noise of both explains of it. Noise is spread over all
    of a Green's function, and little of it is in its level, so that the level is also compared by itself.

    then, now: Of one position.
    """
    first, second = then.spectrum, now.spectrum
    energies = np.sum(np.abs(first) ** 2, axis=1), np.sum(np.abs(second) ** 2, axis=1)
    louder = np.maximum(*energies)
    tiny = np.finfo(np.float64).tiny
    relative = np.sqrt(np.sum(np.abs(second - first) ** 2, axis=1) / np.maximum(louder, tiny))
    noise = np.sqrt(_noise_share(then.snr_db) + _noise_share(now.snr_db))
    allowed = SAME + PER_MM * float(np.nansum([then.moved_mm, now.moved_mm]))
    shape = relative / np.maximum(allowed, noise * (1 + OVER_NOISE / np.sqrt(first.shape[1])))
    # What is common to both, so that noise neither adds to it nor hides a change.
    common = np.sum((first.conj() * second).real, axis=1)
    ratio = (common / np.maximum(energies[0], tiny), common / np.maximum(energies[1], tiny))
    level = np.minimum(np.abs(ratio[0] - 1), np.abs(ratio[1] - 1))
    gain = level / np.maximum(allowed, noise**2 + OVER_NOISE * noise / np.sqrt(4 * first.shape[1]))
    beyond = np.maximum(shape, gain)
    which = np.argsort(-beyond, kind="stable")
    which = which[beyond[which] > 1.0]
    if not which.size:
        return Difference(())
    worst = int(which[0])
    level_db = 10 * np.log10(max(energies[1][worst], tiny) / max(energies[0][worst], tiny))
    return Difference(tuple(which.tolist()), float(level_db), float(relative[worst]))


def _noise_share(snr_db: NDArray[np.float32]) -> NDArray[np.float64]:
    """Energy of the noise in a Green's function over its own, at most."""
    finite_db = np.nan_to_num(snr_db.astype(np.float64), nan=0.0)
    return np.asarray(np.minimum(10.0 ** (-0.1 * finite_db), 1.0))
