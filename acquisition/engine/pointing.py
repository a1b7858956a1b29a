"""Pointing the laser at a place on the surface."""

from __future__ import annotations

from acquisition.engine.roles import asking
from acquisition.engine.setup import Setup


def start_move(setup: Setup, x_mm: float, y_mm: float) -> None:
    """Let the mirror set out for a place, and return at once.

    Raises
    ------
    InstrumentError
        Of the mirror.
    """
    x_mrad, y_mrad = setup.mirror_map.angles_mrad(x_mm, y_mm)
    with asking("mirror"):
        setup.instruments.mirror.move_to(float(x_mrad), float(y_mrad))


def point_at(setup: Setup, x_mm: float, y_mm: float) -> None:
    """Point at a place and wait until the beam stands; where the move is under way already, this only waits.

    Raises
    ------
    InstrumentError
        Of the mirror.
    """
    start_move(setup, x_mm, y_mm)
    with asking("mirror"):
        setup.instruments.mirror.wait_settled(setup.settle_timeout_s)
