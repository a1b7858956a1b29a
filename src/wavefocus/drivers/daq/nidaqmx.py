"""The recorder driver ``nidaqmx``: its keys, and which of two ways leads to the device."""

from dataclasses import dataclass
from typing import Any, Literal

from wavefocus.drivers.protocols import Recorder
from wavefocus.drivers.registry import RECORDERS, KeyMistakeError, rig_key

ANALOG_INPUT = (r"ai\d{1,3}", 'must be "ai0", "ai1" and so on')


@RECORDERS.register
@dataclass(frozen=True, kw_only=True)
class NiDaqmx:
    """NI-DAQmx on this computer, or behind NI's gRPC Device Server on another."""

    device: str = rig_key('the name that NI MAX shows, such as "Dev1"', in_plan="free")
    address: str | None = rig_key(
        "HOST:PORT of NI's gRPC Device Server, if the box is behind one", default=None, in_plan="free"
    )
    tls_root: str | None = rig_key("PEM file that has signed the server's certificate", default=None, in_plan="free")
    tls_certificate: str | None = rig_key("PEM file of this client, for mutual TLS", default=None, in_plan="free")
    tls_key: str | None = rig_key("PEM file of this client's key, for mutual TLS", default=None, in_plan="free")
    reference_input: str = rig_key("Input of the loopback", default="ai0", in_plan="always", pattern=ANALOG_INPUT)
    response_input: str = rig_key("Input of the vibrometer", default="ai1", in_plan="always", pattern=ANALOG_INPUT)
    terminal: Literal["differential", "rse", "nrse", "pseudodifferential"] = rig_key(
        "How the inputs are wired", default="differential", in_plan="always"
    )
    trigger: str | None = rig_key("Digital input whose rising edge starts a record", default=None, in_plan="free")

    name = "nidaqmx"

    def __post_init__(self) -> None:
        if self.reference_input == self.response_input:
            raise KeyMistakeError("response_input", self.response_input, "is already the reference_input")
        if self.address is not None:
            host, _, port = self.address.rpartition(":")
            if not (host and port.isdecimal() and int(port) < 65536):
                raise KeyMistakeError("address", self.address, "must be HOST:PORT of a gRPC Device Server")
        if self.tls_root is not None and self.address is None:
            raise KeyMistakeError("tls_root", self.tls_root, "must be left out, or an address given")
        for key, other in (("tls_certificate", "tls_key"), ("tls_key", "tls_certificate")):
            value = getattr(self, key)
            if value is not None and (self.tls_root is None or getattr(self, other) is None):
                raise KeyMistakeError(key, value, f"needs tls_root and {other}")

    def open(self, *, shared: bool = False, task_name: str = "") -> Recorder:
        """Open the device: in a process of its own, unless a server has it.

        shared: Another instrument of the rig uses its outputs: it is never reset.
        task_name: See `wavefocus.drivers.daq.ni.ni_recorder.NiRecorder`; only for a server.
        """
        wiring: dict[str, Any] = {
            "reference_input": self.reference_input,
            "response_input": self.response_input,
            "terminal": self.terminal,
            "trigger": self.trigger or None,
            "resets": not shared,
        }
        if self.address is None:
            from wavefocus.drivers.daq.ni.ni_process import ProcessRecorder

            return ProcessRecorder(self.device, **wiring)
        from wavefocus.drivers.daq.ni.ni_recorder import NiRecorder

        tls = None if self.tls_root is None else (self.tls_root, self.tls_certificate, self.tls_key)
        return NiRecorder(self.device, address=self.address, tls=tls, task_name=task_name, **wiring)
