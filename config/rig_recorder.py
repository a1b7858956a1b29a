"""The two-channel recorder of a rig file, and the vibrometer before it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from pydantic import Field, model_validator

from config.drivers import DriverTable, with_drivers
from config.fields import Finite, NonNegative, Positive, Text, Whole, like
from config.rig_mirror import check_port
from drivers.daq.nidaqmx import ANALOG_INPUT
from drivers.registry import RECORDERS, VIBROMETERS

AnalogInput = Annotated[Text, like(*ANALOG_INPUT)]


class RecorderSection(DriverTable):
    """The two-channel DAQ: reference (loopback) and response (vibrometer)."""

    reference_range_v: Positive = 10.0
    response_range_v: Positive = 10.0
    response_ranges_v: tuple[Positive, ...] | None = None
    reference_gain: Positive = 1.0
    inter_channel_delay_s: Annotated[Finite, Field(ge=-0.001, le=0.001)] = 5e-6
    pre_roll_s: Annotated[NonNegative, Field(le=10)] = 0.02
    post_roll_s: Annotated[NonNegative, Field(le=10)] = 0.1

    @model_validator(mode="before")
    @classmethod
    def _no_trigger(cls, data: Any) -> Any:
        """An empty trigger is none, said outright."""
        return {**data, "trigger": None} if isinstance(data, dict) and data.get("trigger") == "" else data


class VibrometerSection(DriverTable):
    """The laser vibrometer's calibration: typed in, or read from the device."""

    shared_keys: ClassVar[Mapping[str, str]] = {
        "port": 'the serial port of its controller, such as "COM4"',
        "baud": "",
        "identity": "",
    }

    driver: str = "fixed"
    port: Text | None = None
    baud: Annotated[Whole, Field(ge=300, le=10_000_000)] | None = None
    identity: Text | None = None
    sensitivity_m_s_per_v: Positive | None = None
    latency_s: Annotated[NonNegative, Field(le=0.001)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _fixed(cls, data: Any) -> Any:
        fixed = isinstance(data, dict) and data.get("driver", "fixed") == "fixed"
        return {"sensitivity_m_s_per_v": 0.125, **data} if fixed else data

    @model_validator(mode="after")
    def _possible(self) -> VibrometerSection:
        if self.port is not None:
            check_port("port", self.port)
        return self


if not TYPE_CHECKING:
    RecorderSection = with_drivers(RecorderSection, RECORDERS.all())
    VibrometerSection = with_drivers(VibrometerSection, VIBROMETERS.all())
