"""A connection to one NI device, by the local driver or NI's gRPC Device Server."""

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple, TypeVar

from wavefocus.drivers.daq.ni.ni_failures import NOT_SUPPORTED, ServerSilentError, explain
from wavefocus.drivers.errors import InstrumentError, MissingPackageError
from wavefocus.drivers.protocols import DeviceIdentity

# Resetting and testing a device takes seconds.
SLOW_CALLS = {"ResetDevice": 30.0, "SelfTestDevice": 30.0}


class TlsFiles(NamedTuple):
    """PEM files for TLS: the root that has signed the server's certificate; for mutual TLS a client's own two, too."""

    root: Path
    certificate: Path | None = None
    key: Path | None = None


class CallDetails(NamedTuple):
    """What grpc wants to know of a call (`grpc.ClientCallDetails`)."""

    method: str
    timeout: float | None
    metadata: Any
    credentials: Any
    wait_for_ready: bool | None
    compression: Any


def _open_channel(address: str, answer_s: float, tls: TlsFiles | None = None) -> Any:
    """A fresh channel, with nothing in common with an earlier one to the same server.

    The nidaqmx package gives its calls no deadline. Here each has one: the time that the call itself asks for
    plus `answer_s`. Once a deadline has passed, further calls fail at once, for a server that is silent would
    cost as much again for each of the calls that clear up. Raises OSError.

    answer_s: How long a call may take beyond what it asks for, in s, > 0.
    tls: For a server with a certificate; without them the channel is in the clear.

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
                raise ServerSilentError(self._silence)
            deadline_s = answer_s + SLOW_CALLS.get(name, 0.0) + asked_s(request)
            bounded = CallDetails(
                details.method,
                deadline_s,
                details.metadata,
                details.credentials,
                details.wait_for_ready,
                details.compression,
            )
            outcome = continuation(bounded, request)
            if outcome.code() is grpc.StatusCode.DEADLINE_EXCEEDED:
                self._silence = f"{name} got no answer within {deadline_s:g} s"
                raise ServerSilentError(self._silence)
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
        root, key, certificate = (
            None if file is None else file.read_bytes() for file in (tls.root, tls.key, tls.certificate)
        )
        channel = grpc.secure_channel(address, grpc.ssl_channel_credentials(root, key, certificate), options)
    return grpc.intercept_channel(channel, Deadlines())


def asked_s(request: Any) -> float:
    """How long a request itself allows, in s; 0 where it says nothing."""
    for field in ("timeout", "time_to_wait"):
        value = getattr(request, field, None)
        if isinstance(value, float) and value > 0:
            return value
    return 0.0


T = TypeVar("T")

TERMINALS = {"differential": "DIFF", "rse": "RSE", "nrse": "NRSE", "pseudodifferential": "PSEUDO_DIFF"}
"""Terminal configurations by their names here and in nidaqmx.constants.TerminalConfiguration."""


@dataclass(frozen=True, slots=True)
class Limits:
    """Limits of the device; None where it does not report them.

    inputs: Analog inputs: ``"ai0"`` and so on.
    ranges_v: Symmetric ranges in volts, smallest first.
    slowest_hz, fastest_hz: Sample rates of a task of two channels.
    triggers: Digital inputs that can start a record: ``"PFI0"`` and so on.
    simultaneous: Whether every input has a converter of its own.
    """

    inputs: tuple[str, ...]
    ranges_v: tuple[float, ...] | None
    slowest_hz: float | None
    fastest_hz: float | None
    triggers: tuple[str, ...] | None
    simultaneous: bool | None


class NiSession:
    """A device that has answered. Raises InstrumentLostError or InstrumentError.

    address: ``"host:port"`` of NI's gRPC Device Server; None for the local driver.
    answer_s: How long a server may take to answer, in s.
    known: Whether it has answered before: then it is gone where it does not answer, and not misspelt.
    owned: Whether this program may have reserved it before.
    tls: For a server with a certificate.
    role: Table of the rig file that names it.

    task_name: Name of its tasks that reserve the device; one at a time.
    """

    def __init__(
        self,
        device: str,
        address: str | None,
        answer_s: float,
        *,
        role: str = "recorder",
        known: bool = False,
        owned: bool = False,
        tls: TlsFiles | None = None,
        task_name: str = "",
    ) -> None:
        self.device = device
        self.task_name = task_name
        self._role = role
        self.instrument = f"{role} {device}" + (f" at {address}" if address else "")
        self.owned = owned
        self._seen = known
        self._channel: Any = None
        self._nidaqmx = _packages(self.instrument, over_network=bool(address))
        # Whatever the driver warns about is an error here: no sample that it doubts is taken for good.
        warnings.filterwarnings("error", category=self._nidaqmx.errors.DaqWarning)
        self._options: Any = None
        try:
            if address:
                self._channel = self._opened_channel(address, answer_s, tls)
                self._options = self._nidaqmx.GrpcSessionOptions(self._channel, "")
            with self.explaining("opening"):
                self._open()
        except BaseException:
            self.close()
            raise

    def _opened_channel(self, address: str, answer_s: float, tls: TlsFiles | None) -> Any:
        try:
            return _open_channel(address, answer_s, tls)
        except OSError as failure:
            cause = f"{failure.filename} cannot be read ({failure.strerror})"
            remedy = f"correct tls_root, tls_certificate and tls_key of [{self._role}]"
            raise InstrumentError(self.instrument, "opening", cause, remedy) from failure

    def _open(self) -> None:
        try:
            system = self._nidaqmx.system.System(self._options)
            version = system.driver_version
            self.driver_version = f"{version.major_version}.{version.minor_version}.{version.update_version}"
            self.handle = system.devices[self.device]
            self.identity = self.ask_identity()
            self._seen = True
        except self._nidaqmx.errors.DaqError as error:
            if error.error_code in (-200220, -88705) and not self._seen:
                raise self._misnamed(system, error) from error
            raise
        except (self._nidaqmx.errors.DaqNotFoundError, self._nidaqmx.errors.DaqNotSupportedError, OSError) as error:
            cause = f"the NI-DAQmx driver is not on this computer ({' '.join(str(error).split())})"
            remedy = (
                f"install NI-DAQmx from ni.com, or give address of [{self._role}], a computer that runs NI's gRPC "
                "Device Server"
            )
            raise InstrumentError(self.instrument, "opening", cause, remedy) from error
        self.limits = self._ask_limits()

    def _misnamed(self, system: Any, error: Any) -> InstrumentError:
        """The error of a name that nothing has, with the names that there are."""
        explained = explain(error, self.instrument, "opening", role=self._role)
        names = [name for name in system.devices.device_names if name != self.device]
        if not names:
            return explained
        remedy = f"put a name that is there into device of [{self._role}]: {', '.join(names)}; or plug it in"
        return type(explained)(self.instrument, "opening", explained.cause, remedy)

    def ask_identity(self) -> DeviceIdentity:
        """Ask the device who it is."""
        # The serial number as it is printed on the box and shown by NI MAX.
        return DeviceIdentity("NI", self.handle.product_type, f"{int(self.handle.serial_num):08X}")

    def terminals_of(self, name: str) -> tuple[str, ...] | None:
        """Terminal configurations of an input, None where the device does not report it."""
        channel = self._nidaqmx.system.PhysicalChannel(f"{self.device}/{name}", grpc_options=self._options)
        known = self._known(lambda: channel.ai_term_cfgs)
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

    def conversion_rate_hz(self, task: Any) -> float | None:
        """The rate of a task's conversion clock (AI Convert), None where the device does not report it."""
        return self._known(lambda: float(task.timing.ai_conv_rate))

    def coefficients_of(self, channel: Any) -> list[float] | None:
        """The calibration of a channel, None where the device does not report it."""
        return self._known(lambda: [float(coefficient) for coefficient in channel.ai_dev_scaling_coeff])

    def reset(self) -> None:
        """Abort whatever runs on the device and take its reservations back."""
        self.handle.reset_device()

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
        except (errors.Error, errors.DaqWarning, ServerSilentError, ValueError) as failure:
            raise explain(
                failure, self.instrument, operation, known=self._seen, owned=self.owned, role=self._role
            ) from failure

    def _ask_limits(self) -> Limits:
        device = self.handle
        bounds_v = self._known(lambda: {float(bound_v) for bound_v in device.ai_voltage_rngs})
        terminals = self._known(lambda: [name.rpartition("/")[2] for name in device.terminals])
        ranges_v = None if bounds_v is None else tuple(sorted(v for v in bounds_v if v > 0 and -v in bounds_v))
        triggers = None if terminals is None else tuple(name for name in terminals if name.startswith("PFI"))
        return Limits(
            inputs=tuple(name.rpartition("/")[2] for name in device.ai_physical_chans.channel_names),
            ranges_v=ranges_v,
            slowest_hz=self._known(lambda: float(device.ai_min_rate)),
            fastest_hz=self._known(lambda: self._fastest_hz(device)),
            triggers=triggers,
            simultaneous=self._known(lambda: bool(device.ai_simultaneous_sampling_supported)),
        )

    def _fastest_hz(self, device: Any) -> float:
        """Fastest rate of two inputs: what all share where one converter serves them, else each input's own."""
        simultaneous = self._known(lambda: bool(device.ai_simultaneous_sampling_supported))
        of_several_hz = device.ai_max_multi_chan_rate
        return float(min(device.ai_max_single_chan_rate, of_several_hz if simultaneous else of_several_hz / 2))

    def _known(self, ask: Callable[[], T]) -> T | None:
        """What a question yields, None where the device has no such property."""
        try:
            return ask()
        except self._nidaqmx.errors.DaqError as error:
            if error.error_code in NOT_SUPPORTED:
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
