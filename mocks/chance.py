"""Randomness that depends on the seed and the take, and on nothing that happened before."""

from __future__ import annotations

import zlib

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from drivers.protocols import Take

Float32Array = NDArray[np.float32]

LATENCY, NOISE, DROPOUT = range(3)  # streams of one take
EVERY_RECORD = 0xFFFF_FFFF  # in place of a record: one stream for the whole attempt

# A normal distribution as 65,536 equally likely values (the middle quantiles, unit variance). Drawing
# from it is six times faster than a ziggurat, and after a 16-bit converter no test can tell them apart.
_QUANTILES = ndtri((np.arange(65_536) + 0.5) / 65_536)
NORMAL_VALUES: Float32Array = (_QUANTILES / _QUANTILES.std()).astype(np.float32)


def take_generator(seed: int, take: Take, stream: int, *, whole_attempt: bool = False) -> np.random.Generator:
    """The generator of one stream of one take.

    Parameters
    ----------
    seed : int
        Seed of the rig, >= 0.
    take : Take
        The measurement.
    stream : int
        ``LATENCY``, ``NOISE`` or ``DROPOUT``.
    whole_attempt : bool
        One stream for all records of the attempt.
    """
    words = (
        take.position & 0xFFFF_FFFF,
        take.attempt & 0xFFFF_FFFF,
        EVERY_RECORD if whole_attempt else take.record & 0xFFFF_FFFF,
        zlib.crc32(take.purpose.encode()),
        stream,
        seed,
    )
    return np.random.Generator(np.random.SFC64(np.random.SeedSequence(words)))


def normal(generator: np.random.Generator, samples: int) -> Float32Array:
    """Normally distributed samples of variance 1.

    Parameters
    ----------
    generator : numpy Generator
        Where they come from.
    samples : int
        How many, >= 0.
    """
    words = np.asarray(generator.bit_generator.random_raw(-(-samples // 4)), dtype="<u8")
    return NORMAL_VALUES.take(words.view("<u2")[:samples])
