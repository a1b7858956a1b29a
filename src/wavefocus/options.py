"""Options of commands that a Python function takes as one object: what the command line is made from.

A field of such a class is an option. Its name, type and default are those of the field; its help, bounds and spelling
stand in `option`.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

CALIBRATION_PARTS = ("inputs", "outputs", "mirror", "actuators")
"""What a calibration is made of, in the order of measuring: each uses what those before it have found."""


def option(
    default: Any, help: str, name: str = "", *, low: float = -math.inf, high: float = math.inf, **settings: Any
) -> Any:
    """A field that is an option.

    name: Its spelling, where it is not the field's name. low, high: Bounds of a number.
    settings: `metavar`, and others of argparse's ``add_argument``.
    """
    return field(default=default, metadata={"help": help, "name": name, "low": low, "high": high, "settings": settings})


@dataclass(frozen=True, slots=True)
class SessionOptions:
    """Options of a session of a campaign."""

    rig_file: Path | None = option(
        None, "A corrected rig file: other ports, device names, limits or time-outs.", "--rig", metavar="RIG.toml"
    )
    as_json: bool = option(False, "Print one JSON line per event on standard output.", "--json")
    accept_drift: bool = option(False, "Go on although the sentinel position has changed.")
    accept_calibration: bool = option(False, "Go on with another calibration, or on other devices than its own.")


@dataclass(frozen=True, slots=True)
class RenderOptions:
    """Options of a render: method of eq. (16) or (9), what may be left out (< 0 dB), where it is computed."""

    method: Literal["sampled", "exact"] | None = option(
        None, "By default exact, or sampled where emission is per point."
    )
    tolerance_db: float | None = option(
        None, "Allow single precision within a proved bound, e.g. -60.", low=-1000.0, high=-1e-3
    )
    device: Literal["cpu", "cuda"] = option("cpu", "cuda: on a GPU, through CuPy.")


@dataclass(frozen=True, slots=True)
class MovieOptions:
    """What a movie shows; None for what follows from the field."""

    from_s: float | None = option(None, "Start in scene time.", low=-1e9, high=1e9)
    to_s: float | None = option(None, "End in scene time.", low=-1e9, high=1e9)
    slow: float | None = option(None, "Times slower than life; by default 240 frames.", low=1e-3, high=1e6)


@dataclass(frozen=True, slots=True)
class LiveOptions:
    """Settings of a live session.

    Without a scene independent sources are on places finer than the bank's, by kernel interpolation, where the bank
    allows it. Where `ahead_ms` is None it is doubled after each underrun.
    """

    scene: Path | None = option(
        None, "Its regularisation, output and first source's signal; by default noise of the bank's band.",
        metavar="SCENE.toml",
    )  # fmt: skip
    look_ahead_ms: float = option(
        50.0, "By how much sources lag their positions; what is not known by then is predicted.", low=0, high=2000
    )
    block_ms: float = option(5.0, "Time of a block; orders take effect with the next.", low=1, high=50)
    ahead_ms: float | None = option(
        None, "So much waits to be played; by default 40 ms, more where needed.", low=1, high=1000
    )
    gain_db: float = option(0.0, "Softer (negative) or louder; limits hold all the same.", low=-200, high=200)
    duration_s: float | None = option(None, "End by itself after so long.", low=0, high=1e6)
    record: Path | None = option(
        None, "Record the session as a scene that renders to its drives; if independent, to similar ones.",
        metavar="FOLDER",
    )  # fmt: skip
    independent: bool = option(False, "Each source is quiet where the others are.")


@dataclass(frozen=True, slots=True)
class CalibrationOptions:
    """What to calibrate, and with what; None leaves the choice."""

    parts: tuple[str, ...] = option(
        CALIBRATION_PARTS,
        f"Which: {', '.join(CALIBRATION_PARTS)}; commas between several.",
        "--only",
        metavar="PART,...",
    )
    fiducials: Path | None = option(
        None,
        "Marks, one a line under the header x_mm,y_mm: the operator jogs the beam to each; under"
        " x_mm,y_mm,x_mrad,y_mrad the mirror's angles are given, and nothing is jogged.",
        metavar="FILE.csv",
    )
    limit_mm: float = option(1.0, "Largest residual of the mirror map.", low=1e-6, high=1e6)
    summing_box: float | None = option(
        None,
        "All outputs for actuators are in one box of this gain, none is plugged singly; without the gain no full scale "
        "is measured.",
        metavar="GAIN",
        nargs="?",
        const=0.0,
        low=1e-6,
        high=1e6,
    )
    amplitude_v: float | None = option(None, "Peak of what is played; by default well below the limit.")


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """Facts that the user gives about a file, and choices; empty or None where there is none."""

    places: Path | None = option(
        None,
        "Table of places: x_mm,y_mm[,z_mm] (or _m) or azimuth_deg,elevation_deg,radius_m; role, file, channel,"
        " actuator, node.",
        metavar="FILE.csv",
    )
    unit: str = option("", "Unit of the values, as m/s/V, mm/s/V, g/N, Pa/V or 1.", metavar="RESPONSE/DRIVE")
    length_unit: Literal["", "m", "cm", "mm", "um", "in", "ft"] = option("", "Unit of places that have none.")
    band_hz: tuple[float, float] | None = option(None, "Frequencies to use, in Hz.", "--band", metavar="LOW,HIGH")
    taps: int | None = option(None, "Length of the Green's functions in samples.", low=1)
    sample_rate_hz: float | None = option(None, "Rate of the Green's functions.", low=1e-3, high=1e12)
    frequencies: tuple[float, float] | Path | None = option(
        None, "Frequencies of complex values, in Hz, where the file holds none.", metavar="FIRST,STEP|FILE"
    )
    direction: str = option("", "Response direction: x, y, z (uff), receiver (sofa) or index (arrays).", metavar="NAME")
    columns: str = option(
        "", "Coordinates that become x and y of the bank; by default the positions' own plane.", metavar="X,Y"
    )
    axes: str = option("", "Order of an array's axes: position, actuator, direction, sample.", metavar="A,B,C")
    names: Mapping[str, str] = field(
        default_factory=dict,
        metadata={
            "help": "A variable by its name in the file, as green=H; may be repeated.", "name": "", "low": 0,
            "high": 0, "settings": {"metavar": "OURS=THEIRS"},
        },
    )  # fmt: skip
    measurements: Literal["", "positions", "actuators", "pairs"] = option("", "For sofa: what its measurements count.")
    swap_roles: bool = option(
        False,
        "Positions are where it was driven, actuators where it was measured: reciprocity, as with a roving hammer.",
    )


@dataclass(frozen=True, slots=True)
class ExportOptions:
    """Choices of an export."""

    missing: Literal["leave-out", "nan"] = option("leave-out", "Positions that are not measured, failed or disabled.")
    binary: bool = option(False, "Whether universal files hold binary numbers.")
    publication: Path | None = option(
        None, "A run file, or another with a table [publication], in place of the bank's.", metavar="FILE.toml"
    )


def _as_lines() -> Any:
    return option(False, "Findings, or orders and events, as JSON lines, for a window or script.", "--lines")


@dataclass(frozen=True, slots=True)
class DoctorOptions:
    """What an examination of a rig does."""

    as_json: bool = option(False, "Print JSON on standard output.", "--json")
    play: bool = option(True, "Play nothing.", "--no-play")
    reset_usb: str = option("", "Reset that instrument's USB device first.", metavar="ROLE")
    test_message: bool = option(False, "Send a message to each address of the rig file.")
    as_lines: bool = _as_lines()
    record: Path | None = option(None, "Write every exchange with the instruments to a new file.", metavar="FILE.jsonl")


@dataclass(frozen=True, slots=True)
class TrialsOptions:
    """How a session of trials is carried out."""

    participant: str = option("", "Code of the participant; no name.", metavar="ID")
    only_prepare: bool = option(False, "Only prepare the stimuli.", "--prepare")
    as_lines: bool = _as_lines()
    fast: bool = option(False, "Let a virtual rig's seconds take no time, for programs that answer.")
    as_json: bool = option(False, "With --prepare: print JSON on standard output.", "--json")
