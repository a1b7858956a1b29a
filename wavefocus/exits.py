"""Exit codes of the contract, and which error ends in which."""

from __future__ import annotations

from enum import IntEnum

from drivers.errors import InstrumentError
from storage.errors import BankBusyError, InputError, WavefocusError
from wavefocus.plain_text import one_line


class Exit(IntEnum):
    """Exit codes, as the public contract states them."""

    DONE = 0
    NOT_GOOD_ENOUGH = 1
    WRONG_INPUT = 2
    INSTRUMENT_FAILED = 3
    BANK_BUSY = 75
    STOPPED = 130


def exit_code(failure: BaseException) -> Exit | None:
    """The exit code of an error that people can act on; None for a defect of the program."""
    match failure:
        case KeyboardInterrupt():
            return Exit.STOPPED
        case BankBusyError():
            return Exit.BANK_BUSY
        case InputError() | OSError():
            return Exit.WRONG_INPUT
        case InstrumentError() | WavefocusError():
            return Exit.INSTRUMENT_FAILED
        # What a file asks for can be beyond memory or arithmetic; NumPy's LinAlgError is a ValueError.
        case MemoryError() | ArithmeticError() | ValueError() | RuntimeError():
            return Exit.WRONG_INPUT
    return None


def sentence(failure: BaseException) -> str:
    """The one line that is told about an error."""
    if isinstance(failure, KeyboardInterrupt):
        return "stopped by the user"
    if isinstance(failure, OSError) and failure.filename is not None:
        return one_line(f"{failure.filename}: {failure.strerror}")
    return one_line(str(failure)) or type(failure).__name__


def is_foreseen(failure: BaseException) -> bool:
    """Whether the error's own text says what is wrong and what to do, so that it stands alone."""
    return isinstance(failure, KeyboardInterrupt | InputError | OSError | InstrumentError | WavefocusError)
