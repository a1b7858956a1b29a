"""The doctor's check of a shutter."""

from collections.abc import Iterator

from wavefocus.config.messages.rig_checks import Act, Finding
from wavefocus.config.rig import RigConfig
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.timeouts import in_time
from wavefocus.rig.instruments import open_shutter

CALL_S = 10.0


def shutter_findings(rig: RigConfig) -> Iterator[Finding]:
    """Close, open and close the shutter while the mirror is parked; nothing where the rig has none."""
    section = rig.shutter
    if section is None:
        return
    try:
        shutter = in_time("shutter", "opening", lambda: open_shutter(section), CALL_S)
        try:
            for operation, act in (
                ("closing", shutter.block_beam),
                ("opening", shutter.open_beam),
                ("closing", shutter.block_beam),
            ):
                in_time("shutter", operation, act, CALL_S)
            name = shutter.identify()
        finally:
            in_time("shutter", "releasing", shutter.close, CALL_S)
    except InstrumentError as failure:
        what = f"{failure.operation}: {failure.cause}; nothing is measured without it"
        yield Finding("shutter", "open and close", "fail", what, failure.remedy, Act("edit-rig", "shutter"))
        return
    yield Finding("shutter", "open and close", "ok", f"{name}; closed now")
