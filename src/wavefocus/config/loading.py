"""Reads configuration files; a mistake is one line with file, key, value and what is allowed.

A file of another kind, such as a bank in place of a scene, is refused by name.
"""

import difflib
import json
import re
import tomllib
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar, get_args, get_origin

from pydantic import BaseModel, ValidationError
from pydantic_core import ErrorDetails

from wavefocus.config.fields import KEPT, models_in
from wavefocus.config.retired import KEYS, refused
from wavefocus.storage.errors import InputError
from wavefocus.storage.text_file import HDF5_SIGNATURE, open_regular, read_text

Model = TypeVar("Model", bound=BaseModel)


MAX_KEY_PARTS = 16
"""Parts of a dotted key; no key of any file has more than four."""
_PART = r"""(?:[\w-]++|"[^"\n]*+"|'[^'\n]*+')"""
_DEEP_KEY = re.compile(rf"(?m)(?:^|[\[{{,])[ \t]*+(?:{_PART}[ \t]*+\.[ \t]*+){{{MAX_KEY_PARTS}}}")


def read_toml(path: Path, wanted: str = "TOML") -> dict[str, Any]:
    """Read a TOML file into plain tables.

    wanted: Kind of file that is needed, for the message where a bank or the like is named in its place.

    Raises InputError: the file cannot be read or is not TOML; the message names the line.
    """
    return parse_toml(read_toml_text(path, wanted), str(path))


def read_toml_text(path: Path, wanted: str = "TOML") -> str:
    """Read the text of a TOML file. Raises InputError: the file cannot be read, or is a bank or the like."""
    if kind := hdf5_kind(path):
        raise InputError(printable(f"{path}: this is a {kind}; a {wanted} file is needed"))
    try:
        return read_text(path)
    except InputError as error:
        raise InputError(printable(str(error))) from None


def parse_toml(text: str, source: str) -> dict[str, Any]:
    """Read TOML text into plain tables.

    Raises InputError: it is not TOML; the message names the line.
    """
    if (deep := _DEEP_KEY.search(text)) is not None:  # the parser's time grows with the square of a key's parts
        line = text.count("\n", 0, deep.start()) + 1
        raise InputError(printable(f"{source}: not TOML: line {line}: a key of more than {MAX_KEY_PARTS} parts"))
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        # What a path of Windows in double quotes leads to.
        is_path = any(words in str(error) for words in ("Unescaped '\\'", "Invalid hex value"))
        remedy = "; a path stands in single quotes, as 'C:\\lab\\rig.toml'" if is_path else ""
        raise InputError(printable(f"{source}: not TOML: {error}{remedy}")) from None
    except (RecursionError, ValueError):  # ValueError: a whole number of thousands of digits
        raise InputError(printable(f"{source}: not TOML: nested too deeply, or a number too long")) from None


def validated(model: type[Model], data: object, source: str, *, kept: bool = False) -> Model:
    """Validate plain tables against a model.

    kept: They were kept in a bank, where keys of earlier versions are passed over.

    Raises InputError: one line with the first few mistakes.
    """
    if wrong := _other_kind(model.__name__, data):
        raise InputError(printable(f"{source}: {wrong}"))
    try:
        try:
            return model.model_validate(data, context=KEPT if kept else None)
        except ValidationError as failure:
            raise InputError(one_line(source, failure, model, data)) from None
    except RecursionError:
        raise InputError(printable(f"{source}: nested too deeply")) from None


@contextmanager
def naming_key(file: Path, key: str) -> Iterator[None]:
    """Name file and key in an InputError of the block that does not name the file."""
    try:
        yield
    except InputError as error:
        text = str(error)
        raise InputError(printable(text if text.startswith(str(file)) else f"{file}: {key}: {text}")) from None


def named_file(path: Path, key: str, name: str) -> Path:
    """Find a file that a configuration names.

    Raises InputError: there is no such file.
    """
    try:
        named = path.parent / name
        if named.is_file():
            return named
    except (OSError, ValueError):  # a name that no file can have
        pass
    raise InputError(printable(f"{path}: {key} = {shown(name)}: must be a file; none found from {path.parent}/"))


_UNIT_SUFFIXES = (
    "_m_s_per_v", "_mm_s", "_mrad", "_deg", "_db", "_mm", "_ms", "_hz", "_khz", "_rad", "_mv",
    "_cm", "_um", "_us", "_samples", "_m", "_s", "_v",
)  # fmt: skip

# Of an address only its kind is shown: it may hold a password. A mirror's port has none.
ADDRESS = re.compile(r"\s*(?!socket)([A-Za-z][A-Za-z0-9+.-]*)://")

# Tables and keys whose values are addresses with passwords in them, also where they stand in a wrong place.
_SECRETS = frozenset({"messages", "message", "urls", "url"})

_SENTENCES: Mapping[str, str] = {
    "float_type": "must be a number",
    "finite_number": "must be a finite number",
    "int_type": "must be a whole number",
    "int_from_float": "must be a whole number",
    "string_type": "must be text in quotes",
    "string_too_short": "must not be empty",
    "bool_type": "must be true or false",
    "greater_than": "must be above {gt:g}",
    "greater_than_equal": "must be at least {ge:g}",
    "less_than": "must be below {lt:g}",
    "less_than_equal": "must be at most {le:g}",
    "literal_error": "must be {expected}",
    "missing": "is missing",
    "tuple_type": "must be a list",
    "list_type": "must be a list",
    "too_long": "must have at most {max_length} entries, has {actual_length}",
    "too_short": "must have at least {min_length} entries, has {actual_length}",
    "model_type": "must be a table",
    "model_attributes_type": "must be a table",
    "dict_type": "must be a table",
    "union_tag_invalid": "must be one of {expected_tags}",
    "union_tag_not_found": "must have a kind",
}


def one_line(source: str, failure: ValidationError, model: type[BaseModel], data: object) -> str:
    """Return the mistakes in one line, the first few joined by semicolons."""
    errors = _shown_errors(failure)
    shown = [sentence(error, model, data) for error in errors[:3]]
    if len(errors) > len(shown):
        shown.append(f"and {len(errors) - len(shown)} more")
    return printable(f"{source}: {'; '.join(shown)}")


def mistakes(model: type[BaseModel], data: object) -> list[tuple[tuple[int | str, ...], str]]:
    """Location and sentence of each mistake of plain tables; none where the model takes them."""
    if wrong := _other_kind(model.__name__, data):
        return [((), wrong)]
    try:
        model.model_validate(data)
    except ValidationError as failure:
        return [(location(error, data), printable(sentence(error, model, data))) for error in _shown_errors(failure)]
    return []


def _shown_errors(failure: ValidationError) -> list[ErrorDetails]:
    errors = failure.errors(include_url=False)
    return [error for error in errors if not _follows(error, errors)]


def _follows(error: ErrorDetails, errors: Sequence[ErrorDetails]) -> bool:
    """Whether a list is reported as too short only because pydantic does not count its wrong entries."""
    place = error["loc"]
    beneath = (other["loc"] for other in errors if len(other["loc"]) > len(place))
    return error["type"] == "too_short" and any(other[: len(place)] == place for other in beneath)


def location(error: ErrorDetails, data: object) -> tuple[int | str, ...]:
    """Where a mistake is: keys and numbers of list entries, from the file's top."""
    steps = _without_tags(error["loc"], data)
    if error["type"] == "mistake":
        return (*steps, *(part for part in str(error["ctx"]["key"]).split(".") if part))
    tagged = error["type"] == "union_tag_invalid" and isinstance(error["input"], Mapping)
    return (*steps, "kind") if tagged else steps


def sentence(error: ErrorDetails, model: type[BaseModel], data: object) -> str:
    """Return one mistake as text: key, value and what is allowed."""
    steps = location(error, data)
    context: dict[str, Any] = error.get("ctx", {})
    kind = error["type"]
    secret = not _SECRETS.isdisjoint(steps)
    if kind == "extra_forbidden" and secret:
        known = _known_keys(model, steps, data)
        # A key may be a mistaken address itself.
        steps = steps if known.startswith("did you mean") or steps[-1] in _SECRETS else (*steps[:-1], "...")
        return f"{dotted(steps)}: unknown key; {known}"
    if kind == "extra_forbidden" and (gone := KEYS.get(str(steps[-1]))):
        return f"{dotted(steps[:-1])}: {refused(str(steps[-1]), gone)}"
    if kind == "extra_forbidden":
        return f"{dotted(steps)} = {shown(error['input'])}: unknown key; {_known_keys(model, steps, data)}"
    if kind == "missing":
        return f"{dotted(steps)}: is missing"
    value = error["input"]
    if kind == "mistake":
        value = context["value"]
    elif kind == "union_tag_invalid" and isinstance(value, Mapping):
        value = value["kind"]
    elif kind in ("list_type", "tuple_type") and isinstance(value, Mapping) and not secret:
        return f"{dotted(steps)}: must be a list of tables, each under [[{dotted(steps)}]]"
    template = _SENTENCES.get(kind)
    allowed = error["msg"] if template is None else template.format(**context).replace("'", '"')
    holds = "" if value is None or secret else f" = {shown(value)}"
    return f"{dotted(steps)}{holds}: {allowed}"


def _without_tags(location: Sequence[int | str], data: object) -> tuple[int | str, ...]:
    """Drop from an error's location the kinds that pydantic adds after a table chosen by its ``kind``."""
    steps: list[int | str] = []
    here = data
    for step in location:
        if isinstance(here, Mapping) and step not in here and step == here.get("kind"):
            continue
        steps.append(step)
        try:
            here = here[step]  # type: ignore[index]
        except (TypeError, KeyError, IndexError):
            here = None
    return tuple(steps)


def dotted(steps: Sequence[int | str]) -> str:
    """Write a location as in the documentation: ``source[0].path.radius_mm``."""
    text = ""
    for step in steps:
        if isinstance(step, int) or step.startswith("["):
            text += f"[{step}]" if isinstance(step, int) else step
        else:
            text += f".{step}" if text else step
    return text


def shown(value: object) -> str:
    """Write a value as TOML would, cut short where it is long."""
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str) and (address := ADDRESS.match(value)):
        text = f'"{address[1]}://..."'
    elif isinstance(value, str):
        text = printable(json.dumps(value[:60], ensure_ascii=False))
    elif isinstance(value, Mapping):
        text = "{ " + ", ".join(str(key) for key in islice(value, 60)) + " }"
    elif isinstance(value, list | tuple):
        text = "[" + ", ".join(shown(entry) for entry in value[:8]) + (", ..." if len(value) > 8 else "") + "]"
    else:
        text = _number(value)
    return text if len(text) <= 60 else text[:56] + " ..."


def printable(text: str) -> str:
    """Keep a message in one line: whatever would start another is written as an escape."""
    return "".join(letter if letter.isprintable() else repr(letter)[1:-1] for letter in text)


def _number(value: object) -> str:
    try:
        return str(value)
    except ValueError:  # Python refuses to write out whole numbers of thousands of digits
        return "a number of thousands of digits"


def _known_keys(model: type[BaseModel], steps: Sequence[int | str], data: object) -> str:
    """What may stand in place of an unknown key: the nearest key, the right table, or the list."""
    table = _table_at(model, steps[:-1], data)
    key = str(steps[-1])
    if table is None:
        return "is not allowed here"
    known = [field.alias or name for name, field in table.model_fields.items()]
    guess = _nearest(key, known)
    if guess:
        return f"did you mean {guess}?"
    for name, field in model.model_fields.items():
        for candidate in models_in(field.annotation):
            if key in candidate.model_fields and candidate is not table:
                several = get_origin(field.annotation) is tuple
                return f"it belongs to [[{name}]]" if several else f"it belongs to [{name}]"
    return f"allowed: {', '.join(known)}"


def _nearest(key: str, known: Sequence[str]) -> str | None:
    """The key that differs in its unit alone, else the one spelled most alike."""
    for name in known:
        if _stem(name) == _stem(key.lower()):
            return name
    close = difflib.get_close_matches(key.lower(), known, n=1, cutoff=0.7)
    return close[0] if close else None


def _stem(key: str) -> str:
    for suffix in _UNIT_SUFFIXES:
        if key.endswith(suffix) and len(key) > len(suffix):
            return key.removesuffix(suffix)
    return key


def _table_at(model: type[BaseModel], steps: Sequence[int | str], data: object) -> type[BaseModel] | None:
    """The model of the table at a location, chosen by ``kind`` where several fit."""
    table: type[BaseModel] | None = model
    candidates: list[type[BaseModel]] = [model]
    for step in steps:
        data = data[step] if isinstance(data, Mapping | list | tuple) else None  # type: ignore[index]
        if isinstance(step, str) and table is not None:
            field = table.model_fields.get(step)
            candidates = list(models_in(field.annotation)) if field else []
        table = _of_kind(candidates, data)
    return table


def _of_kind(candidates: Sequence[type[BaseModel]], data: object) -> type[BaseModel] | None:
    if len(candidates) == 1:
        return candidates[0]
    kind = data.get("kind") if isinstance(data, Mapping) else None
    return next((table for table in candidates if kind in get_args(table.model_fields["kind"].annotation)), None)


_OWN_TABLES = {
    "rig": {"surface", "actuators", "mirror", "recorder", "player", "vibrometer", "recovery", "watch", "messages",
            "usb", "emulation"},
    "run": {"grid", "sweep", "capture", "quality", "drift", "tolerance", "settled"},
    "scene": {"scene", "source", "quiet"},
    "trials": {"trials", "stimuli", "adaptive", "masking"},
}  # fmt: skip
"""Tables that only one kind of TOML file has."""
_MODELS = {"RigConfig": "rig", "RunConfig": "run", "SceneConfig": "scene", "TrialsConfig": "trials",
           "CalibrationRecord": "calibration"}  # fmt: skip
_HDF5 = {
    "wavefocus-bank": "bank", "wavefocus-raw": "file of raw recordings", "wavefocus-drive": "drive file",
    "wavefocus-field": "field file",
}  # fmt: skip


def kind_of_tables(data: Mapping[str, Any]) -> str:
    """Kind of a TOML file by its tables: ``"rig"``, ``"run"``, ``"scene"``, ``"trials"`` or ``"calibration"``.

    Empty where it may be any, or is of none of them.
    """
    if "format" in data:  # only calibration files have it, whatever it says
        return "calibration" if data["format"] == "wavefocus-calibration" else ""
    shared = {kind: len(tables & data.keys()) for kind, tables in _OWN_TABLES.items()}
    shared["rig"] += isinstance(data.get("rig"), Mapping)  # a run file has the name of a rig file there
    most = max(shared.values())
    kinds = [kind for kind, count in shared.items() if count == most]
    return kinds[0] if most and len(kinds) == 1 else ""


def _other_kind(model: str, data: object) -> str:
    """What is wrong where tables are of another kind of file than a model's, as a sentence; empty where they are not.

    model: Name of the model's class.
    """
    wanted = _MODELS.get(model, "")
    found = kind_of_tables(data) if isinstance(data, Mapping) else ""
    return f"this is a {found} file; a {wanted} file is needed" if wanted and found and found != wanted else ""


def hdf5_kind(path: Path) -> str:
    """Kind of an HDF5 file in words, as ``"bank"``; empty where a file is not HDF5 or cannot be read."""
    try:
        with open_regular(path) as file:
            if file.read(len(HDF5_SIGNATURE)) != HDF5_SIGNATURE:
                return ""
    except (OSError, ValueError):
        return ""
    from wavefocus.storage import hdf5_reading  # with it comes h5py, which most files do not need

    try:
        with hdf5_reading.opened(path) as content:
            if "green" in content:
                return "bank"
            return _HDF5.get(hdf5_reading.text(content, "format") or "", "HDF5 file")
    except InputError:
        return "HDF5 file"
