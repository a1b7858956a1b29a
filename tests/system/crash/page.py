"""What the soak found, as the table of a page: ``python -m tests.system.crash.page soak-out/soak.json`` writes it."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parents[3] / "docs" / "explanation" / "how-a-bank-survives.md"
BEGIN, END = "<!-- table: begin -->\n", "<!-- table: end -->\n"
_TOTALS = {
    "kill": "kills", "cut": "power cuts", "disk": "full and failing disks", "flip": "flipped bytes",
    "rival": "second processes", "raw": "kills and power cuts of the raw file",
}  # fmt: skip
_COLUMNS = ("trials", "unreadable", "lost", "wrong", "different", "badly_told")


def table(result: dict[str, Any]) -> str:
    """Return the table of a soak's result, with the totals of each kind, as Markdown."""
    lines = [
        f"{result['date']}, `{result['command']}`, {result['minutes']:g} minutes; {result['machine']}.",
        "",
        "| fault | trials | unreadable files | lost positions | wrong positions called valid | not byte-identical | "
        "badly reported |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind, word in _TOTALS.items():
        rows = [row for row in result["rows"] if row["kind"] == kind]
        lines += [_line(row["name"], row) for row in rows]
        if len(rows) > 1:
            total = {name: sum(row[name] for row in rows) for name in _COLUMNS}
            lines.append(_line(f"**all {word}**", total))
    return "\n".join([*lines, ""])


def _line(name: str, row: dict[str, int]) -> str:
    return "| " + " | ".join([name, *(f"{row[column]:,}" for column in _COLUMNS)]) + " |"


def main() -> None:
    """Put the table of a result into the page."""
    result = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    after = rest.split(END)[1]
    PAGE.write_text(before + BEGIN + table(result) + END + after, encoding="utf-8")


if __name__ == "__main__":
    main()
