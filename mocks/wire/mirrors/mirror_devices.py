"""The mirror's far side by the name of its dialect."""

from __future__ import annotations

import math

from mocks.wire.mirrors.asi_tiger import AsiTigerDevice
from mocks.wire.mirrors.generic import GenericMirrorDevice
from mocks.wire.mirrors.mirrorcle import MirrorcleDevice
from mocks.wire.mirrors.motion import MirrorMotion
from mocks.wire.mirrors.optotune import OptotuneDevice
from mocks.wire.serial_far_side import SerialDevice


def mirror_device(dialect: str, motion: MirrorMotion, full_scale_mrad: float | None = None) -> SerialDevice:
    """A device that speaks a dialect of `drivers.mirror.serial_mirror`.

    Parameters
    ----------
    dialect : str
        ``"asi-tiger"``, ``"mirrorcle-mti"``, ``"generic"`` or ``"optotune-mre2"``.
    motion : MirrorMotion
        How its mirror moves. Of ``mirrorcle-mti`` and ``optotune-mre2``, which cannot be asked whether they move, the
        longest move must be shorter than the settling time that the near side is told.
    full_scale_mrad : float, optional
        Optical angle at full deflection; of ``mirrorcle-mti``, by default the limit, and of ``asi-tiger``, by default
        that of a micro-mirror card.

    Raises
    ------
    ValueError
        There is no such dialect.
    """
    if dialect == "asi-tiger":
        if full_scale_mrad is None:
            return AsiTigerDevice(motion)
        # Beyond what micro-mirrors turn by, it is a galvo.
        return AsiTigerDevice(motion, board="dac_4ch", limit_degrees=math.degrees(full_scale_mrad / 2000))
    if dialect == "mirrorcle-mti":
        return MirrorcleDevice(motion, full_scale_mrad or motion.limit_mrad)
    if dialect == "generic":
        return GenericMirrorDevice(motion)
    if dialect == "optotune-mre2":
        return OptotuneDevice(motion)
    raise ValueError(f"there is no mirror dialect {dialect!r}")
