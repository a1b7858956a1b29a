"""Failures of NI-DAQmx and its server, in words for the person at the bench."""

from functools import cache
from typing import Any, NamedTuple

from wavefocus.drivers.errors import InstrumentError, InstrumentLostError, TransientInstrumentError, UnknownFaultError

# Codes of nidaqmx.error_codes.DAQmxErrors and DAQmxWarnings.
NO_SUCH_DEVICE = -200220
IN_USE = -50103
RESERVED = (IN_USE, -200022, -201352, -201420)  # PAL_, RESOURCE_ALREADY_RESERVED, RESERVATION_CONFLICT, by another host
NOT_DONE = -200560
NOT_SUPPORTED = (-200452, -200197)  # a property that this device or task has not
STOPPED_BEFORE_DONE = 200010

# Of one record, and not of the device or its settings: timestamp, input termination, converter, phase-locked loop.
PASSING_WARNINGS = (200003, 200004, 200005, 200007)

REPEAT = "try again; if it stays, close other programs or use another USB port"
PLUG = (
    "check its USB cable and its power, then try again; if it stays away, restart NI's gRPC Device Server where it has "
    "one: its library may stay broken after a replug"
)


class ServerSilentError(Exception):
    """NI's gRPC Device Server has not answered within the deadline of a call."""


class Meaning(NamedTuple):
    """What a code means: which error it becomes, the cause and the remedy."""

    error: type[InstrumentError]
    cause: str
    remedy: str


# Names of `nidaqmx.error_codes.DAQmxErrors` that a night meets, by what they mean; others are told in NI's own words.
# NO_SUCH_DEVICE and RESERVED depend on what was before.
MEANINGS = {
    Meaning(InstrumentLostError, "it cannot be accessed: unplugged, without power or in reset", PLUG): """
        DEV_CANNOT_BE_ACCESSED DEVICE_REMOVED HARDWARE_NOT_RESPONDING HW_UNEXPECTEDLY_POWERED_OFF_AND_ON""",
    Meaning(InstrumentLostError, "it is not present", PLUG): """
        PAL_DEVICE_NOT_FOUND DRIVER_DEVICE_GUID_NOT_FOUND_ROUTING""",
    Meaning(
        InstrumentLostError,
        "the USB transfer was aborted",
        "connect again, which resets it; if it stays, use another USB port or cable, and no hub",
    ): "PAL_TRANSFER_ABORTED PAL_USB_TRANSACTION_ERROR PAL_COMMUNICATIONS_FAULT",
    Meaning(InstrumentLostError, "the network connection to it is lost", "check its network cable and power"): """
        NETWORK_STATUS_CONNECTION_LOST""",
    Meaning(
        InstrumentLostError, "the driver has forgotten the task: it or the device was restarted", "connect again"
    ): "INVALID_TASK",
    Meaning(TransientInstrumentError, "samples were overwritten before they could be read", REPEAT): """
        SAMPLES_NO_LONGER_AVAILABLE DATA_OVERWRITTEN_IN_DEVICE_MEMORY INPUT_FIFO_OVERFLOW
        ACQ_STOPPED_TO_PREVENT_INPUT_BUFFER_OVERWRITE ACQ_STOPPED_DRIVER_CANT_XFER_DATA_FAST_ENOUGH""",
    Meaning(TransientInstrumentError, "samples are missing: they did not come in time", REPEAT): """
        SAMPLES_NOT_YET_AVAILABLE SAMPLES_WILL_NEVER_BE_AVAILABLE""",
    Meaning(TransientInstrumentError, "the record did not end in time", REPEAT): """
        WAIT_UNTIL_DONE_DOES_NOT_INDICATE_DONE OPERATION_TIMED_OUT""",
}

GONE = Meaning(InstrumentLostError, "it is not there any more", PLUG)
WRONG_NAME = Meaning(InstrumentError, "there is no device of this name", "put its name into device of [recorder]")
STALE = Meaning(
    InstrumentLostError,
    "it is reserved, by what was left over or by another program",
    "close other programs that use it, then connect again, which resets it",
)
OCCUPIED = Meaning(
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


def _meaning(failure: BaseException, known: bool, owned: bool) -> Meaning:
    # A device that has recorded before was set up properly, so an unknown failure may pass; of a first task, the
    # settings may be wrong, and a repeat does not help.
    unforeseen = UnknownFaultError if known and owned else InstrumentError
    if isinstance(failure, ServerSilentError):
        remedy = "check that the computer with the device and the server on it are alive, then connect again"
        return Meaning(InstrumentLostError, f"the server does not answer ({failure})", remedy)
    if hasattr(failure, "rpc_code"):
        return _meaning_of_rpc(failure, unforeseen)
    code = getattr(failure, "error_code", None)
    if isinstance(failure, Warning):
        cause = f"NI-DAQmx warns: {_one_line(failure)}"
        if code in PASSING_WARNINGS:
            return Meaning(TransientInstrumentError, cause, "try again; if it stays, lower the signal or the rate")
        return Meaning(unforeseen, cause, "put right what it warns of: the device, or its settings in [recorder]")
    if code is None:
        return Meaning(unforeseen, _one_line(failure), "close and open the rig again")
    if code == NO_SUCH_DEVICE:
        return _with_code(GONE if known else WRONG_NAME, code)
    if code in RESERVED:
        return _with_code(STALE if owned else OCCUPIED, code)
    if code in (known_codes := _meaning_of_code()):
        meaning = _with_code(known_codes[code], code)
        count = getattr(failure, "samps_per_chan_read", None)
        return meaning._replace(cause=f"{meaning.cause}; {count} came") if count else meaning
    return Meaning(unforeseen, f"NI-DAQmx says: {_one_line(failure)}", "follow what it says, or look the code up")


@cache
def _meaning_of_code() -> dict[int, Meaning]:
    """`MEANINGS` by code; a name that this version of the package does not have is unknown."""
    from nidaqmx.error_codes import DAQmxErrors

    codes = {name: error.value for name, error in DAQmxErrors.__members__.items()}
    return {codes[name]: meaning for meaning, names in MEANINGS.items() for name in names.split() if name in codes}


def _meaning_of_rpc(failure: Any, unforeseen: type[InstrumentError]) -> Meaning:
    import grpc

    if failure.rpc_code == grpc.StatusCode.UNAVAILABLE:
        return Meaning(
            InstrumentLostError,
            "NI's gRPC Device Server cannot be reached, or went away during the call",
            "start ni_grpc_device_server on the computer with the device; its server_config.json must say "
            '"address": "[::]", for otherwise it serves only its own computer ([::1]); check address and, where the '
            "server has a certificate, tls_root of [recorder], and the network",
        )
    if failure.rpc_code == grpc.StatusCode.CANCELLED:
        return Meaning(TransientInstrumentError, "the call was cancelled: the connection was closed", "connect again")
    if failure.rpc_code in (grpc.StatusCode.INTERNAL, grpc.StatusCode.RESOURCE_EXHAUSTED):
        return Meaning(
            TransientInstrumentError,
            f"the server could not serve the call this time: {_one_line(failure)}",
            "try again; if it stays, restart the server and look into its log",
        )
    if failure.rpc_code == grpc.StatusCode.UNIMPLEMENTED:
        return Meaning(InstrumentError, _one_line(failure), "install a newer NI gRPC Device Server")
    return Meaning(unforeseen, f"the server says: {_one_line(failure)}", "look into the server's own log")


def _with_code(meaning: Meaning, code: int) -> Meaning:
    return meaning._replace(cause=f"{meaning.cause} (NI-DAQmx {code})")


def _one_line(failure: BaseException) -> str:
    return " ".join(str(failure).split()) or type(failure).__name__
