"""Failures of instruments: instrument, operation, cause and remedy."""

from __future__ import annotations


class InstrumentError(Exception):
    """An instrument did not do what it was asked to do.

    instrument: The role and, where known, the device: ``"recorder"``, ``"mirror /dev/ttyUSB0"``.
    operation: What it was asked to do: ``"recording position 12, actuator 3"``.
    cause: What happened instead.
    remedy: What the person at the bench can do about it.

    role: ``"mirror"``, ``"recorder"`` or ``"player"``, set by the caller of the instrument; empty until then.
    """

    def __init__(self, instrument: str, operation: str, cause: str, remedy: str) -> None:
        super().__init__(f"{instrument}: {operation}: {cause}; {remedy}")
        self.instrument = instrument
        self.operation = operation
        self.cause = cause
        self.remedy = remedy
        self.role = ""

    def __reduce__(self) -> tuple[type[InstrumentError], tuple[str, ...], dict[str, object]]:
        """Pickled whole, notes included: some instruments are driven from a process of their own."""
        return type(self), (self.instrument, self.operation, self.cause, self.remedy), self.__dict__


class TransientInstrumentError(InstrumentError):
    """A failure that a new attempt can cure: an underflow, a short read, a late answer."""


class InstrumentLostError(InstrumentError):
    """The instrument is gone and stays gone: unplugged, powered off, never answering."""


class UnknownFaultError(InstrumentLostError):
    """A failure that the driver cannot interpret; it is final if it recurs after one fresh connection."""


class MissingPackageError(InstrumentError):
    """A Python package that a driver needs is not installed; no instrument has failed."""
