"""Banks in Python: estimated, imported and exported as the commands do, with paths or open files, without printing."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import MISSING, dataclass, fields
from importlib import import_module
from inspect import Parameter, signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, ParamSpec, TypeVar

import numpy as np

from wavefocus.options import ExportOptions, ImportOptions
from wavefocus.storage.argument_types import Positions, check_fields, checked
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.rendering.greens.source import GreenSource

OnProgress = Callable[[int, int], None]
P = ParamSpec("P")
R = TypeVar("R")
Options = TypeVar("Options")
LOG = logging.getLogger("wavefocus")


@dataclass(frozen=True, slots=True)
class Export:
    """An export: what was written, about how many bytes, and what was left out or is NaN."""

    out: Path
    format: str
    positions: int
    left_out: int
    nan: int
    actuators: int
    taps: int
    sample_rate_hz: float
    response_unit: str
    files: tuple[str, ...]
    bytes: int
    publication: Mapping[str, str]


def taking(kind: type[Any]) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Let a function take the fields of a class of `wavefocus.options` by name.

    Its signature, and its docstring below ``options``, list them as the command line does.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        own = signature(function)
        *former, _ = own.parameters.values()
        parameters, sentences = [], []
        for one in fields(kind):
            default = {} if one.default is MISSING else one.default
            parameters.append(Parameter(one.name, Parameter.KEYWORD_ONLY, default=default, annotation=one.type))
            sentences.append(f"{one.name}\n        {one.metadata['help']}")
        vars(function)["__signature__"] = own.replace(parameters=[*former, *parameters])
        listed = "\n    ".join(sentences)
        function.__doc__ = (function.__doc__ or "").replace("options\n        As listed.", listed)
        return function

    return decorate


def options_from(kind: type[Options], given: Mapping[str, Any]) -> Options:
    """An object of options from keyword arguments; None stands for a default, and a path may be a text.

    Raises InputError: a value is of another type, or out of its bounds.
    """
    known = {one.name: one for one in fields(kind)}  # type: ignore[arg-type]
    values = {name: value for name, value in given.items() if value is not None}
    for name, value in values.items():
        if name in known and isinstance(value, str) and "Path" in str(known[name].type):
            values[name] = Path(value)
    made = kind(**values)
    check_fields(made)
    for name, value in values.items():
        about = known[name].metadata
        if isinstance(value, int | float) and not about["low"] <= value <= about["high"]:
            raise InputError(f"{name} is {value:g}; {about['low']:g} to {about['high']:g} are allowed")
    return made


@taking(ImportOptions)
@checked
def import_bank(
    source: str | Path,
    bank: str | Path,
    kind: Literal["", "sofa", "uff", "mat", "npz", "npy", "netcdf", "wav"] = "",
    *,
    force: bool = False,
    on_progress: OnProgress | None = None,
    **options: Any,
) -> Bank:
    """Make a bank of responses that were measured elsewhere, as ``wavefocus import``.

    Frequency responses become causal impulse responses. A fact that the file lacks is asked for by an error, never
    guessed; errors and warnings spell parameters as the command line does: ``--swap-roles`` is ``swap_roles``.

    Parameters
    ----------
    source
        The file; for ``"wav"`` a folder.
    bank
        Path of the bank to write.
    kind
        Format of the file; recognised by default.
    force
        Whether an older file of that name may be replaced; a bank never is.
    on_progress
        Called with the positions done and the positions in all.
    options
        As listed.

    Returns
    -------
    Bank
        Open for reading. ``import_report`` is a JSON text: what was read, assumed and left out, and warnings, which
        also go to the logger ``wavefocus``.

    Raises
    ------
    InputError
        The file cannot be read, lacks a fact that a parameter can give, or the bank may not be written.

    Examples
    --------
    >>> import numpy as np
    >>> import wavefocus as wf
    >>> green = np.zeros((3, 2, 400))
    >>> green[:, :, 7] = 1e-3
    >>> np.savez("other.npz", green=green, sample_rate_hz=8000.0, position_mm=[[0, 0], [5, 0], [0, 5]])
    >>> with wf.import_bank("other.npz", "imported.h5", unit="mm/s/V") as bank:
    ...     print(bank.green(1).shape, bank.response_unit)
    (2, 400) mm/s/V
    """
    from wavefocus.calibration.imports import bank as imports

    chosen = options_from(ImportOptions, options)
    facts, _ = imports.import_bank(Path(source), Path(bank), chosen, kind, on_progress, force=force)
    for warning in facts["warnings"]:
        LOG.warning("%s: %s", source, warning)
    return open_bank(bank)


@taking(ExportOptions)
@checked
def export_bank(
    bank: Bank | str | Path,
    out: str | Path,
    to: Literal["sofa", "uff", "wav", "mat", "npz", "netcdf", "csv"],
    *,
    positions: Positions | None = None,
    force: bool = False,
    on_progress: OnProgress | None = None,
    **options: Any,
) -> Export:
    """Write a bank in the format of another field, as ``wavefocus export``.

    Parameters
    ----------
    bank
        An open bank, or its path.
    out
        The file to write; for ``"wav"`` a folder.
    to
        The format.
    positions
        Rows of the bank, in any order, or a mask of them; by default all.
    force
        Whether older files of these names may be replaced; banks never are.
    on_progress
        Called with the positions done and the positions in all.
    options
        As listed.

    Returns
    -------
    Export
        Names and about how many ``bytes`` of the ``files``, and how many ``positions`` they hold, ``left_out`` or as
        ``nan``.

    Raises
    ------
    InputError
        The bank does not fit the format, or a file may not be written.

    Examples
    --------
    >>> import wavefocus as wf
    >>> wf.export_bank("plate.h5", "plate.mat", "mat", positions=[0, 7]).files
    ('plate.mat',)
    """
    return export_by_options(
        bank, Path(out), to, options_from(ExportOptions, options), positions, on_progress, force=force
    )


def export_by_options(
    bank: Bank | str | Path,
    out: Path,
    to: str,
    options: ExportOptions,
    positions: Positions | None = None,
    on_progress: OnProgress | None = None,
    *,
    force: bool = False,
) -> Export:
    """Write a bank as the options say; see `export_bank`."""
    from wavefocus.configuration import publication_of
    from wavefocus.storage.exchange import EXPORTS
    from wavefocus.storage.exchange.exported_rows import choose_rows
    from wavefocus.storage.output_files import require_outputs, require_replaceable_folder
    from wavefocus.storage.sidecar_files import clear_leftovers

    missing_as_nan, form, publication = options.missing == "nan", EXPORTS[to], options.publication
    if missing_as_nan and not form.holds_nan:
        raise InputError(f"missing nan: {to} files hold no NaN; missing positions are left out there")
    if options.binary and to != "uff":
        raise InputError(f"binary: is for uff; {to} files are always the same")
    if out.exists() and out.is_dir() != form.folder:
        raise InputError(f"{out} is a {'folder' if out.is_dir() else 'file'}; {to} writes a "
                         f"{'folder of files' if form.folder else 'file'}")  # fmt: skip
    with open_bank(bank) if isinstance(bank, str | Path) else nullcontext(bank) as view:
        inputs = [view.path, *([publication] if publication else [])]
        if out.parent.is_dir():
            clear_leftovers(out.parent)  # what an export that was killed all but finished
        if not form.folder:
            require_outputs((out,), inputs, force=force)
        view.require_sound(positions)
        texts = publication_of(view, publication).texts
        if view.notes:
            texts["notes"] = "\n".join(map(str, view.notes))
        rows = choose_rows(view, positions, missing_as_nan=missing_as_nan, binary=options.binary, publication=texts)
        writer = import_module(f"wavefocus.storage.exchange.{form.module}")
        names = writer.file_names(rows) if form.folder else [out.name]
        if form.folder:
            ours = writer.older_files(out) | set(names)
            require_replaceable_folder(out, ours, inputs, by="export", force=force)
        writer.write(out, rows, on_progress or (lambda done, total: None))
        per_value = 4 if options.binary else form.value_bytes
        return Export(
            out, to, len(rows.row), rows.left_out, int(np.count_nonzero(~rows.known)), view.actuators, view.taps,
            view.sample_rate_hz, view.response_unit, tuple(names),
            len(rows.row) * (view.actuators * view.taps * per_value + 100), dict(rows.publication),
        )  # fmt: skip


@contextmanager
def opened_bank(bank: GreenSource | str | Path) -> Iterator[GreenSource]:
    """The bank, opened and closed where it is a path. Raises InputError: it is neither a path nor a bank."""
    from wavefocus.rendering.greens.source import require_source

    if not isinstance(bank, str | Path):
        require_source(bank)
    with open_bank(bank) if isinstance(bank, str | Path) else nullcontext(bank) as view:
        if isinstance(view, Bank):
            view.require_sound()
        yield view
