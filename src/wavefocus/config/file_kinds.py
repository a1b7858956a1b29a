"""Which kind of file somebody has named: a rig file where a run file is needed, a bank where a scene is."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from wavefocus.storage.text_file import open_regular

_OWN_TABLES = {
    "rig": {"surface", "actuators", "mirror", "recorder", "player", "vibrometer", "recovery", "watch", "messages",
            "usb", "emulation"},
    "run": {"grid", "sweep", "capture", "quality", "drift", "tolerance", "settled"},
    "scene": {"scene", "source", "quiet"},
    "trials": {"trials", "stimuli", "adaptive", "masking"},
}  # fmt: skip
"""Tables that only one kind of TOML file has."""
_MODELS = {"RigConfig": "rig", "RunConfig": "run", "SceneConfig": "scene", "TrialsConfig": "trials",
           "CalibrationRecord": "calibration"}  # fmt: skip
_HDF5 = {
    "wavefocus-bank": "bank", "wavefocus-raw": "file of raw recordings", "wavefocus-drive": "drive file",
    "wavefocus-field": "field file",
}  # fmt: skip
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"


def kind_of_tables(data: Mapping[str, Any]) -> str:
    """Kind of a TOML file by its tables: ``"rig"``, ``"run"``, ``"scene"``, ``"trials"`` or ``"calibration"``.

    Empty where it may be any, or is of none of them.
    """
    if "format" in data:  # only calibration files have it, whatever it says
        return "calibration" if data["format"] == "wavefocus-calibration" else ""
    shared = {kind: len(tables & data.keys()) for kind, tables in _OWN_TABLES.items()}
    shared["rig"] += isinstance(data.get("rig"), Mapping)  # a run file has the name of a rig file there
    most = max(shared.values())
    kinds = [kind for kind, count in shared.items() if count == most]
    return kinds[0] if most and len(kinds) == 1 else ""


def other_kind(model: str, data: object) -> str:
    """What is wrong where tables are of another kind of file than a model's, as a sentence; empty where they are not.

    model: Name of the model's class.
    """
    wanted = _MODELS.get(model, "")
    found = kind_of_tables(data) if isinstance(data, Mapping) else ""
    return f"this is a {found} file; a {wanted} file is needed" if wanted and found and found != wanted else ""


def hdf5_kind(path: Path) -> str:
    """Kind of an HDF5 file in words, as ``"bank"``; empty where a file is not HDF5 or cannot be read."""
    try:
        with open_regular(path) as file:
            if file.read(len(_HDF5_SIGNATURE)) != _HDF5_SIGNATURE:
                return ""
    except (OSError, ValueError):
        return ""
    from wavefocus.storage import hdf5_reading  # with it comes h5py, which most files do not need
    from wavefocus.storage.errors import InputError

    try:
        with hdf5_reading.opened(path) as content:
            if "green" in content:
                return "bank"
            return _HDF5.get(hdf5_reading.text(content, "format") or "", "HDF5 file")
    except InputError:
        return "HDF5 file"
