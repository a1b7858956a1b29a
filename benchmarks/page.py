"""One HTML page of all benchmarks in a folder: machine and versions, diagrams, tables. It needs no other file."""

from __future__ import annotations

import base64
from collections.abc import Iterable, Mapping
from html import escape
from pathlib import Path
from typing import Any

STYLE = """body{font:15px/1.5 system-ui,sans-serif;max-width:76rem;margin:2rem auto;padding:0 1rem;color:#1a1a1a}
table{border-collapse:collapse;font-size:13px;margin:.6rem 0 1.6rem;display:block;overflow-x:auto}
th,td{border-bottom:1px solid #ddd;padding:.25rem .6rem;text-align:left;white-space:nowrap}
td:last-child{white-space:normal;min-width:14rem}img{max-width:100%}h3{margin-bottom:.2rem}code{background:#f2f2f2}"""


def html_page(measured: Mapping[str, Mapping[str, Any]], titles: Mapping[str, str], folder: Path) -> str:
    """The page of some benchmarks, by name; their pictures lie in the folder."""
    parts = [
        "<!doctype html><html lang=en><meta charset=utf-8><title>wavefocus: error against run time</title>",
        f"<style>{STYLE}</style><h1>Error against run time</h1>",
        "<p>Times are medians of repeats, on the wall and of the processor; the spread is the difference of the"
        " quartiles. Grey in a diagram is the Pareto front: no other setting beats those on it in error and in time."
        "</p><ul>",
        *(f"<li><a href='#{name}'>{escape(titles[name])}</a>" for name in measured),
        "</ul>",
    ]
    for name, found in measured.items():
        made = found["made"]
        words = [made["command"], made["date"], f"commit {made['commit']}", made["processor"], f"{made['cores']} cores"]
        words += [f"Python {made['python']}", *(f"{package} {one}" for package, one in made["packages"].items())]
        quick = " A quick run: its figures say only that it works." if found["quick"] else ""
        parts.append(f"<h2 id='{name}'>{escape(titles[name].capitalize())}</h2>")
        parts.append(
            f"<p>{escape(', '.join(map(str, words)))}. Load {made['load_before']}, {made['load_after']}.{quick}</p>"
        )
        parts += _blocks(found["lines"], found["diagrams"], folder)
    return "\n".join(parts) + "\n"


def _blocks(lines: Iterable[str], diagrams: Mapping[str, str], folder: Path) -> list[str]:
    """Paragraphs, headings with their diagrams, and tables, of lines in Markdown."""
    parts, inside = [], False
    for line in lines:
        row = line.startswith("|")
        if row and line.startswith("|-"):
            continue
        if row:
            tag = "td" if inside else "th"
            cells = [escape(one.strip().replace("\\|", "|")) for one in line.strip("|").split(" | ")]
            parts.append(("" if inside else "<table>") + "<tr>" + "".join(f"<{tag}>{one}" for one in cells))
        elif inside:
            parts.append("</table>")
        inside = row
        if line.startswith("**"):
            work = line.strip("*")
            parts.append(f"<h3>{escape(work)}</h3>")
            if work in diagrams:
                picture = base64.b64encode((folder / diagrams[work]).read_bytes()).decode()
                parts.append(
                    f"<img alt='error against run time: {escape(work)}' src='data:image/png;base64,{picture}'>"
                )
        elif line and not row:
            parts.append(f"<p>{escape(line)}</p>")
    return [*parts, "</table>"] if inside else parts
