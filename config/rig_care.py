"""How a rig is looked after: its calibration, its way back from faults, its place on the USB."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field

from config.calibration_file import CalibrationRecord
from config.fields import NonNegative, Positive, Table, Text, Whole


class CalibrationSection(Table):
    """Which calibration file holds, and for how long it is trusted without a word."""

    file: Text | None = None
    stale_after_days: Positive = 90.0
    measured: CalibrationRecord | None = None
    """What the file holds; filled in on loading, so that a bank needs no other file."""


class RecoverySection(Table):
    """How long a lost instrument is waited for, and when a call to one counts as hung."""

    give_up_after_s: Annotated[NonNegative, Field(le=7 * 86_400)] = 600.0
    hung_after_s: Annotated[Positive, Field(le=3600)] = 20.0


class UsbDevice(Table):
    """A device that should be plugged in."""

    role: Literal["mirror", "recorder", "player", "vibrometer"]
    vendor_id: Annotated[Whole, Field(ge=0, le=0xFFFF)]
    product_id: Annotated[Whole, Field(ge=0, le=0xFFFF)]
    serial_number: Text | None = None
