"""Faults on order, and the virtual device that meets them: which instrument fails, when, and how."""

import threading
from collections import Counter

from wavefocus.config.emulation import RigFault
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.protocols import DeviceIdentity, Instrument, RecordLabel


class _FaultPlan:
    """The faults that one instrument has before it.

    role: The instrument's role.
    device: Its name, for messages.
    faults: The plan of the whole rig.
    """

    def __init__(self, role: str, device: str, faults: tuple[RigFault, ...]) -> None:
        self._device = device
        self._faults = tuple(fault for fault in faults if fault.role == role)
        self._calls: Counter[str] = Counter()
        self._lost = False
        self._tries_left: int | None = None
        self._unplugged_before: set[RigFault] = set()
        self._hung_before: set[RigFault] = set()
        self._lock = threading.Lock()

    def meet(self, operation: str, doing: str, label: RecordLabel | None = None) -> tuple[RigFault, ...]:
        """Count a call, raise the fault that it meets, or return those that corrupt its record.

        An unplugged instrument is plugged in again by a ``reconnect`` after the fault's failing ones.

        Raises TransientInstrumentError or InstrumentLostError.

        operation: Name of the method.
        doing: What it does, for the message.
        label: What the call is for.
        """
        with self._lock:
            self._calls[operation] += 1
            due = tuple(
                fault
                for fault in self._faults
                if fault.operation == operation and _strikes(fault, self._calls[operation], label)
            )
            self._lost = self._lost or any(fault.kind == "lost" for fault in due)
            if self._lost or self._unplugged(operation, due):
                raise InstrumentLostError(
                    self._device, doing, "the device does not answer any more", "check its cable and its power"
                )
            hangs = self._hangs(due)
        if hangs:
            threading.Event().wait()
        for fault in due:
            if fault.kind in _EXPLANATIONS:
                cause, remedy = _EXPLANATIONS[fault.kind]
                raise TransientInstrumentError(self._device, doing, cause, remedy)
        return due

    def _hangs(self, due: tuple[RigFault, ...]) -> bool:
        """Whether this call never returns; a record that is tried again does."""
        first = [fault for fault in due if fault.kind == "hang" and (fault.at_call or fault not in self._hung_before)]
        self._hung_before.update(first)
        return bool(first)

    def _unplugged(self, operation: str, due: tuple[RigFault, ...]) -> bool:
        """Whether the instrument is unplugged at this call; a record that is tried again finds it plugged in."""
        for fault in due:
            if fault.kind == "unplugged" and fault not in self._unplugged_before:
                self._unplugged_before.add(fault)
                self._tries_left = fault.tries
        if operation == "reconnect" and self._tries_left is not None:
            self._tries_left = self._tries_left - 1 if self._tries_left > 0 else None
        return self._tries_left is not None


def _strikes(fault: RigFault, call: int, label: RecordLabel | None) -> bool:
    """Whether this call for this record fails."""
    if fault.at_call is not None:
        return fault.at_call <= call < fault.at_call + fault.count
    if label is None:
        return False
    first = 1 if fault.attempt is None else fault.attempt
    return (
        fault.position in (None, label.position)
        and fault.record in (None, label.record)
        and fault.purpose in (None, label.purpose)
        and first <= label.attempt < first + fault.count
    )


_EXPLANATIONS = {
    "timeout": ("no answer in time", "try again; if it stays, check the cable"),
    "underflow": ("the output ran dry (underflow)", "try again; if it stays, choose a larger buffer"),
    "short_read": ("only half of the samples arrived", "try again; if it stays, use another USB port"),
}


class VirtualDevice(Instrument):
    """A virtual instrument: name, faults, and whether it is open.

    role: ``"mirror"``, ``"recorder"`` or ``"player"``.
    faults: The plan of the whole rig.
    limits: Its limits, for people.
    """

    def __init__(self, role: str, faults: tuple[RigFault, ...], limits: str) -> None:
        self._name = f"virtual {role}"
        self._faults = _FaultPlan(role, self._name, faults)
        self._limits = limits
        self._closed = False

    @property
    def identity(self) -> DeviceIdentity:
        """Who it is: the same in every run."""
        return DeviceIdentity("wavefocus", self._name)

    def identify(self) -> str:
        """Name and limits of the device."""
        self._check_open("identifying")
        self._faults.meet("identify", "identifying")
        return f"{self._name}, {self._limits}"

    def reconnect(self) -> None:
        self._check_open("reconnecting")
        self._faults.meet("reconnect", "reconnecting")

    def close(self) -> None:
        self._closed = True

    def _check_open(self, doing: str) -> None:
        if self._closed:
            raise self._refusal(doing, "it is closed", "open the rig again")

    def _refusal(self, doing: str, cause: str, remedy: str) -> InstrumentError:
        return InstrumentError(self._name, doing, cause, remedy)
