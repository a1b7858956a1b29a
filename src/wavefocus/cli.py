"""The command line: reads it, and runs the command that it names.

Its arguments are passed by their names in Python to a function of the module in `wavefocus.commands`, which is imported
only when the command is chosen.
"""

import argparse
from collections.abc import Sequence
from typing import Any

from wavefocus.command_line import Command, Parser, listed
from wavefocus.commands.table import COMMANDS, GENERAL, GROUPS, found
from wavefocus.config.retired import retired_command
from wavefocus.storage.errors import InputError

DESCRIPTION = (
    "Measure a plate's Green's functions overnight, render moving tactile sources by time reversal, and check the "
    "focusing against new scans. Start with: wavefocus init lab"
)


class _Version(argparse.Action):
    def __call__(self, parser: argparse.ArgumentParser, *_: object) -> None:
        from importlib.metadata import version

        print(f"wavefocus {version('wavefocus')}")
        parser.exit()


def parser(words: Sequence[str] | None = None) -> Parser:
    """The parser of the command line.

    words: The command line to read; commands that it does not name get no arguments, which halves the time.
    """
    groups = [
        listed({one.name: one.help.partition("\n\n")[0] for one in group}, title) for title, group in GROUPS.items()
    ]
    epilog = "\n\n".join([*groups, listed(GENERAL, "options of several commands")])
    whole = Parser(prog="wavefocus", description=DESCRIPTION, epilog=epilog, usage="wavefocus [options] COMMAND ...")
    whole.add_argument("--version", action=_Version, nargs=0, default=argparse.SUPPRESS, help="Print the version.")
    chosen = whole.add_subparsers(
        dest="command", metavar="COMMAND", required=True, help=argparse.SUPPRESS, prog="wavefocus"
    )
    for one in COMMANDS:
        general = [name for each in one.arguments for name in each.names if name in GENERAL]
        under = whole.of_commands[one.name] = chosen.add_parser(
            one.name,
            description=one.help,
            epilog=f"Also takes {', '.join(general)}: see wavefocus --help." if general else None,
        )
        for each in one.arguments if words is None or one.name in words else ():
            hidden = {"help": argparse.SUPPRESS} if each.names[0] in GENERAL else {}
            under.add_argument(*each.names, **{**each.settings, **hidden})
    return whole


def parsed(arguments: Sequence[str]) -> tuple[Command, dict[str, Any]]:
    """Read one command line: the command, and its arguments by their names in Python.

    Raises InputError: the command line is wrong.
    """
    if gone := retired_command([word for word in arguments if not word.startswith("-")]):
        raise InputError(gone)
    whole = parser(arguments)
    read, extra = whole.parse_known_args(arguments)
    given = vars(read)
    name = given.pop("command")
    if extra:
        whole.refuse(extra, name)
    command = next(one for one in COMMANDS if one.name == name)
    if command.options is not None:
        own = {one: given.pop(one) for one in command.options.__dataclass_fields__ if one in given}
        given["options"] = command.options(**own)
    return command, given


def run_command(arguments: Sequence[str]) -> int:
    """Run one command line.

    Returns the exit code. Raises InputError: the command line is wrong.
    """
    command, given = parsed(arguments)
    from wavefocus.console import spinner

    with spinner(f"{command.name}: loading"):  # seconds on a busy machine
        run = found(command.run) if isinstance(command.run, str) else command.run
    return int(run(**given) or 0)
