"""What lies in the folder of a verification, by name, and the format of its record."""

DRIVE_NAME = "drive.h5"
PREDICTION_NAME = "prediction.h5"
SCAN_NAME = "scan.h5"
FIELD_NAMES = (DRIVE_NAME, PREDICTION_NAME, SCAN_NAME)
REPORT_NAME = "report.html"
PICTURE_NAMES = tuple(
    f"{name}.png"
    for name in ("path", "snapshots", "waveforms", "positions", "snr", "error", "gain", "drive", "drift", "waves")
)
RECORD_NAME = "verify.json"
"""What was found, for programs: a JSON object of this format and version."""
FORMAT = "wavefocus-verification"
VERSION = 1
LOG_NAME = "verify.events.jsonl"
"""How far it is, while it works."""
STOP_NAME = "verify.stop"
"""Laid by whoever wants it to end: outputs muted, mirror parked."""
