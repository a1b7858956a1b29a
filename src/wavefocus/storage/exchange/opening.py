"""Opening files of other formats for import: which format it is, and what it holds."""

from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from importlib import import_module
from pathlib import Path

from wavefocus.options import ImportOptions
from wavefocus.storage import hdf5_reading
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange import IMPORTS, SOME_FORMATS
from wavefocus.storage.exchange.measured import Measured, guarded, readable
from wavefocus.storage.text_file import require_regular

_HEAD_BYTES = 16


def recognised(path: Path) -> str:
    """The format of a file or folder, a key of `IMPORTS`, by its content, else by its ending.

    Raises InputError: there is no such file, it is one of our own, or its format is none of them.
    """
    if path.is_dir():
        return "wav"
    require_regular(path)
    with path.open("rb") as file:
        head = file.read(_HEAD_BYTES)
    found = next((name for name, form in IMPORTS.items() if head.startswith(form.starts or (b"\0none",))), None)
    if head.startswith(IMPORTS["netcdf"].starts[1]):
        with hdf5_reading.opened(path) as content:
            hdf5_reading.require_sound_texts(content)
            if "format" in content.attrs and "format_version" in content.attrs:
                raise InputError(f"{path} is a file of this program ({hdf5_reading.text(content, 'format')})")
            found = "sofa" if "SOFAConventions" in content.attrs else "netcdf"
    found = found or next((name for name, form in IMPORTS.items() if path.suffix.lower() in form.endings), None)
    if found is None:
        raise InputError(f"{path} is of no format that is recognised; name it with --from {'|'.join(IMPORTS)}")
    return found


@contextmanager
def opened(path: Path, kind: str, options: ImportOptions) -> Iterator[Measured]:
    """Open a file or folder of a format, a key of `IMPORTS`; rows are read while it is open.

    Raises InputError: it cannot be read, or a fact is missing that an option can give; also while rows are read.
    """
    form = IMPORTS[kind]
    for option in sorted(SOME_FORMATS.difference(form.options)):
        if getattr(options, option):
            raise InputError(f"--{option} does not concern {form.title}; leave it out")
    if kind != "wav":
        require_regular(path)
    elif not path.is_dir():
        raise InputError(f"{path} is not a folder; --from wav needs a folder of WAV files")
    with ExitStack() as stack:
        with readable(path, form.title):
            measured: Measured = import_module(form.module).read(path, options, stack)
        yield replace(measured, rows=guarded(measured, path, form.title))
