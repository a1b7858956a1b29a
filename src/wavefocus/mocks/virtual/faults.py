"""Faults on order, and the virtual device that meets them: which instrument fails, when, and how."""

import threading
from collections import Counter
from dataclasses import dataclass

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError
from wavefocus.drivers.protocols import DeviceIdentity, Instrument, RecordLabel

_OPERATIONS = {
    "mirror": ("identify", "move_to", "wait_settled", "park", "reconnect"),
    "recorder": ("identify", "start", "read", "reconnect"),
    "player": ("identify", "play", "wait", "mute", "reconnect"),
}
ANYWHERE = ("timeout", "lost", "unplugged", "hang")
_RAISED = ("timeout", "underflow", "short_read")
CORRUPTING = (
    "missing_reference", "over_range", "dropout", "drift", "dark", "faint_reference",
    "clipped", "lost_sample", "hum", "dead_response",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class RigFault:
    """One entry of a fault plan: at the given call, or at the given record. Raises ValueError.

    role: ``"mirror"``, ``"recorder"`` or ``"player"``.
    operation: Method that fails, such as ``"read"``.
    kind: ``"timeout"`` (any), ``"lost"`` (any; it stays lost), ``"unplugged"`` (any but reconnect; once, and then gone
        until it is plugged in again), ``"hang"`` (any; the call never returns, for a record only the first),
        ``"underflow"`` (player wait), ``"short_read"``, ``"missing_reference"``, ``"over_range"``, ``"dropout"``,
        ``"drift"``, ``"dark"`` (no light comes back to the vibrometer in the whole record), ``"faint_reference"``,
        ``"clipped"`` (the response's peaks are cut off before the converter), ``"lost_sample"`` (one sample of the
        response is missing in the middle), ``"hum"`` (50 Hz on the response) or ``"dead_response"`` (the response
        channel is constant; recorder read).
    at_call: The first call of the method that fails, from 1; `count` calls fail in a row.
    position, record, attempt: The record that fails, where no call is given: this position (any, if absent), this
        record of each attempt (every, if absent), from this attempt on (1, if absent) for `count` attempts. A mirror
        has no records.
    purpose: Only records of this purpose; any, if absent.
    count: How often, > 0.
    level_db: What ``"drift"`` does to the response, and ``"faint_reference"`` to the reference; where ``"clipped"``
        cuts the response, in dB of its peak; the level of ``"hum"``, in dB of the response's rms.
    tries: How many times ``reconnect`` fails before one succeeds, where ``"unplugged"``, >= 0.
    spot_mm: Where ``"dark"`` is dark: x, y and radius in mm; everywhere, if absent.
    """

    role: str
    operation: str
    kind: str
    at_call: int | None = None
    position: int | None = None
    attempt: int | None = None
    record: int | None = None
    purpose: str | None = None
    count: int = 1
    level_db: float = -3.0
    tries: int = 1
    spot_mm: tuple[float, float, float] | None = None

    def __post_init__(self) -> None:
        if self.role not in _OPERATIONS:
            raise ValueError(f"fault role is {self.role!r}; allowed: {', '.join(_OPERATIONS)}")
        if self.operation not in _OPERATIONS[self.role]:
            allowed = ", ".join(_OPERATIONS[self.role])
            raise ValueError(f"fault operation of the {self.role} is {self.operation!r}; allowed: {allowed}")
        allowed_kinds = [kind for kind in ANYWHERE if (self.operation, kind) != ("reconnect", "unplugged")]
        if (self.role, self.operation) == ("player", "wait"):
            allowed_kinds.append("underflow")
        if (self.role, self.operation) == ("recorder", "read"):
            allowed_kinds += ["short_read", *CORRUPTING]
        if self.kind not in allowed_kinds:
            raise ValueError(
                f"fault kind of {self.role} {self.operation} is {self.kind!r}; allowed: {', '.join(allowed_kinds)}"
            )
        by_take = (self.position, self.attempt, self.record, self.purpose) != (None, None, None, None)
        if (self.at_call is not None) == by_take:
            raise ValueError("a fault needs either at_call or some of position, attempt, record and purpose")
        if by_take and self.role == "mirror":
            raise ValueError("a fault of the mirror needs at_call, for a mirror has no records")
        if self.count < 1 or (self.at_call is not None and self.at_call < 1):
            raise ValueError(f"fault at_call is {self.at_call}, count {self.count}; both start at 1")
        if self.kind == "unplugged" and (self.count != 1 or self.tries < 0):
            raise ValueError(
                f"fault count is {self.count}, tries {self.tries}; an instrument is unplugged once, count 1, and "
                "takes 0 or more tries to come back"
            )

    def strikes(self, call: int, label: RecordLabel | None) -> bool:
        """Whether this call for this record fails."""
        if self.at_call is not None:
            return self.at_call <= call < self.at_call + self.count
        if label is None:
            return False
        first = 1 if self.attempt is None else self.attempt
        return (
            self.position in (None, label.position)
            and self.record in (None, label.record)
            and self.purpose in (None, label.purpose)
            and first <= label.attempt < first + self.count
        )


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
                if fault.operation == operation and fault.strikes(self._calls[operation], label)
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
            if fault.kind in _RAISED:
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
