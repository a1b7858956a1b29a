"""The scanning mirror of a rig file, and the map from the surface to its angles."""

from __future__ import annotations

import math
import re
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, model_validator

from config.fields import (
    Finite,
    NonNegative,
    Positive,
    Table,
    Text,
    Whole,
    check_driver_keys,
    like,
    mistake,
    with_driver_defaults,
)

MirrorDriver = Literal["virtual", "asi-tiger", "mirrorcle-mti", "generic", "optotune-mre2"]

SERIAL_MIRRORS = ("asi-tiger", "mirrorcle-mti", "generic", "optotune-mre2")
DRIVERS_OF = {
    "port": SERIAL_MIRRORS,
    "baud": SERIAL_MIRRORS,
    "identity": SERIAL_MIRRORS,
    "full_scale_mrad": ("mirrorcle-mti",),
    "axes": ("asi-tiger",),
    "beam_per_mirror": ("asi-tiger",),
    "tolerance_mrad": ("asi-tiger", "generic"),
    "setup": ("mirrorcle-mti",),
}
NEEDED = {
    "port": 'it, such as "/dev/ttyUSB0", "COM3", "socket://10.0.0.7:4001" or "serial-number:ABC123"',
    "full_scale_mrad": "the optical angle at full scale in mrad: its commands have no unit",
}
# What the drivers take where they are told nothing.
DEFAULTS: dict[str, dict[str, object]] = {
    # Micro-mirrors of its scanner cards turn by 4.6 degrees to either side, the beam by 160.6 mrad.
    "asi-tiger": {
        "beam_per_mirror": 2.0,
        "tolerance_mrad": 0.5,
        "limit_mrad": 155.0,
        "park_mrad": (-150.0, -150.0),
    },
    "generic": {"tolerance_mrad": 0.5},
}
DEFAULT_DISTANCE_MM = 1000.0
Axis = Annotated[Text, like(r"[A-Za-z]", "must be the letter of an axis")]
Row = tuple[Finite, Finite, Finite]
Matrix = tuple[Row, Row, Row]


class MirrorSection(Table):
    """The scanning mirror and the map from the surface to its angles."""

    driver: MirrorDriver = "virtual"
    port: Text | None = None
    baud: Annotated[Whole, Field(ge=300, le=10_000_000)] | None = None
    identity: Text | None = None
    full_scale_mrad: Annotated[Positive, Field(lt=1000 * math.pi / 2)] | None = None
    axes: tuple[Axis, Axis] | None = None
    beam_per_mirror: Positive | None = None
    tolerance_mrad: Positive | None = None
    setup: tuple[Text, ...] | None = None
    distance_mm: Positive = DEFAULT_DISTANCE_MM
    map: Matrix | None = None
    settle_s: NonNegative = 0.005
    limit_mrad: Annotated[Positive, Field(lt=1000 * math.pi / 2)] = 250.0
    park_mrad: tuple[Finite, Finite] = (-240.0, -240.0)

    @property
    def matrix(self) -> Matrix:
        """The projective map H of ``(tan x, tan y, 1) ~ H (x_mm, y_mm, 1)``."""
        if self.map is not None:
            return self.map
        return ((1 / self.distance_mm, 0.0, 0.0), (0.0, 1 / self.distance_mm, 0.0), (0.0, 0.0, 1.0))

    @model_validator(mode="before")
    @classmethod
    def _driver_defaults(cls, data: Any) -> Any:
        return with_driver_defaults(data, "virtual", DEFAULTS)

    @model_validator(mode="after")
    def _possible(self) -> MirrorSection:
        check_driver_keys(self, DRIVERS_OF, NEEDED)
        if self.port is not None:
            check_port("port", self.port)
        if self.map is not None:
            if self.distance_mm != DEFAULT_DISTANCE_MM:
                raise mistake("distance_mm", self.distance_mm, "must be left out where map is given")
            rows = np.array(self.map)
            scale = np.linalg.norm(rows, axis=1)
            if not scale.all() or abs(np.linalg.det(rows / scale[:, np.newaxis])) < 1e-12:
                raise mistake("map", self.map, "must be a matrix that can be inverted")
        if max(map(abs, self.park_mrad)) > self.limit_mrad:
            raise mistake("park_mrad", self.park_mrad, f"must be within limit_mrad = {self.limit_mrad:g}")
        return self


def check_port(key: str, port: str) -> None:
    """Refuse a serial port that is written like a network port or a serial number, but is none.

    Raises
    ------
    PydanticCustomError
        A mistake that names the key.
    """
    for beginning, pattern, allowed in (
        ("socket:", r"socket://[^\s/:]+:\d{1,5}", "must be socket://HOST:PORT"),
        ("serial-number:", r"serial-number:\S+", "must be serial-number: and the number itself"),
    ):
        if port.lower().startswith(beginning) and not re.fullmatch(pattern, port):
            raise mistake(key, port, allowed)
