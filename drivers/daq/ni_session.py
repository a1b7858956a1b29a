"""A connection to one NI device, through the local NI-DAQmx driver or NI's gRPC Device Server."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

from drivers.daq.ni_channel import TlsFiles, open_channel
from drivers.daq.ni_errors import NOT_SUPPORTED, ServerSilentError, explain
from drivers.errors import InstrumentError
from drivers.identity import DeviceIdentity

T = TypeVar("T")

TERMINALS = {"differential": "DIFF", "rse": "RSE", "nrse": "NRSE", "pseudodifferential": "PSEUDO_DIFF"}
"""Terminal configurations by their names here and in nidaqmx.constants.TerminalConfiguration."""


@dataclass(frozen=True, slots=True)
class Limits:
    """What the device can do; None where it does not tell.

    Parameters
    ----------
    inputs : tuple of str
        Analog inputs: ``"ai0"`` and so on.
    ranges_v : tuple of float, optional
        Symmetric ranges in volts, smallest first.
    slowest_hz, fastest_hz : float, optional
        Sample rates of a task of two channels.
    triggers : tuple of str, optional
        Digital inputs that can start a record: ``"PFI0"`` and so on.
    """

    inputs: tuple[str, ...]
    ranges_v: tuple[float, ...] | None
    slowest_hz: float | None
    fastest_hz: float | None
    triggers: tuple[str, ...] | None


class NiSession:
    """A device that has answered.

    Parameters
    ----------
    device : str
        Name: ``"Dev1"``.
    address : str, optional
        ``"host:port"`` of NI's gRPC Device Server; None for the local driver.
    answer_s : float
        How long a server may take to answer, in s.
    known : bool
        Whether it has answered before: then it is gone where it does not answer, and not misspelt.
    tls : TlsFiles, optional
        For a server with a certificate.

    Raises
    ------
    InstrumentLostError
        It is not there, or the server is not.
    InstrumentError
        The package, the driver or a device of that name is missing.
    """

    def __init__(
        self, device: str, address: str | None, answer_s: float, *, known: bool = False, tls: TlsFiles | None = None
    ) -> None:
        self.device = device
        self.instrument = f"recorder {device}" + (f" at {address}" if address else "")
        self.owned = False  # whether this program may have reserved it
        self._seen = known
        self._channel: Any = None
        doing = "opening"
        self._nidaqmx = _package(self.instrument, doing)
        # Whatever the driver warns about is an error here: no sample that it doubts is taken for good.
        warnings.filterwarnings("error", category=self._nidaqmx.errors.DaqWarning)
        self._options: Any = None
        try:
            if address:
                _grpc(self.instrument, doing)
                self._channel = self._opened_channel(address, answer_s, tls)
                self._options = self._nidaqmx.GrpcSessionOptions(self._channel, "")
            with self.telling(doing):
                self._open()
        except BaseException:
            self.close()
            raise

    def _opened_channel(self, address: str, answer_s: float, tls: TlsFiles | None) -> Any:
        try:
            return open_channel(address, answer_s, tls)
        except OSError as failure:
            raise InstrumentError(
                self.instrument,
                "opening",
                f"{failure.filename} cannot be read ({failure.strerror})",
                "correct tls_root, tls_certificate and tls_key of [recorder]",
            ) from failure

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
            raise InstrumentError(
                self.instrument,
                "opening",
                f"the NI-DAQmx driver is not on this computer ({' '.join(str(error).split())})",
                "install NI-DAQmx from ni.com, or give address of [recorder], a computer that runs NI's gRPC Device "
                "Server",
            ) from error
        self.limits = self._ask_limits()

    def _misnamed(self, system: Any, error: Any) -> InstrumentError:
        """The error of a name that nothing has, with the names that there are."""
        explained = explain(error, self.instrument, "opening")
        names = [name for name in system.devices.device_names if name != self.device]
        if not names:
            return explained
        remedy = f"put a name that is there into device of [recorder]: {', '.join(names)}; or plug it in"
        return type(explained)(self.instrument, "opening", explained.cause, remedy)

    def ask_identity(self) -> DeviceIdentity:
        """Ask the device who it is."""
        # The serial number as it is printed on the box and shown by NI MAX.
        return DeviceIdentity("NI", self.handle.product_type, f"{int(self.handle.serial_num):08X}")

    def terminals_of(self, name: str) -> tuple[str, ...] | None:
        """Terminal configurations of an input, None where the device does not tell."""
        channel = self._nidaqmx.system.PhysicalChannel(f"{self.device}/{name}", grpc_options=self._options)
        known = self._known(lambda: channel.ai_term_cfgs)
        if known is None:
            return None
        return tuple(name for name, nis_name in TERMINALS.items() if nis_name in {config.name for config in known})

    def new_task(self) -> Any:
        """A new, empty `nidaqmx.Task`; the caller closes it."""
        return self._nidaqmx.Task(grpc_options=self._options)

    def coefficients_of(self, channel: Any) -> list[float] | None:
        """The calibration of a channel, None where the device does not tell."""
        return self._known(lambda: [float(coefficient) for coefficient in channel.ai_dev_scaling_coeff])

    def reset(self) -> None:
        """Abort whatever runs on the device and take its reservations back."""
        self.handle.reset_device()

    def close(self) -> None:
        """Close the channel; what still waits in it fails."""
        if self._channel is not None:
            self._channel.close()

    @contextmanager
    def telling(self, operation: str) -> Iterator[None]:
        """Turn failures of the package within the block into the engine's errors."""
        errors = self._nidaqmx.errors
        try:
            yield
        except (errors.Error, errors.DaqWarning, ServerSilentError, ValueError) as failure:
            raise explain(failure, self.instrument, operation, known=self._seen, owned=self.owned) from failure

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


def _package(instrument: str, operation: str) -> Any:
    try:
        import nidaqmx
        import nidaqmx.errors
        import nidaqmx.system
    except ImportError as error:
        raise InstrumentError(
            instrument,
            operation,
            f"the Python package nidaqmx is missing ({error})",
            'install it: pip install "nidaqmx[grpc]"',
        ) from error
    return nidaqmx


def _grpc(instrument: str, operation: str) -> None:
    try:
        import grpc  # noqa: F401
        import nidaqmx._grpc_interpreter  # noqa: F401
    except ImportError as error:
        raise InstrumentError(
            instrument,
            operation,
            f"what the nidaqmx package needs for an address is missing ({error})",
            'install it: pip install "nidaqmx[grpc]"',
        ) from error
