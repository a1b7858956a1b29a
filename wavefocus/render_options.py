"""How a scene is rendered, as the command line has it, and which of its options go together."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from calibration.errors import InputError

Focusing = Literal["time-reversal", "inverse"]


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """How a scene is rendered, as asked for on the command line.

    Parameters
    ----------
    method : {"sampled", "exact"}, optional
        Eq. (16) or (9).
    tolerance_db : float, optional
        What may be left out, < 0.
    interpolation_tolerance : float, optional
        Largest relative error between the bank's positions, > 0.
    focusing : {"time-reversal", "inverse"}
        How waves are made to meet.
    regularisation_db : float, optional
        Of the inverse filter, < 0.

    Raises
    ------
    InputError
        An option of the one way of focusing is given for the other.
    """

    method: Literal["sampled", "exact"] | None = None
    tolerance_db: float | None = None
    interpolation_tolerance: float | None = None
    focusing: Focusing = "time-reversal"
    regularisation_db: float | None = None

    def __post_init__(self) -> None:
        if self.focusing == "inverse":
            given = {
                "--method": self.method,
                "--tolerance-db": self.tolerance_db,
                "--interpolation-tolerance": self.interpolation_tolerance,
            }
            if wrong := [key for key, value in given.items() if value is not None]:
                raise InputError(f"{wrong[0]} is for time reversal; leave it out with --focusing inverse")
        elif self.regularisation_db is not None:
            raise InputError("--regularisation-db is for the inverse filter; add --focusing inverse")
