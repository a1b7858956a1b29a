"""Write the figures of docs/how-to/cluster.md from those of the benchmark.

wavefocus bench cluster --out bench-out
python tools/cluster_page.py bench-out/cluster.json
"""

from __future__ import annotations

import json
import sys
from pathlib import Path

from benchmarks.cluster import page

PAGE = Path("docs/how-to/cluster.md")
BEGIN, END = "<!-- figures: tools/cluster_page.py -->", "<!-- end of figures -->"


def with_figures(text: str, lines: list[str]) -> str:
    """The page with other lines between its two marks."""
    before, _, rest = text.partition(BEGIN)
    _, _, after = rest.partition(END)
    return "\n".join([before + BEGIN, *lines, END + after])


def main() -> int:
    """Rewrite the page; 1 where the figures are of a quick or a missing run."""
    figures = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    if figures.get("left_out") or figures["quick"]:
        print(f"{sys.argv[1]} is of a quick run or of none; run the whole benchmark", file=sys.stderr)
        return 1
    PAGE.write_text(with_figures(PAGE.read_text(encoding="utf-8"), page(figures)), encoding="utf-8")
    return 0


if __name__ == "__main__":
    sys.exit(main())
