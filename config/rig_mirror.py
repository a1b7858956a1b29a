"""The scanning mirror of a rig file, and the map from the surface to its angles."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, ClassVar

import numpy as np
from pydantic import Field, model_validator

from config.drivers import DriverTable, with_drivers
from config.fields import Finite, NonNegative, Positive, Text, Whole, mistake
from drivers.registry import MIRRORS

DEFAULT_DISTANCE_MM = 1000.0
Row = tuple[Finite, Finite, Finite]
Matrix = tuple[Row, Row, Row]


class MirrorSection(DriverTable):
    """The scanning mirror and the map from the surface to its angles."""

    shared_keys: ClassVar[Mapping[str, str]] = {
        "port": 'it, such as "/dev/ttyUSB0", "COM3", "socket://10.0.0.7:4001" or "serial-number:ABC123"',
        "baud": "",
        "identity": "",
    }

    port: Text | None = None
    baud: Annotated[Whole, Field(ge=300, le=10_000_000)] | None = None
    identity: Text | None = None
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

    @model_validator(mode="after")
    def _possible(self) -> MirrorSection:
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


if not TYPE_CHECKING:
    MirrorSection = with_drivers(MirrorSection, MIRRORS.all())


def check_port(key: str, port: str) -> None:
    """Refuse a serial port that is written like a network port or a serial number, but is none.

    Raises PydanticCustomError: A mistake that names the key.
    """
    for beginning, pattern, allowed in (
        ("socket:", r"socket://[^\s/:]+:\d{1,5}", "must be socket://HOST:PORT"),
        ("serial-number:", r"serial-number:\S+", "must be serial-number: and the number itself"),
    ):
        if port.lower().startswith(beginning) and not re.fullmatch(pattern, port):
            raise mistake(key, port, allowed)
