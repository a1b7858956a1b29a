"""How arguments are declared and command lines are read; a mistake names the argument and what was meant."""

import argparse
import difflib
import math
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import Field, fields
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, NamedTuple, NoReturn, Union, cast, get_args, get_origin, get_type_hints

from wavefocus.config.retired import OPTIONS, refused
from wavefocus.storage.errors import InputError


class Argument(NamedTuple):
    """One argument of a command: its flags or its name, and its settings for argparse."""

    names: tuple[str, ...]
    settings: Mapping[str, Any]


class Command(NamedTuple):
    """One command.

    `run` is ``"module:function"`` in `wavefocus.commands` or an adapter; the first paragraph of `help` stands in the
    list of commands; `arguments` are in the order of the help; `options` is the class of the function's argument
    ``options``.
    """

    name: str
    run: str | Callable[..., Any]
    help: str
    arguments: tuple[Argument, ...]
    options: type[Any] | None = None


def argument(*names: str, **settings: Any) -> Argument:
    """Declare an argument, as ``add_argument`` of argparse does."""
    return Argument(names, settings)


def file(*names: str, **settings: Any) -> Argument:
    """Declare a file or folder."""
    return Argument(names, {"type": Path, **settings})


def switch(name: str, dest: str = "", *, off: bool = False, help: str) -> Argument:
    """Declare an option without a value; `off` where it is False when given."""
    named = {"dest": dest} if dest else {}
    return Argument((name,), {"action": "store_false" if off else "store_true", "help": help, **named})


def number(
    name: str, low: float = -math.inf, high: float = math.inf, *, help: str, whole: bool = False, **settings: Any
) -> Argument:
    """Declare an option that takes a finite number within bounds, which its help repeats."""

    def read(text: str) -> float:
        try:
            value = int(text) if whole else float(text)
        except ValueError:
            raise argparse.ArgumentTypeError(f"{text!r} is not a {'whole ' if whole else ''}number") from None
        if not math.isfinite(value):
            raise argparse.ArgumentTypeError(f"{text} is not a finite number")
        if not low <= value <= high:
            raise argparse.ArgumentTypeError(f"{text} is out of range; allowed: {bounds}")
        return value

    bounds = f"{low:g} to {high:g}" if math.isfinite(high) else f"at least {low:g}"
    notes = [bounds] if math.isfinite(low) else []
    if settings.get("default") is not None:
        notes.append(f"default: {settings['default']:g}")
    text = f"{help} [{'; '.join(notes)}]" if notes else help
    return Argument((name,), {"type": read, "metavar": "N", "help": text, **settings})


def pair(text: str) -> tuple[float, float]:
    """Read two finite numbers, as ``"50,450"``."""
    try:
        first, second = (float(part) for part in text.split(","))
    except ValueError:
        first = second = math.nan
    if not (math.isfinite(first) and math.isfinite(second)):
        raise argparse.ArgumentTypeError(f"{text!r} is not a pair of finite numbers, as 50,450")
    return first, second


def _pair_or_file(text: str) -> tuple[float, float] | Path:
    """Read two finite numbers; any other text is a path."""
    try:
        return pair(text)
    except argparse.ArgumentTypeError:
        return Path(text)


class _Add(argparse.Action):
    """Adds ``"green=H"`` to a mapping of our names to the file's."""

    def __call__(self, parser: argparse.ArgumentParser, given: argparse.Namespace, text: Any, *_: object) -> None:
        ours, _, theirs = text.partition("=")
        if not ours or not theirs:
            raise argparse.ArgumentError(self, f"{text!r} is not OURS=THEIRS")
        setattr(given, self.dest, {**getattr(given, self.dest), ours: theirs})


def options_of(kind: type[Any], *names: str) -> tuple[Argument, ...]:
    """The arguments that fill the fields of a class of `wavefocus.options`; by default all."""
    types = get_type_hints(kind)
    return tuple(_option(one, types[one.name]) for one in fields(kind) if not names or one.name in names)


def _option(one: Field[Any], kind: Any) -> Argument:
    about, default = one.metadata, cast(Any, one.default)
    name = about["name"] or f"--{one.name.replace('_', '-')}"
    settings: dict[str, Any] = {"dest": one.name, "default": default, "help": about["help"], **about["settings"]}
    kinds = (
        [part for part in get_args(kind) if part is not NoneType] if get_origin(kind) in (Union, UnionType) else [kind]
    )
    match kinds:
        case [type() as plain] if plain is bool:
            return switch(name, one.name, off=default, help=about["help"])
        case [type() as plain] if plain in (int, float):
            return number(name, about["low"], about["high"], whole=plain is int, **settings)
        case [type() as plain] if plain is Path:
            return file(name, **settings)
        case [_, type()]:
            return argument(name, type=_pair_or_file, **settings)
        case [one_kind] if get_origin(one_kind) is Literal:
            return argument(name, choices=tuple(filter(None, get_args(one_kind))), **settings)
        case [one_kind] if get_args(one_kind) == (float, float):
            return argument(name, type=pair, **settings)
        case [one_kind] if get_origin(one_kind) is tuple:
            return argument(name, type=_words(default), **settings)
        case [one_kind] if get_origin(one_kind) is Mapping:
            return argument(name, action=_Add, **settings | {"default": {}})
    return argument(name, **settings)


def _words(allowed: Sequence[str]) -> Callable[[str], tuple[str, ...]]:
    def read(text: str) -> tuple[str, ...]:
        words = tuple(word.strip() for word in text.split(","))
        for word in words:
            if word not in allowed:
                raise argparse.ArgumentTypeError(f"{word!r} is not known; allowed: {', '.join(allowed)}")
        return words

    return read


class _Formatter(argparse.HelpFormatter):
    """Help whose paragraphs are wrapped one by one; indented lines stay as they are."""

    def __init__(self, prog: str) -> None:
        super().__init__(prog, max_help_position=32)

    def _fill_text(self, text: str, width: int, indent: str) -> str:
        return "\n\n".join(one if "\n  " in one else textwrap.fill(one, width) for one in text.split("\n\n"))


class Parser(argparse.ArgumentParser):
    """Raises `InputError` in place of ending the process; reads -1e-3 as a number and not as an option."""

    def __init__(self, **settings: Any) -> None:
        super().__init__(formatter_class=_Formatter, allow_abbrev=False, **settings)
        self.of_commands: dict[str, argparse.ArgumentParser] = {}
        self._negative_number_matcher = re.compile(r"-(\d|\.\d|inf|nan)")

    def error(self, message: str) -> NoReturn:
        raise InputError(f"{message} ({self.prog} --help shows what there is)")

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        """Refuse an empty value, as a shell passes for a variable that is not set: it would count as left out."""
        if action.option_strings and "" in arg_strings:
            raise argparse.ArgumentError(action, "is empty; give a value, or leave the option out")
        return super()._get_values(action, arg_strings)

    def _check_value(self, action: argparse.Action, value: Any) -> None:
        """Name the nearest command or choice in place of all."""
        if action.choices is None or value in action.choices:
            return
        known = [str(one) for one in action.choices]
        what = f"{value!r} is not a command" if action.dest == "command" else f"{value!r} is not allowed"
        guess = nearest(str(value), known)
        if action.dest == "command":
            raise InputError(f"{what}{guess or '; wavefocus --help lists all'}")
        raise argparse.ArgumentError(action, f"{what}{guess or '; allowed: ' + ', '.join(known)}")

    def refuse(self, extra: Sequence[str], command: str) -> NoReturn:
        """Refuse what is left over of a command line, with the option that may have been meant."""
        known = [name for one in self.of_commands[command]._actions for name in one.option_strings]
        option = next((one for one in extra if one.startswith("-")), extra[0]).partition("=")[0]
        if instead := OPTIONS.get(option):
            raise InputError(f"{command}: {refused(option, instead)}")
        guess = nearest(option, known) if option.startswith("-") else ""
        raise InputError(f"{command}: {option} is not known{guess} (wavefocus {command} --help shows what there is)")


def nearest(word: str, known: Sequence[str]) -> str:
    """``; did you mean ...?`` with the nearest of some words; empty where none is near."""
    found = difflib.get_close_matches(word.lower(), known, n=1, cutoff=0.6)
    begun = [one for one in known if len(word) > 1 and one.startswith(word.lower())]
    guesses = found or begun[:1]
    return f"; did you mean {guesses[0]}?" if guesses else ""


def listed(entries: Mapping[str, str], title: str) -> str:
    """A list of names and what they mean, for a help."""
    width = max(map(len, entries)) + 3
    lines = [
        textwrap.fill(f"  {name:<{width - 2}}{about}", 80, subsequent_indent=width * " ", break_on_hyphens=False)
        for name, about in entries.items()
    ]
    return "\n".join([f"{title}:", *lines])
