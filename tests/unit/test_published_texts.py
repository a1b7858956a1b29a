"""Texts of `[publication]` and of devices in a published README: shown as they are, never as HTML or links."""

from __future__ import annotations

import re
from html import unescape
from html.parser import HTMLParser

import pytest
from markdown_it import MarkdownIt

from wavefocus.config.run import Publication
from wavefocus.crate import Crate, Part, as_markdown
from wavefocus.drivers.protocols import DeviceIdentity

HOSTILE = (
    "<script>alert(1)</script>", "<img src=x onerror=alert(1)>", "[here](javascript:alert(1))", "<javascript:alert(1)>",
    "![x](javascript:alert(1))", "[a][b]", "*bold* **bold** _it_ ~~gone~~ `code`", "# heading", "- item", "1. item",
    "> quote", "+ item", "a | b", "back\\slash \\<b>", "&lt;b&gt; &amp; &#x6a;avascript:x", "===", "---",
    "```sh", "~~~", "    indented", "[x]: javascript:alert(1)", "<a href='javascript:x'>y</a>", "javascript:alert(1)",
    "a<b>c</b>", "JavaScript:alert(1)", "data:text/html,<b>",
    "snake_case and 5 * 3 < 20 & more", "1) item", "<!-- gone -->",
    "[x](https://a.example 'onload=x')", "https://a.example/<script>",
)  # fmt: skip


class Tags(HTMLParser):
    def __init__(self, html: str) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.addresses: list[str] = []
        self.texts: list[str] = []
        self.feed(html)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.addresses += [value or "" for name, value in attrs if name in ("href", "src") or name.startswith("on")]

    def handle_data(self, data: str) -> None:
        self.texts.append(data)


def shown(markdown: str) -> Tags:
    return Tags(MarkdownIt("gfm-like", {"html": True, "linkify": False}).render(markdown))


@pytest.mark.parametrize("text", HOSTILE)
@pytest.mark.parametrize("before", ["", "- Authors: ", "# "])
def test_a_text_of_others_then_is_shown_as_it_is(text: str, before: str) -> None:
    found = shown(f"{before}{as_markdown(text)}")
    assert not set(found.tags) - {"p", "ul", "li", "h1"}
    assert found.addresses == []
    words = "".join(found.texts).strip()
    assert words.removeprefix("Authors: ") == " ".join(text.split())


def test_a_readme_then_holds_no_html_and_only_its_own_links() -> None:
    publication = Publication(
        title=HOSTILE[0], description="\n\n".join(HOSTILE), licence=HOSTILE[2], organisation=HOSTILE[1],
        room=HOSTILE[21], references=(HOSTILE[3], "https://doi.org/10.1000/a_b*c"),
        people=({"name": HOSTILE[2]}, {"name": "Jane D\u00f6e"}),
    )  # fmt: skip
    crate = Crate(
        title=publication.title or "", description=publication.description or "", publication=publication,
        facts=[("unit | <b>", "m/s|<b>", "<i>"), ("taps", 4.0, "")], sessions=[], software="x",
        parts=[Part("green.png", "Green's function <b> [x](javascript:y)")],
        devices={"mirror": DeviceIdentity(HOSTILE[1], HOSTILE[2], HOSTILE[0])}, origin="\n".join(HOSTILE),
    )  # fmt: skip
    text = crate.readme()
    assert not re.search(r"<(?!/?br)|javascript:", text, re.IGNORECASE)
    found = shown(text)
    allowed = {"h1", "h2", "p", "ul", "li", "table", "thead", "tbody", "tr", "th", "td", "code", "img", "em"}
    assert not set(found.tags) - allowed
    assert found.addresses == ["green.png"]
    assert found.tags.count("h1") == 1
    assert "https://doi.org/10.1000/a_b*c" in text
    assert unescape("Jane D\u00f6e") in text
