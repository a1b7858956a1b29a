"""A connection to one NI device, by the local driver or NI's gRPC Device Server, and its failures in words."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from wavefocus.drivers.errors import (
    InstrumentError,
    InstrumentLostError,
    MissingPackageError,
    TransientInstrumentError,
    UnknownFaultError,
)
from wavefocus.drivers.protocols import DeviceIdentity

# Codes of nidaqmx.error_codes.DAQmxErrors and DAQmxWarnings.
_NO_SUCH_DEVICE = -200220
IN_USE = -50103
_RESERVED = (
    IN_USE,
    -200022,
    -201352,
    -201420,
)  # PAL_, RESOURCE_ALREADY_RESERVED, RESERVATION_CONFLICT, by another host
NOT_DONE = -200560
_NOT_SUPPORTED = (-200452, -200197)  # a property that this device or task has not
STOPPED_BEFORE_DONE = 200010

# Of one record, and not of the device or its settings: timestamp, input termination, converter, phase-locked loop.
_PASSING_WARNINGS = (200003, 200004, 200005, 200007)

REPEAT = "try again; if it stays, close other programs or use another USB port"
_PLUG = (
    "check its USB cable and its power, then try again; if it stays away, restart NI's gRPC Device Server where it has "
    "one: its library may stay broken after a replug"
)


class _ServerSilentError(Exception):
    """NI's gRPC Device Server has not answered within the deadline of a call."""


class _Meaning(NamedTuple):
    """What a code means: which error it becomes, the cause and the remedy."""

    error: type[InstrumentError]
    cause: str
    remedy: str


# Names of `nidaqmx.error_codes.DAQmxErrors` that a night meets, by what they mean; others are told in NI's own words.
# _NO_SUCH_DEVICE and _RESERVED depend on what was before.
MEANINGS = {
    _Meaning(InstrumentLostError, "it cannot be accessed: unplugged, without power or in reset", _PLUG): """
        DEV_CANNOT_BE_ACCESSED DEVICE_REMOVED HARDWARE_NOT_RESPONDING HW_UNEXPECTEDLY_POWERED_OFF_AND_ON
        DEVICE_NOT_USABLE_UNTIL_USB_REPLUG""",
    _Meaning(InstrumentLostError, "it is not present", _PLUG): """
        PAL_DEVICE_NOT_FOUND DRIVER_DEVICE_GUID_NOT_FOUND_ROUTING""",
    _Meaning(
        InstrumentLostError,
        "the USB transfer was aborted",
        # nidaqmx-python issue 893: a USB-6009 came back only when it was plugged in again.
        "connect again, which resets it; if it stays, unplug it and plug it in again, at another USB port and no hub",
    ): """
        PAL_TRANSFER_ABORTED PAL_TRANSFER_STOPPED PAL_TRANSFER_TIMED_OUT PAL_USB_TRANSACTION_ERROR
        PAL_COMMUNICATIONS_FAULT PAL_CONNECTION_RESET PAL_CONNECTION_ABORTED""",
    _Meaning(InstrumentLostError, "the network connection to it is lost", "check its network cable and power"): """
        NETWORK_STATUS_CONNECTION_LOST NETWORK_STATUS_DOWN NETWORK_STATUS_TIMED_OUT NETWORK_TARGET_UNREACHABLE""",
    _Meaning(
        InstrumentLostError, "the driver has forgotten the task: it or the device was restarted", "connect again"
    ): "INVALID_TASK",
    _Meaning(TransientInstrumentError, "samples were overwritten before they could be read", REPEAT): """
        SAMPLES_NO_LONGER_AVAILABLE DATA_OVERWRITTEN_IN_DEVICE_MEMORY INPUT_FIFO_OVERFLOW INPUT_FIFO_OVERFLOW_2
        INPUT_FIFO_OVERFLOW_3
        ACQ_STOPPED_TO_PREVENT_INPUT_BUFFER_OVERWRITE ACQ_STOPPED_DRIVER_CANT_XFER_DATA_FAST_ENOUGH""",
    _Meaning(TransientInstrumentError, "samples are missing: they did not come in time", REPEAT): """
        SAMPLES_NOT_YET_AVAILABLE SAMPLES_WILL_NEVER_BE_AVAILABLE""",
    _Meaning(TransientInstrumentError, "the record did not end in time", REPEAT): """
        WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE OPERATION_TIMED_OUT""",
}

_GONE = _Meaning(InstrumentLostError, "it is not there any more", _PLUG)
_WRONG_NAME = _Meaning(InstrumentError, "there is no device of this name", "put its name into device of [recorder]")
_STALE = _Meaning(
    InstrumentLostError,
    "it is reserved, by what was left over or by another program",
    "close other programs that use it, then connect again, which resets it",
)
_OCCUPIED = _Meaning(
    InstrumentError,
    "another program has reserved it",
    "close that program (a test panel, LabVIEW, another wavefocus); if none is open, reset the device in NI MAX",
)


def explain(
    failure: BaseException,
    instrument: str,
    operation: str,
    *,
    known: bool = False,
    owned: bool = False,
    role: str = "recorder",
) -> InstrumentError:
    """Turn a failure of the nidaqmx package into an `InstrumentError`.

    failure: DaqError, RpcError, DaqWarning or another error of the package, ValueError of a closed channel, ...
    instrument, operation: Who was asked what.
    known: Whether the device has answered this program before: then it is gone rather than misspelt.
    owned: Whether this program may have reserved it before: then what is reserved may be its own.
    role: Table of the rig file that names the device.
    """
    error, cause, remedy = _meaning(failure, known, owned)
    return error(instrument, operation, cause, remedy.replace("[recorder]", f"[{role}]"))


def _meaning(failure: BaseException, known: bool, owned: bool) -> _Meaning:
    # A device that has recorded before was set up properly, so an unknown failure may pass; of a first task, the
    # settings may be wrong, and a repeat does not help.
    unforeseen = UnknownFaultError if known and owned else InstrumentError
    if isinstance(failure, _ServerSilentError):
        remedy = "check that the computer with the device and the server on it are alive, then connect again"
        return _Meaning(InstrumentLostError, f"the server does not answer ({failure})", remedy)
    if hasattr(failure, "rpc_code"):
        return _meaning_of_rpc(failure, unforeseen)
    code = getattr(failure, "error_code", None)
    if isinstance(failure, Warning):
        cause = f"NI-DAQmx warns: {_one_line(failure)}"
        if code in _PASSING_WARNINGS:
            return _Meaning(TransientInstrumentError, cause, "try again; if it stays, lower the signal or the rate")
        return _Meaning(unforeseen, cause, "put right what it warns of: the device, or its settings in [recorder]")
    if code is None:
        return _Meaning(unforeseen, _one_line(failure), "close and open the rig again")
    if code == _NO_SUCH_DEVICE:
        return _with_code(_GONE if known else _WRONG_NAME, code)
    if code in _RESERVED:
        return _with_code(_STALE if owned else _OCCUPIED, code)
    if code in (known_codes := _meaning_of_code()):
        meaning = _with_code(known_codes[code], code)
        count = getattr(failure, "samps_per_chan_read", None)
        return meaning._replace(cause=f"{meaning.cause}; {count} came") if count else meaning
    remedy = "follow what it says in [recorder], or as sample_rate_hz of [capture], or look the code up"
    return _Meaning(unforeseen, f"NI-DAQmx says: {_one_line(failure)}", remedy)


@cache
def _meaning_of_code() -> dict[int, _Meaning]:
    """`MEANINGS` by code; a name that this version of the package does not have is unknown."""
    from nidaqmx.error_codes import DAQmxErrors

    codes = {name: error.value for name, error in DAQmxErrors.__members__.items()}
    return {codes[name]: meaning for meaning, names in MEANINGS.items() for name in names.split() if name in codes}


def _meaning_of_rpc(failure: Any, unforeseen: type[InstrumentError]) -> _Meaning:
    import grpc

    if failure.rpc_code == grpc.StatusCode.UNAVAILABLE:
        return _Meaning(
            InstrumentLostError,
            "NI's gRPC Device Server cannot be reached, or went away during the call",
            "start ni_grpc_device_server on the computer with the device; its server_config.json must say "
            '"address": "[::]", for otherwise it serves only its own computer ([::1]); check address and the network; '
            "where the server has a certificate, the recorder needs tls_root, and no mirror or shutter can be on it",
        )
    if failure.rpc_code == grpc.StatusCode.CANCELLED:
        return _Meaning(TransientInstrumentError, "the call was cancelled: the connection was closed", "connect again")
    if failure.rpc_code in (grpc.StatusCode.INTERNAL, grpc.StatusCode.RESOURCE_EXHAUSTED):
        return _Meaning(
            TransientInstrumentError,
            f"the server could not serve the call this time: {_one_line(failure)}",
            "try again; if it stays, restart the server and look into its log",
        )
    if failure.rpc_code == grpc.StatusCode.UNIMPLEMENTED:
        return _Meaning(InstrumentError, _one_line(failure), "install a newer NI gRPC Device Server")
    return _Meaning(unforeseen, f"the server says: {_one_line(failure)}", "look into the server's own log")


def _with_code(meaning: _Meaning, code: int) -> _Meaning:
    return meaning._replace(cause=f"{meaning.cause} (NI-DAQmx {code})")


def _one_line(failure: BaseException) -> str:
    return " ".join(str(failure).split()) or type(failure).__name__


# Resetting and testing a device takes seconds.
_SLOW_CALLS = {"ResetDevice": 30.0, "SelfTestDevice": 30.0}


T = TypeVar("T")
Tls = tuple[str | None, str | None, str | None]
"""PEM files for TLS: root that has signed the server's certificate; for mutual TLS a client's certificate and key."""


def _open_channel(address: str, answer_s: float, tls: Tls | None = None) -> Any:
    """A fresh channel, with nothing in common with an earlier one to the same server.

    The nidaqmx package gives its calls no deadline. Here each has one: the time that the call itself asks for
    plus `answer_s`. Once a deadline has passed, further calls fail at once, for a server that is silent would
    cost as much again for each of the calls that clear up. Raises OSError.

    answer_s: How long a call may take beyond what it asks for, in s, > 0.
    tls: For a server with a certificate; without it the channel is in the clear.

    Returns grpc.Channel: to be closed by the caller.
    """
    import grpc
    from nidaqmx.error_codes import DAQmxWarnings
    from nidaqmx.errors import DaqWarning

    class Deadlines(grpc.UnaryUnaryClientInterceptor):  # type: ignore[misc]  # grpc has no types
        """Adds deadlines, remembers silence, raises warnings that the package itself does not look at."""

        def __init__(self) -> None:
            self._silence = ""

        def intercept_unary_unary(self, continuation: Any, details: Any, request: Any) -> Any:
            name = details.method.rpartition("/")[2]
            if self._silence:
                raise _ServerSilentError(self._silence)
            deadline_s = answer_s + _SLOW_CALLS.get(name, 0.0) + _asked_s(request)
            outcome = continuation(details._replace(timeout=deadline_s), request)
            if outcome.code() is grpc.StatusCode.DEADLINE_EXCEEDED:
                self._silence = f"{name} got no answer within {deadline_s:g} s"
                raise _ServerSilentError(self._silence)
            status = getattr(outcome.result(), "status", 0)
            if status > 0:
                names = {warning.value: warning.name for warning in DAQmxWarnings}
                raise DaqWarning(f"{name}: {names.get(status, 'unknown warning')}", status)
            return outcome

    options = [
        ("grpc.enable_http_proxy", 0),  # instruments are never behind one
        ("grpc.max_receive_message_length", -1),  # two long records are more than the default 4 MB
        ("grpc.use_local_subchannel_pool", 1),  # else a new channel inherits the old one's pauses after failures
    ]
    if tls is None:
        channel = grpc.insecure_channel(address, options)
    else:
        root, certificate, key = (None if file is None else Path(file).read_bytes() for file in tls)
        channel = grpc.secure_channel(address, grpc.ssl_channel_credentials(root, key, certificate), options)
    return grpc.intercept_channel(channel, Deadlines())


def _asked_s(request: Any) -> float:
    """How long a request itself allows, in s; 0 where it says nothing."""
    for field in ("timeout", "time_to_wait"):
        value = getattr(request, field, None)
        if isinstance(value, float) and value > 0:
            return value
    return 0.0


TERMINALS = {"differential": "DIFF", "rse": "RSE", "nrse": "NRSE", "pseudodifferential": "PSEUDO_DIFF"}
"""Terminal configurations by their names here and in nidaqmx.constants.TerminalConfiguration."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the device; None where it does not report them.

    inputs: Analog inputs: ``"ai0"`` and so on.
    ranges_v: Symmetric ranges in volts, smallest first.
    triggers: Digital inputs that can start a record: ``"PFI0"`` and so on.
    simultaneous: Whether every input has a converter of its own.
    """

    inputs: tuple[str, ...]
    ranges_v: tuple[float, ...] | None
    triggers: tuple[str, ...] | None
    simultaneous: bool | None


class NiSession:
    """A device that has answered. Raises InstrumentLostError or InstrumentError.

    address: ``"host:port"`` of NI's gRPC Device Server; None for the local driver.
    answer_s: How long a server may take to answer, in s.
    role: Table of the rig file that names it.
    identity: The device that must answer; where none of this name answers, it is gone then, and not misspelt.
    owned: Whether this program may have reserved it before.
    tls: For a server with a certificate.
    task_name: Name of its tasks that reserve the device; one at a time.
    """

    def __init__(
        self,
        device: str,
        address: str | None,
        answer_s: float,
        *,
        role: str = "recorder",
        identity: DeviceIdentity | None = None,
        owned: bool = False,
        tls: Tls | None = None,
        task_name: str = "",
    ) -> None:
        self.device = device
        self.task_name = task_name
        self._role = role
        self.instrument = f"{role} {device}" + (f" at {address}" if address else "")
        self.owned = owned
        self._known = identity is not None
        self._channel: Any = None
        self._nidaqmx = _packages(self.instrument, over_network=bool(address))
        # Whatever the driver warns about is an error here: no sample that it doubts is taken for good.
        warnings.filterwarnings("error", category=self._nidaqmx.errors.DaqWarning)
        self._options: Any = None
        if address:
            try:
                self._channel = _open_channel(address, answer_s, tls)
            except OSError as failure:
                cause = f"{failure.filename} cannot be read ({failure.strerror})"
                remedy = f"correct tls_root, tls_certificate and tls_key of [{role}]"
                raise InstrumentError(self.instrument, "opening", cause, remedy) from failure
        try:
            if address:
                self._options = self._nidaqmx.GrpcSessionOptions(self._channel, "")
            with self.explaining("opening"):
                self._open()
            if identity not in (None, self.identity):
                cause = f"{self.identity} answers instead of {identity}"
                remedy = "plug the right one in, or start a new campaign with this one"
                raise InstrumentError(self.instrument, "opening", cause, remedy)
        except BaseException:
            self.close()
            raise

    def _open(self) -> None:
        errors = self._nidaqmx.errors
        try:
            system = self._nidaqmx.system.System(self._options)
            version = system.driver_version
            self.driver_version = f"{version.major_version}.{version.minor_version}.{version.update_version}"
            self.handle = system.devices[self.device]
            self.identity = self.ask_identity()
        except errors.DaqError as error:
            names = []
            if error.error_code in (_NO_SUCH_DEVICE, -88705) and not self._known:
                names = [name for name in system.devices.device_names if name != self.device]
            if not names:
                raise
            explained = explain(error, self.instrument, "opening", role=self._role)
            remedy = f"put a name that is there into device of [{self._role}]: {', '.join(names)}; or plug it in"
            raise type(explained)(self.instrument, "opening", explained.cause, remedy) from error
        except (errors.DaqNotFoundError, errors.DaqNotSupportedError, OSError) as error:
            cause = f"the NI-DAQmx driver is not on this computer ({' '.join(str(error).split())})"
            remedy = (
                f"install NI-DAQmx from ni.com, or give address of [{self._role}], a computer that runs NI's gRPC "
                "Device Server"
            )
            raise InstrumentError(self.instrument, "opening", cause, remedy) from error
        self._known = True
        self.limits = self._ask_limits()

    def ask_identity(self) -> DeviceIdentity:
        """Ask the device who it is."""
        # The serial number as it is printed on the box and shown by NI MAX.
        return DeviceIdentity("NI", self.handle.product_type, f"{int(self.handle.serial_num):08X}")

    def terminals_of(self, name: str) -> tuple[str, ...] | None:
        """Terminal configurations of an input, None where the device does not report it."""
        channel = self._nidaqmx.system.PhysicalChannel(f"{self.device}/{name}", grpc_options=self._options)
        known = self.reported(lambda: channel.ai_term_cfgs)
        if known is None:
            return None
        return tuple(name for name, nis_name in TERMINALS.items() if nis_name in {config.name for config in known})

    def new_task(self, name: str = "") -> Any:
        """A new, empty `nidaqmx.Task`; the caller closes it.

        name: A server keeps the task of a process that was killed, and the device reserved. One of this name is
            cleared first.
        """
        if name:
            # It is attached to where it exists (nidaqmx.SessionInitializationBehavior.AUTO), else made.
            self._nidaqmx.Task(name, grpc_options=self._options).close()
        return self._nidaqmx.Task(name, grpc_options=self._options)

    def close(self) -> None:
        """Close the channel; what still waits in it fails."""
        if self._channel is not None:
            self._channel.close()

    @contextmanager
    def explaining(self, operation: str) -> Iterator[None]:
        """Turn failures of the package within the block into the engine's errors."""
        errors = self._nidaqmx.errors
        try:
            yield
        except (errors.Error, errors.DaqWarning, _ServerSilentError, ValueError) as failure:
            raise explain(
                failure, self.instrument, operation, known=self._known, owned=self.owned, role=self._role
            ) from failure

    def _ask_limits(self) -> Limits:
        device = self.handle
        bounds_v = self.reported(lambda: {float(bound_v) for bound_v in device.ai_voltage_rngs})
        terminals = self.reported(lambda: [name.rpartition("/")[2] for name in device.terminals])
        ranges_v = None if bounds_v is None else tuple(sorted(v for v in bounds_v if v > 0 and -v in bounds_v))
        triggers = None if terminals is None else tuple(name for name in terminals if name.startswith("PFI"))
        return Limits(
            inputs=tuple(name.rpartition("/")[2] for name in device.ai_physical_chans.channel_names),
            ranges_v=ranges_v,
            triggers=triggers,
            simultaneous=self.reported(lambda: bool(device.ai_simultaneous_sampling_supported)),
        )

    def reported(self, ask: Callable[[], T]) -> T | None:
        """What a question yields, None where the device has no such property."""
        try:
            return ask()
        except self._nidaqmx.errors.DaqError as error:
            if error.error_code in _NOT_SUPPORTED:
                return None
            raise


def _packages(instrument: str, *, over_network: bool) -> Any:
    """The package nidaqmx, with what it needs for an address. Raises MissingPackageError."""
    missing = "the Python package nidaqmx is missing"
    try:
        import nidaqmx
        import nidaqmx.errors
        import nidaqmx.system

        if over_network:
            missing = "what the nidaqmx package needs for an address is missing"
            import grpc  # noqa: F401
            import nidaqmx._grpc_interpreter
    except ImportError as error:
        package = "wavefocus[remote]" if over_network else "nidaqmx"
        remedy = f'install it: pip install "{package}"'
        raise MissingPackageError(instrument, "opening", f"{missing} ({error})", remedy) from error
    return nidaqmx
