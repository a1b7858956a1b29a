"""The channel to NI's gRPC Device Server: every call has a deadline, and every warning is heard."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any, NamedTuple

from drivers.daq.ni_errors import ServerSilentError

# Resetting and testing a device takes seconds.
SLOW_CALLS = {"ResetDevice": 30.0, "SelfTestDevice": 30.0}
# Pauses before a call is made again that the server refused for now.
PAUSES_S = (0.05, 0.2, 0.5)


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


def open_channel(address: str, answer_s: float, tls: TlsFiles | None = None) -> Any:
    """A fresh channel, with nothing in common with an earlier one to the same server.

    The nidaqmx package gives its calls no deadline. Here each has one: the time that the call itself asks for
    plus `answer_s`. Once a deadline has passed, further calls fail at once, for a server that is silent would
    cost as much again for each of the calls that clear up.

    Parameters
    ----------
    address : str
        ``"host:port"``.
    answer_s : float
        How long a call may take beyond what it asks for, in s, > 0.
    tls : TlsFiles, optional
        For a server with a certificate; without them the channel is in the clear.

    Returns
    -------
    grpc.Channel
        To be closed by the caller.

    Raises
    ------
    OSError
        A file of `tls` cannot be read.
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
            for pause_s in PAUSES_S:
                if not _can_be_made_again(name, outcome.code()):
                    break
                time.sleep(pause_s)
                outcome = continuation(bounded, request)
            if outcome.code() is grpc.StatusCode.DEADLINE_EXCEEDED:
                self._silence = f"{name} got no answer within {deadline_s:g} s"
                raise ServerSilentError(self._silence)
            status = getattr(outcome.result(), "status", 0)
            if status > 0:
                known = {warning.value: warning.name for warning in DAQmxWarnings}
                raise DaqWarning(f"{name}: {known.get(status, 'unknown warning')}", status)
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


def _can_be_made_again(name: str, code: Any) -> bool:
    """Whether a call was refused before it was carried out, or only asks and changes nothing."""
    import grpc

    return code is grpc.StatusCode.RESOURCE_EXHAUSTED or (code is grpc.StatusCode.INTERNAL and name.startswith("Get"))


def asked_s(request: Any) -> float:
    """How long a request itself allows, in s; 0 where it says nothing."""
    for field in ("timeout", "time_to_wait"):
        value = getattr(request, field, None)
        if isinstance(value, float) and value > 0:
            return value
    return 0.0
