"""Settings of the documentation's site (`make docs`): Sphinx reads the Markdown files that the repository shows."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterator
from importlib.metadata import version as version_of
from pathlib import Path

from pygments.lexers.special import TextLexer
from sphinx.application import Sphinx
from sphinx.highlighting import lexers

sys.path.insert(0, str(Path(__file__).parents[1]))

from tools import key_tables, python_reference
from wavefocus.command_line import Argument, Command
from wavefocus.commands.table import COMMANDS

project = "wavefocus"
version = release = version_of("wavefocus")
html_title = f"wavefocus {version}"
root_doc = "README"
extensions = ["myst_parser"]
myst_heading_anchors = 4  # links to headings are written as on a repository's pages
highlight_language = "none"  # of blocks that name no language: what a program prints
lexers["sh"] = TextLexer()  # a shell's colours would mark `export` and numbers in our commands
smartquotes = False  # keys and values are shown as they are typed
html_theme = "furo"
html_static_path = ["site.css"]
html_css_files = ["site.css"]
html_search_scorer = str(Path(__file__).parent / "search-scorer.js")
html_copy_source = False
html_show_copyright = False
html_show_sphinx = False


def setup(app: Sphinx) -> None:
    """Register what is added to the pages."""
    app.connect("source-read", complete)
    app.connect("build-finished", lambda app, _: shutil.copy(app.outdir / "README.html", app.outdir / "index.html"))


def complete(app: Sphinx, page: str, text: list[str]) -> None:
    """Add to the pages what stands in the program or in the folder already."""
    if page == "README":
        text[0] += "".join(navigation(text[0]))
    elif page == "decisions/README":
        text[0] += "\n```{toctree}\n:glob:\n\n0*\n```\n"
    elif page == "reference/commands":
        text[0] += "".join(map(section, COMMANDS))
    elif page == "reference/python":
        text[0] += python_reference.entries()
    else:
        text[0] = key_tables.with_tables(text[0])


def navigation(index: str) -> Iterator[str]:
    """Yield the site's navigation: the headings of an index with the pages that they list, in their order."""
    for heading, part in re.findall(r"^## (.+?)\n(.*?)(?=^## |\Z)", index, re.MULTILINE | re.DOTALL):
        pages = re.findall(r"^- \[.*?\]\((\S+\.md)\)", part, re.MULTILINE)
        yield "\n".join(["", "```{toctree}", ":hidden:", f":caption: {heading}", "", *pages, "```", ""])


def section(command: Command) -> str:
    """Describe a command: how it is typed, what it does, its arguments."""
    needed = [spelled(given) for given in command.arguments if is_needed(given)]
    options = [] if len(needed) == len(command.arguments) else ["[options]"]
    typed = " ".join(["wavefocus", command.name, *needed, *options])
    rows = "".join(
        "| `{}` | {} |\n".format(spelled(given).replace("|", r"\|"), given.settings["help"])
        for given in command.arguments
    )
    return (
        f"\n## {command.name}\n\n```text\n{typed}\n```\n\n{command.help}\n\n| argument | meaning |\n|---|---|\n{rows}"
    )


def is_needed(given: Argument) -> bool:
    """Whether a command line must have an argument."""
    optional = given.names[0].startswith("-") or given.settings.get("nargs") in ("?", "*")
    return bool(given.settings.get("required", not optional))


def spelled(given: Argument) -> str:
    """An argument as it is typed."""
    choices = ", ".join(given.settings.get("choices", ()))
    value = given.settings.get("metavar", choices or "TEXT")
    if not given.names[0].startswith("-"):
        return value
    return given.names[0] if str(given.settings.get("action")).startswith("store_") else f"{given.names[0]} {value}"
