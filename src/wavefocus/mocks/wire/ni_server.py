"""An NI gRPC Device Server with one box on it; the real nidaqmx package is its client."""

import functools
import threading
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import grpc
from google.protobuf.message_factory import GetMessageClass
from nidaqmx._stubs import nidaqmx_pb2

from wavefocus.config.emulation import WireFault
from wavefocus.mocks.wire import WireFaultPlan
from wavefocus.mocks.wire.ni_box import NiBox, NiCode, NiError, SignalSource
from wavefocus.mocks.wire.ni_calls import NiCalls

_SERVICE = "nidaqmx_grpc.NiDAQmx"
_METHODS = nidaqmx_pb2.DESCRIPTOR.services_by_name["NiDAQmx"].methods_by_name
# Calls that a wait in one of them must not keep from being answered.
_THREADS = 16
_CODES = {
    "overwritten": NiCode.OVERWRITTEN,
    "absent": NiCode.ABSENT,
    "wrong_name": NiCode.NO_SUCH_DEVICE,
    "in_use": NiCode.IN_USE,
    "usb_aborted": NiCode.TRANSFER_ABORTED,
    "wait_timeout": NiCode.NOT_DONE,
    "unknown_code": NiCode.SOFTWARE_ERROR,
}
"""Faults that are an error code and no more."""
_STATUSES = {"internal": grpc.StatusCode.INTERNAL, "exhausted": grpc.StatusCode.RESOURCE_EXHAUSTED}
"""Faults of the server itself, before it asks NI-DAQmx."""
_SPOILING = ("read_timeout", "short_read", "missing_reference", "over_range", "warning")
"""Faults of the next samples."""


class NiServer:
    """The server; runs in whatever process starts it, on threads of its own.

    A server that was stopped can be started again, on the same port; its tasks are gone then.

    source: What is at the inputs.
    product: Model: a key of `wavefocus.mocks.wire.ni_products.PRODUCTS`.
    address: Where to listen; port 0 is any free one.
    faults: The rig's fault plan; operations are the names of the remote procedures.
    speed: How much faster than real time records end, > 0; only for sources that do not wait for the real time.
    serial_number: Of the box.
    credentials: For TLS, as ``security`` in the server's ``server_config.json``; without them it talks in the clear.

    box: The box, to pull its cable, or to read its outputs.
    """

    def __init__(
        self,
        source: SignalSource,
        product: str = "USB-6211",
        device: str = "Dev1",
        address: str = "localhost:0",
        faults: tuple[WireFault, ...] = (),
        speed: float = 1.0,
        *,
        serial_number: int = 0x01E57A2C,
        credentials: grpc.ServerCredentials | None = None,
    ) -> None:
        self.box = NiBox(source, product, device, serial_number, speed)
        self._calls = NiCalls(self.box)
        self._address = address
        self._credentials = credentials
        self._plan = WireFaultPlan("recorder", faults)
        self._log: list[str] = []
        self._under_way: Counter[str] = Counter()
        self._lock = threading.Lock()
        self._server: grpc.Server | None = None
        self._threads: ThreadPoolExecutor | None = None
        self._stopping = threading.Event()
        self._death: threading.Thread | None = None

    @property
    def address(self) -> str:
        """Where it listens, or did."""
        return self._address

    @property
    def log(self) -> tuple[str, ...]:
        """Names of all calls so far that have ended."""
        with self._lock:
            return tuple(self._log)

    @property
    def under_way(self) -> tuple[str, ...]:
        """Names of the calls that are being answered."""
        with self._lock:
            return tuple(self._under_way.elements())

    def start(self) -> str:
        """Listen; returns the address. Raises RuntimeError."""
        self._stopping.clear()
        self._listen()
        return self._address

    def stop(self) -> None:
        """Stop as a killed process does: at once, what is under way stays unanswered."""
        self._stopping.set()
        if self._death is not None:
            self._death.join()
            self._death = None
        self._hang_up()

    # -- listening -------------------------------------------------------------------------------

    def _listen(self) -> None:
        threads = ThreadPoolExecutor(_THREADS, thread_name_prefix="ni-server")
        # Two servers must not share a port, and records are longer than the default 4 MB.
        options = [("grpc.so_reuseport", 0), ("grpc.max_send_message_length", -1)]
        server = grpc.server(threads, options=options)
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(_SERVICE, self._handlers()),))
        try:
            port = (
                server.add_insecure_port(self._address)
                if self._credentials is None
                else server.add_secure_port(self._address, self._credentials)
            )
            if not port:
                raise RuntimeError(f"cannot listen at {self._address}: the port is taken")
            server.start()
        except BaseException:
            threads.shutdown()
            raise
        host, colon, _ = self._address.rpartition(":")
        self._address = f"{host}{colon}{port}"
        with self._lock:
            self._server, self._threads = server, threads

    def _hang_up(self) -> None:
        with self._lock:
            server, threads, self._server, self._threads = self._server, self._threads, None, None
        if server is None or threads is None:
            return
        gone = server.stop(None)
        self.box.forget()
        gone.wait()
        threads.shutdown()

    def _die(self, seconds: float) -> None:
        """Stop from within a call, and rise again if that was ordered."""

        def death() -> None:
            self._hang_up()
            if seconds and not self._stopping.wait(seconds):
                self._listen()

        with self._lock:
            if self._death is None or not self._death.is_alive():
                self._death = threading.Thread(target=death, name="ni-server death")
                self._death.start()

    def _handlers(self) -> dict[str, Any]:
        """What answers each remote procedure; others are answered that they are not implemented."""
        return {
            name: grpc.unary_unary_rpc_method_handler(functools.partial(self.answer, name), *_wire_format(name))
            for name in self._calls.handlers
            if name in _METHODS
        }

    # -- answering -------------------------------------------------------------------------------

    def answer(self, name: str, request: Any, context: grpc.ServicerContext) -> Any:
        """Answer one call, with the faults that it meets."""
        with self._lock:
            self._under_way[name] += 1
        gone = threading.Event()
        if not context.add_callback(gone.set):
            gone.set()

        def alive() -> bool:
            return not gone.is_set()

        try:
            due = self._plan.due(name)
            if refused := next((_STATUSES[fault.kind] for fault in due if fault.kind in _STATUSES), None):
                return context.abort(refused, "on order")
            warning = self._meet(name, due, gone)
            with self.box.condition:
                fields = self._calls.handlers[name](request, alive)
            fields["status"] = int(fields.get("status", 0)) or warning
            return GetMessageClass(_METHODS[name].output_type)(**fields)
        except NiError as error:
            read = (("ni-samps-per-chan-read", "0"),) if name.startswith("Read") else ()
            context.set_trailing_metadata((("ni-error", str(error.code)), *read))
            return context.abort(grpc.StatusCode.UNKNOWN, str(error))
        finally:
            with self._lock:
                self._under_way[name] -= 1
                self._log.append(name)

    def _meet(self, name: str, due: Sequence[WireFault], gone: threading.Event) -> int:
        """Let a call meet its faults; returns the status of an answer that is otherwise good."""
        warning = 0
        for fault in due:
            if fault.kind in _CODES:
                raise NiError(_CODES[fault.kind], "(on order)")
            if fault.kind == "warning" and name != "ReadAnalogF64":
                warning = NiCode.NOT_CALIBRATED
            elif fault.kind in _SPOILING:
                self._calls.spoil(fault)
            elif fault.kind == "unplugged":
                self.box.unplug(fault.seconds)
            elif fault.kind == "silent":
                gone.wait(fault.seconds or None)
            elif fault.kind == "server_dead":
                self._die(fault.seconds)
                gone.wait()
        return warning


def _wire_format(name: str) -> tuple[Any, Any]:
    """How requests of a remote procedure are read and its answers written."""
    return GetMessageClass(_METHODS[name].input_type).FromString, lambda answer: answer.SerializeToString()
