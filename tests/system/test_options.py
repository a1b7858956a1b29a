"""The size of the command line: a command or an option more needs a reason, and takes the place of another."""

import re

from wavefocus.__main__ import run
from wavefocus.commands.table import COMMANDS


def test_given_all_helps_then_there_are_at_most_29_commands_and_120_options(capsys):
    listed = set()
    for command in COMMANDS:
        assert run([command.name, "--help"]) == 0
        help, _, shared = capsys.readouterr().out.partition("Also takes ")  # options of several commands
        found = re.findall(r"^  (?:-\w, )?(--[a-z-]+)", help, re.MULTILINE)
        found += re.findall(r"--[a-z-]+", shared.partition(": see")[0])
        listed |= {(command.name, option) for option in found if option not in ("--help", "--json")}
    assert ("render", "--force") in listed
    assert len(COMMANDS) <= 29
    assert len(listed) <= 120, sorted(listed)


def test_given_the_help_then_each_command_stands_in_one_of_three_groups(capsys):
    assert run(["--help"]) == 0
    help = capsys.readouterr().out
    for command in COMMANDS:
        assert len(re.findall(rf"^  {command.name} ", help, re.MULTILINE)) == 1
    assert re.findall(r"^commands .*(?=:$)", help, re.MULTILINE) == [
        "commands that measure", "commands that use a bank", "commands for the rig and for data",
    ]  # fmt: skip
