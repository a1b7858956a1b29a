"""The paper's numbers beside ours."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Row:
    """One figure of the paper beside ours.

    Parameters
    ----------
    what : str
        Figure.
    paper, ours : str
        Its value in the paper, and here.
    met : bool or None
        Whether ours lies where the paper's does; None where the paper gives no number.
    definition : str
        How ours is defined.
    """

    what: str
    paper: str
    ours: str
    met: bool | None
    definition: str


def table_of(rows: list[Row], how: str) -> str:
    """The table in Markdown; `how` tells where the bank comes from."""
    lines = [
        "# The paper's figures on the virtual rig",
        "",
        f"Bank: {how}.",
        "",
        "| figure | paper | ours | | definition of ours |",
        "|---|---|---|---|---|",
    ]
    words = {True: "as the paper", False: "**not** as the paper", None: ""}
    for row in rows:
        cells = (row.what, row.paper, row.ours, words[row.met], row.definition)
        lines.append("| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |")
    return "\n".join(lines) + "\n"
