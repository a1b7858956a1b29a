"""The page about the code names files and packages that exist, and leaves out no package."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "explanation" / "code.md").read_text(encoding="utf-8")
NAMED = sorted(set(re.findall(r"`([\w/]+(?:\.py|/))`", PAGE)))


@pytest.mark.parametrize("name", NAMED)
def test_a_name_of_the_page_then_is_there(name):
    assert (ROOT / name if name.startswith("tests/") else ROOT / "src" / "wavefocus" / name).exists()


def test_every_package_then_stands_on_the_page():
    packages = {f"{path.parent.name}/" for path in (ROOT / "src" / "wavefocus").glob("*/__init__.py")}
    assert packages <= set(NAMED)
