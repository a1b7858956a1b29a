"""Exit codes of the contract, the error that ends in each, and text that is safe to show."""

import traceback
import unicodedata
from collections.abc import Sequence
from enum import IntEnum
from pathlib import Path
from tempfile import NamedTemporaryFile

from wavefocus.drivers.errors import InstrumentError, MissingPackageError
from wavefocus.storage.errors import BankBusyError, InputError, WavefocusError
from wavefocus.storage.text_file import permission_words

STAND_IN = "wavefocus_stand_in"
"""Attribute of a standard stream that was closed when the process began, and has the null device in its place."""


class Exit(IntEnum):
    """Exit codes, as the public contract states them."""

    DONE = 0
    NOT_GOOD_ENOUGH = 1
    WRONG_INPUT = 2
    INSTRUMENT_FAILED = 3
    DEFECT = 70
    BANK_BUSY = 75
    STOPPED = 130


def exit_code(failure: BaseException) -> Exit:
    """The exit code of an error, by what it means to a person; what no check foresees is a defect of the program."""
    match failure:
        case KeyboardInterrupt():
            return Exit.STOPPED
        case BankBusyError():
            return Exit.BANK_BUSY
        case ModuleNotFoundError() if _missing_package(failure):
            return Exit.WRONG_INPUT
        case InputError() | OSError() | MissingPackageError():
            return Exit.WRONG_INPUT
        case _ if _is_beyond_memory(failure):  # what a file asks for can be
            return Exit.WRONG_INPUT
        case InstrumentError() | WavefocusError():
            return Exit.INSTRUMENT_FAILED
    return Exit.DEFECT


def _is_beyond_memory(failure: BaseException) -> bool:
    """Whether the system gave no more memory, or no further thread, which Python reports in words alone."""
    return isinstance(failure, MemoryError) or (
        isinstance(failure, RuntimeError) and str(failure) == "can't start new thread"
    )


def sentence(failure: BaseException) -> str:
    """The one line that reports an error."""
    if isinstance(failure, KeyboardInterrupt):
        return "stopped by the user"
    if _is_beyond_memory(failure):
        return one_line(f"not enough memory: {failure}")
    if isinstance(failure, OSError) and failure.filename is not None:
        denied = permission_words(Path(failure.filename)) if isinstance(failure, PermissionError) else ""
        return one_line(f"{failure.filename}: {failure.strerror}{denied}")
    if isinstance(failure, ModuleNotFoundError) and (package := _missing_package(failure)):
        installed = f"wavefocus[{EXTRAS[package]}]" if package in EXTRAS else package
        return f'the Python package {package} is not installed: pip install "{installed}"'
    return one_line(str(failure)) or type(failure).__name__


def account(failure: BaseException, code: Exit, arguments: Sequence[str]) -> str:
    """The one line about an error; with the files of the command line where its own text names none."""
    if code is Exit.STOPPED:
        return sentence(KeyboardInterrupt())
    if code is not Exit.DEFECT and not _is_beyond_memory(failure):
        return sentence(failure)
    named = [word.partition("=")[2] if word.startswith("--") else word for word in arguments]
    files = "".join(f"{word}: " for word in named if Path(word).is_file())
    if code is not Exit.DEFECT:
        return one_line(f"{files}{sentence(failure)}")
    kind = type(failure).__name__
    said = "" if sentence(failure) == kind else f": {sentence(failure)}"
    return one_line(f"{files}defect of the program: {kind}{said}; {_logged(failure)}")


def _logged(failure: BaseException) -> str:
    """Write the traceback to a new file, and say where it is."""
    text = "".join(traceback.format_exception(failure))
    try:
        with NamedTemporaryFile(
            "w", prefix="wavefocus-defect-", suffix=".log", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:
            file.write(text)
    except OSError:
        return "WAVEFOCUS_TRACEBACK=1 shows where"
    return f"please report it with {file.name}, which says where"


# Packages that only some commands need, by the extra of pyproject.toml that installs them.
EXTRAS = {
    "PyQt5": "window", "pyqtgraph": "window", "grpc": "remote", "jack": "emulate", "skfem": "plates",
    "xarray": "exchange", "h5netcdf": "exchange", "apprise": "notify", "dask": "cluster", "distributed": "cluster",
}  # fmt: skip


def _missing_package(failure: ModuleNotFoundError) -> str:
    """The package that is not installed; empty where a module of wavefocus itself is missing, which is a defect."""
    package = (failure.name or "").partition(".")[0]
    return "" if package == "wavefocus" else package


# Control, format (bidirectional overrides among them), surrogate, line and paragraph separator.
_UNSAFE = frozenset({"Cc", "Cf", "Cs", "Zl", "Zp"})
_LONGEST = 900


def escaped(text: str) -> str:
    r"""Return a text with control and bidirectional characters as escapes (``\x1b``); line ends and tabs stay."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(
        letter.encode("unicode_escape").decode()
        if unicodedata.category(letter) in _UNSAFE and letter not in "\n\t"
        else letter
        for letter in text
    )


def one_line(text: str, longest: int = _LONGEST) -> str:
    """A message as one escaped line of bounded length: what is too long loses its middle."""
    line = escaped(" ".join(text.split()))
    if len(line) <= longest:
        return line
    head = longest // 2
    tail = longest - head - 5
    return f"{line[:head]} ... {line[-tail:]}"
