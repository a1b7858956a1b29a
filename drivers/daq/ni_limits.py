"""Refusals before the device is asked: each says what the device has instead."""

from __future__ import annotations

from collections.abc import Iterable

from drivers.daq.ni_session import TERMINALS, NiSession
from drivers.daq.ni_task import Wiring
from drivers.errors import InstrumentError
from drivers.protocols import RecordRequest


def check_wiring(session: NiSession, wiring: Wiring) -> None:
    """Refuse inputs, terminal configurations and triggers that the device has not.

    Raises
    ------
    InstrumentError
        Naming what is allowed.
    """

    def refuse(cause: str, remedy: str) -> InstrumentError:
        return InstrumentError(session.instrument, "opening", cause, f"{remedy} of [recorder]")

    product, limits = session.identity.product, session.limits
    keys = ("reference_input", "response_input")
    if wiring.terminal not in TERMINALS:
        raise refuse(f"{wiring.terminal!r} is no terminal configuration", f"put {_or(TERMINALS)} into terminal")
    for key, name in zip(keys, wiring.inputs, strict=True):
        if name not in limits.inputs:
            raise refuse(f"{product} has no input {name!r}", f"put one of {_or(limits.inputs)} into {key}")
    if wiring.inputs[0] == wiring.inputs[1]:
        raise refuse(f"{wiring.inputs[0]} is both inputs", "put two inputs into reference_input and response_input")
    for name in wiring.inputs:
        with session.telling("opening"):
            terminals = session.terminals_of(name)
        if terminals is not None and wiring.terminal not in terminals:
            raise refuse(
                f"{name} of {product} cannot be a {wiring.terminal} input", f"put {_or(terminals)} into terminal"
            )
    if wiring.trigger and limits.triggers is not None and wiring.trigger not in limits.triggers:
        raise refuse(
            f"{product} has no digital input {wiring.trigger!r}",
            f"put {_or(limits.triggers)} into trigger" if limits.triggers else "leave out trigger",
        )


def check_request(session: NiSession, request: RecordRequest, operation: str) -> None:
    """Refuse a record that the device cannot make.

    Raises
    ------
    InstrumentError
        Naming what is allowed.
    """
    product, limits = session.identity.product, session.limits
    if request.samples < 1 or not request.sample_rate_hz > 0:
        raise InstrumentError(
            session.instrument,
            operation,
            f"{request.samples} samples at {request.sample_rate_hz:g} Hz",
            "ask for at least one sample at a rate above 0 Hz",
        )
    if limits.ranges_v is not None:
        for range_v in request.range_v:
            if not any(abs(range_v / known_v - 1) < 1e-6 for known_v in limits.ranges_v):
                raise InstrumentError(
                    session.instrument,
                    operation,
                    f"{product} has no range of {range_v:g} V",
                    f"choose {_or(f'{known_v:g}' for known_v in limits.ranges_v)} V as reference_range_v and "
                    "response_range_v of [recorder]",
                )
    slowest_hz, fastest_hz = limits.slowest_hz or 0.0, limits.fastest_hz or float("inf")
    if not slowest_hz * (1 - 1e-9) <= request.sample_rate_hz <= fastest_hz * (1 + 1e-9):
        raise InstrumentError(
            session.instrument,
            operation,
            f"{product} does not sample two inputs at {request.sample_rate_hz:g} Hz each",
            f"choose {slowest_hz:.3g} to {fastest_hz:g} Hz as sample_rate_hz of [capture]",
        )


def _or(names: Iterable[str]) -> str:
    *most, last = names
    return f"{', '.join(most)} or {last}" if most else last
