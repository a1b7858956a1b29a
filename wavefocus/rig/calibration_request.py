"""What a person asks of a calibration, and whether the rig can do it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from acquisition.calibrate.actuators import listening_places
from acquisition.calibrate.mirror import Pair, fitted_marks, read_fiducials
from calibration.rig.mirror_fit import LEAST_MARKS
from calibration.rig.mirror_map import MirrorMap
from config.calibration import PARTS
from config.rig import RigConfig
from config.stadium import default_marks_mm, inside_stadium
from storage.errors import InputError
from wavefocus.rig.limits import safe_amplitude_v

# The listening distance, as a share of the surface's width.
DISTANCE_SHARE = 0.2


@dataclass(frozen=True, slots=True)
class Request:
    """What a person asks for; None leaves the choice.

    Parameters
    ----------
    parts : tuple of str
        Which of `PARTS`.
    fiducials : Path, optional
        File of marks.
    limit_mm : float
        Largest residual of the mirror map, > 0.
    summing_box : bool
        All outputs for actuators are in one box.
    box_gain : float, optional
        The box's gain, where it is known, > 0.
    amplitude_v : float, optional
        Peak of what is played.
    distance_mm : float, optional
        Distance from each actuator at which it is listened to, > 0.
    sample_rate_hz : float
        Rate of the records, > 0.
    """

    parts: tuple[str, ...] = PARTS
    fiducials: Path | None = None
    limit_mm: float = 1.0
    summing_box: bool = False
    box_gain: float | None = None
    amplitude_v: float | None = None
    distance_mm: float | None = None
    sample_rate_hz: float = 10_000.0


LEAST_V = 1e-6
"""No converter puts out less."""


def amplitude_v(rig: RigConfig, request: Request) -> float:
    """Peak of what is played: asked for within the limits, or well below them.

    Raises InputError: more than the rig may put out, or next to nothing.
    """
    largest_v = rig.player.largest_v
    if request.amplitude_v is None:
        return safe_amplitude_v(rig)
    if 0 < request.amplitude_v < LEAST_V:
        raise InputError(f"--amplitude-v {request.amplitude_v:g}: must be {LEAST_V:g} V or more")
    if not 0 < request.amplitude_v <= largest_v:
        raise InputError(
            f"--amplitude-v {request.amplitude_v:g}: must be above 0 and at most {largest_v:g} (the rig's "
            "player.limit_v, or the full scale of its weakest output)"
        )
    return request.amplitude_v


def marks(rig: RigConfig, request: Request) -> tuple[tuple[Pair, ...], tuple[Pair, ...] | None]:
    """Places of the marks in millimetres, and their angles in milliradians where they are known already.

    Raises InputError: A file that cannot be understood, or marks that no map can be fitted through.
    """
    angles: tuple[Pair, ...] | None = None
    if request.fiducials is None:
        places = default_marks_mm(rig.surface.length_mm, rig.surface.width_mm)
    else:
        places, angles = read_fiducials(request.fiducials)
    if "mirror" in request.parts:
        # Better told now than when the last mark is met: the first guess stands in for angles not known yet.
        if angles is None:
            guessed = np.column_stack(MirrorMap(rig.mirror.matrix).angles_mrad(*np.array(places).T)).tolist()
        else:
            guessed = list(angles)
        fitted_marks(places, guessed)
        if len(places) == LEAST_MARKS:
            raise InputError(
                f"{request.fiducials}: {LEAST_MARKS} marks decide the map alone, so that nothing shows a mark that is "
                f"wrong; at least {LEAST_MARKS + 1} are needed"
            )
    return places, angles


def listening(rig: RigConfig, request: Request) -> tuple[float, NDArray[np.float64]]:
    """How far from each actuator it is listened to, and where.

    Raises InputError: A place beside the surface.
    """
    distance_mm = request.distance_mm or DISTANCE_SHARE * rig.surface.width_mm
    places = listening_places(rig.actuator_mm, distance_mm)
    there = inside_stadium(places, rig.surface.length_mm, rig.surface.width_mm)
    if "actuators" in request.parts and not there.all():
        raise InputError(f"--distance-mm {distance_mm:g}: leaves the surface at actuator {there.argmin()}")
    return distance_mm, places
