"""Distortion as a cause: squares and cubes of drive or response, fitted to the difference of scan and prediction."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.rendering.arrays import Complex128Array
from wavefocus.rendering.verify.superposition import Block, energy


def fit_distortion(block: Block, powers: Complex128Array) -> tuple[Block, float]:
    """Take off a change of level, and squares and cubes, that fit the difference best.

    A nonlinear amplifier, coil or vibrometer adds ``a y**2 + b y**3`` to a signal y, within the band too, and makes
    the response at the drive's own frequencies louder or quieter.

    block: Scanned responses.
    powers, complex128 (2, rows, K): Responses to squares and cubes, in the block's units.

    Returns the block without the fit, and the distortion's share of the response (a ratio of amplitudes).
    """
    predicted = block.response - block.difference
    columns = np.stack([predicted.ravel(), *powers.reshape(2, -1)], axis=1)
    size = np.linalg.norm(columns, axis=0)
    columns = columns[:, size > 0.0] / size[size > 0.0]
    real = np.concatenate([columns.real, columns.imag])
    difference = block.difference.ravel()
    wanted = np.concatenate([difference.real, difference.imag])
    weights = np.linalg.lstsq(real, wanted, rcond=1e-6)[0]
    fitted = (columns @ weights).reshape(predicted.shape)
    # What a change of level cannot give.
    alike = float((fitted.conj() * predicted).sum().real) / max(energy(predicted), 1e-300)
    share = float(np.sqrt(energy(fitted - alike * predicted) / max(energy(block.response), 1e-300)))
    return block.with_response(block.response - fitted), share


def driven_powers(block: Block, drive_powers: Complex128Array) -> Complex128Array:
    """Responses (2, rows, K) to the squares and cubes of the drives, (2, actuators, K)."""
    return np.asarray(np.einsum("rak,pak->prk", block.green, drive_powers))


def response_powers(block: Block, predicted_powers: NDArray[np.complexfloating[Any, Any]]) -> Complex128Array:
    """Squares and cubes of the predicted responses, (2, rows, K), in the block's units."""
    return np.asarray(predicted_powers * block.weight[:, None])
