"""The two-channel recorder of a rig file, and the vibrometer before it."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from config.fields import (
    Finite,
    NonNegative,
    Positive,
    Table,
    Text,
    Whole,
    check_driver_keys,
    like,
    mistake,
    with_driver_defaults,
)
from config.rig_mirror import check_port

RecorderDriver = Literal["virtual", "nidaqmx"]
Terminal = Literal["differential", "rse", "nrse", "pseudodifferential"]
AnalogInput = Annotated[Text, like(r"ai\d{1,3}", 'must be "ai0", "ai1" and so on')]

NIDAQMX = ("nidaqmx",)
DRIVERS_OF = {
    "device": NIDAQMX,
    "address": NIDAQMX,
    "tls_root": NIDAQMX,
    "tls_certificate": NIDAQMX,
    "tls_key": NIDAQMX,
    "reference_input": NIDAQMX,
    "response_input": NIDAQMX,
    "terminal": NIDAQMX,
    "trigger": NIDAQMX,
}
NEEDED = {"device": 'the name that NI MAX shows, such as "Dev1"'}
DEFAULTS = {
    "nidaqmx": {"reference_input": "ai0", "response_input": "ai1", "terminal": "differential"},
}
POLYTEC = ("polytec-ofv5000",)
DRIVERS_OF_VIBROMETER = {
    "port": POLYTEC,
    "baud": POLYTEC,
    "identity": POLYTEC,
    "decoder": POLYTEC,
    "least_signal_level": POLYTEC,
}
DEFAULTS_OF_VIBROMETER = {
    "fixed": {"sensitivity_m_s_per_v": 0.125},
    "polytec-ofv5000": {"decoder": 1, "least_signal_level": 0.0},
}


class RecorderSection(Table):
    """The two-channel DAQ: reference (loopback) and response (vibrometer)."""

    driver: RecorderDriver = "virtual"
    device: Text | None = None
    address: Text | None = None
    tls_root: Text | None = None
    tls_certificate: Text | None = None
    tls_key: Text | None = None
    reference_input: AnalogInput | None = None
    response_input: AnalogInput | None = None
    terminal: Terminal | None = None
    trigger: Text | None = None
    reference_range_v: Positive = 10.0
    response_range_v: Positive = 10.0
    response_ranges_v: tuple[Positive, ...] | None = None
    reference_gain: Positive = 1.0
    inter_channel_delay_s: Annotated[Finite, Field(ge=-0.001, le=0.001)] = 5e-6
    pre_roll_s: Annotated[NonNegative, Field(le=10)] = 0.02
    post_roll_s: Annotated[NonNegative, Field(le=10)] = 0.1

    @model_validator(mode="before")
    @classmethod
    def _driver_defaults(cls, data: Any) -> Any:
        if isinstance(data, dict) and data.get("trigger") == "":  # no trigger, said outright
            data = {**data, "trigger": None}
        return with_driver_defaults(data, "virtual", DEFAULTS)

    @model_validator(mode="after")
    def _possible(self) -> RecorderSection:
        check_driver_keys(self, DRIVERS_OF, NEEDED)
        if self.reference_input is not None and self.reference_input == self.response_input:
            raise mistake("response_input", self.response_input, "is already the reference_input")
        if self.address is not None:
            host, _, port = self.address.rpartition(":")
            if not (host and port.isdecimal() and int(port) < 65536):
                raise mistake("address", self.address, "must be HOST:PORT of a gRPC Device Server")
        if self.tls_root is not None and self.address is None:
            raise mistake("tls_root", self.tls_root, "must be left out, or an address given")
        for one, other in (("tls_certificate", "tls_key"), ("tls_key", "tls_certificate")):
            value = getattr(self, one)
            if value is not None and (self.tls_root is None or getattr(self, other) is None):
                raise mistake(one, value, f"needs tls_root and {other}")
        return self


class VibrometerSection(Table):
    """The laser vibrometer's calibration: typed in, or read from the device."""

    driver: Literal["fixed", "polytec-ofv5000"] = "fixed"
    port: Text | None = None
    baud: Annotated[Whole, Field(ge=300, le=10_000_000)] | None = None
    identity: Text | None = None
    decoder: Annotated[Whole, Field(ge=0, le=9)] | None = None
    least_signal_level: Annotated[NonNegative, Field(le=1)] | None = None
    sensitivity_m_s_per_v: Positive | None = None
    latency_s: Annotated[NonNegative, Field(le=0.001)] | None = None

    @model_validator(mode="before")
    @classmethod
    def _driver_defaults(cls, data: Any) -> Any:
        return with_driver_defaults(data, "fixed", DEFAULTS_OF_VIBROMETER)

    @model_validator(mode="after")
    def _possible(self) -> VibrometerSection:
        needed = {"port": 'the serial port of its controller, such as "COM4"'}
        check_driver_keys(self, DRIVERS_OF_VIBROMETER, needed)
        if self.port is not None:
            check_port("port", self.port)
        return self
