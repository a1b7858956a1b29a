"""Randomness that depends on the seed and the take, and on nothing that happened before."""

from __future__ import annotations

import hashlib
import struct
from functools import cache

import numpy as np
import scipy
from numpy.typing import NDArray

from drivers.protocols import Take

Float32Array = NDArray[np.float32]

LATENCY, NOISE, DROPOUT, GROWING = range(4)  # what is drawn for a take, each from a stream of its own
EVERY_RECORD = 0xFFFF_FFFF  # in place of a record: one stream for the whole attempt


# A normal distribution as 65,536 equally likely values (the middle quantiles, unit variance). Drawing
# from it is six times faster than a ziggurat, and after a 16-bit converter no test can distinguish them.
@cache
def normal_values() -> Float32Array:
    """The values, in their order."""
    quantiles = scipy.special.ndtri((np.arange(65_536) + 0.5) / 65_536)
    return np.asarray((quantiles / quantiles.std()).astype(np.float32))


def take_generator(seed: int, take: Take, stream: int, *, whole_attempt: bool = False) -> np.random.Generator:
    """The generator of one stream of one take.

    seed: Seed of the rig, >= 0.
    take: The measurement.
    stream: ``LATENCY``, ``NOISE``, ``DROPOUT`` or ``GROWING``.
    whole_attempt: One stream for all records of the attempt.
    """
    record = EVERY_RECORD if whole_attempt else take.record
    return np.random.Generator(np.random.SFC64(_digest(seed, take, record, stream, 16)))


def take_share(seed: int, take: Take) -> float:
    """A number from 0 to below 1, drawn once for the take: how late its player starts.

    seed: Seed of the rig, >= 0.
    take: The measurement.
    """
    return (_digest(seed, take, take.record, LATENCY, 8) >> 11) / 2**53


def _digest(seed: int, take: Take, record: int, stream: int, size: int) -> int:
    """A hash of everything a stream depends on."""
    words = struct.pack("<qqqqq", take.position, take.attempt, record, stream, seed)
    digest = hashlib.blake2b(words + take.purpose.encode(), digest_size=size).digest()
    return int.from_bytes(digest, "little")


def normal(generator: np.random.Generator, samples: int) -> Float32Array:
    """Normally distributed samples of variance 1.

    samples: How many, >= 0.
    """
    words = np.asarray(generator.bit_generator.random_raw(-(-samples // 4)), dtype="<u8")
    # No index can be out of bounds, and numpy's check for it would cost as much as the rest.
    return normal_values().take(words.view("<u2")[:samples], mode="wrap")
