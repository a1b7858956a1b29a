"""Errors about files, figures and locks; each is one sentence that a person can act on."""

from __future__ import annotations


class WavefocusError(Exception):
    """Base of the errors that are shown to people in one line."""


class InputError(WavefocusError, ValueError):
    """The input is wrong: the message names file, key, value and what is allowed."""


class OtherLayoutError(InputError):
    """A bank is sound and lies otherwise in its file, as after a copy object by object: it is read, never written."""


class ExistsError(InputError):
    """The file that was to be made is there already; it is untouched."""


class BankBusyError(WavefocusError):
    """Another process owns the bank: the message names host and process id."""


class FileLostError(WavefocusError):
    """The file that is being measured into is no longer the one that its name leads to, or no longer whole."""
