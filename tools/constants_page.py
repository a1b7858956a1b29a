"""Values of the constants that decide a verdict, put from the code into the table of docs/reference/constants.md.

``python tools/constants_page.py`` writes the page anew; test_source_named_in_docs.py holds it equal to the code.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path

PAGE = Path(__file__).parents[1] / "docs" / "reference" / "constants.md"
ROW = re.compile(r"^\| `([\w.]+)\.(\w+)` \| (.*?) \|", re.MULTILINE)


def page() -> str:
    """The page with the values that the code has."""

    def _row(found: re.Match[str]) -> str:
        value = getattr(import_module(f"wavefocus.{found[1]}"), found[2])
        return f"| `{found[1]}.{found[2]}` | {value:.4g} |"

    return ROW.sub(_row, PAGE.read_text(encoding="utf-8"))


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
