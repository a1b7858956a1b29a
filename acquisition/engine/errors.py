"""Errors of a campaign."""

from storage.errors import WavefocusError


class DriftError(WavefocusError):
    """The plate measured now is not the plate that is in the bank."""


class SuspendedTooLongError(WavefocusError):
    """A watched condition left its band and did not come back."""
