"""How a scene is rendered, as the command line has it, and which of its options go together."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from storage.errors import InputError

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
    device : {"cpu", "cuda"}
        Where the drives are accumulated; on a GPU all is computed.

    Raises
    ------
    InputError
        An option of the one way of focusing is given for the other, or one that a GPU does not know.
    """

    method: Literal["sampled", "exact"] | None = None
    tolerance_db: float | None = None
    interpolation_tolerance: float | None = None
    focusing: Focusing = "time-reversal"
    regularisation_db: float | None = None
    device: Literal["cpu", "cuda"] = "cpu"

    def __post_init__(self) -> None:
        if self.device != "cpu" and (self.focusing == "inverse" or self.tolerance_db is not None):
            raise InputError(f"--device {self.device} goes neither with --focusing inverse nor with --tolerance-db")
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


def refuse_for_drives(what: Path, **given: object) -> None:
    """Refuse options of a scene where a drive file is to be played; `given` by their names.

    Raises
    ------
    InputError
        One of them is given, or the file is a scene.
    """
    if what.suffix.lower() == ".toml":
        raise InputError(f"{what}: a scene needs a bank to be rendered from; add --bank BANK.h5")
    wrong = [name for name, value in given.items() if value is not None]
    if wrong:
        raise InputError(f"--{wrong[0].replace('_', '-')} is for a scene; add --bank BANK.h5 and give a scene file")


def refuse_for_scenes(what: Path, *, loop: int) -> None:
    """Refuse what a scene that is rendered while it is played cannot do.

    Raises
    ------
    InputError
        It is to be repeated, or the file is a drive file.
    """
    if what.suffix.lower() == ".h5":
        raise InputError(f"{what}: a drive file is played as it is; leave out --bank, or give the scene file")
    if loop > 1:
        raise InputError("--loop is for drive files; render the scene to one, or let its path have more turns")
