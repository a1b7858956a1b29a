"""Pages name modules, functions and constants that decide a verdict; these are where and what the pages say."""

import re
from pathlib import Path

import pytest

from tools.constants_page import PAGE, page

ROOT = Path(__file__).parents[2]
PACKAGE = ROOT / "src" / "wavefocus"
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_every_module_function_and_folder_that_a_page_names_is_there(page):
    text = page.read_text(encoding="utf-8")
    for module, names in re.findall(r"\b((?:\w+/)+\w+\.py)(?:: (\w+(?:\.\w+)*))?", text):
        file = next(folder / module for folder in (PACKAGE, ROOT) if (folder / module).is_file())
        source = file.read_text(encoding="utf-8")
        missing = [name for name in names.split(".") if not re.search(rf"\b{name}\b", source)]
        assert not missing, f"{page.name}: {module}: {names}"
    packages = "acquisition|benchmarks|calibration|config|drivers|gui|mocks|rendering|src|storage|tests|tools"
    for folder in re.findall(rf"`((?:{packages})/[\w/]*)/?`", text):
        assert (PACKAGE / folder).is_dir() or (ROOT / folder).is_dir(), f"{page.name}: {folder}"


def test_the_page_of_constants_has_the_code_s_values_and_five_cells_for_each():
    text = PAGE.read_text(encoding="utf-8")
    assert text == page()
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    assert 30 <= len(rows) <= 40
    assert len({row.split()[1] for row in rows}) == len(rows)
    assert all(len([cell for cell in row.split(" | ") if cell.strip("| ")]) == 5 for row in rows)


def test_the_page_about_the_code_names_what_is_there_and_leaves_out_no_package():
    text = (ROOT / "docs" / "explanation" / "code.md").read_text(encoding="utf-8")
    named = set(re.findall(r"`([\w/]+(?:\.py|/))`", text))
    assert not [name for name in named if not ((ROOT if name.startswith("tests/") else PACKAGE) / name).exists()]
    assert {f"{path.parent.name}/" for path in PACKAGE.glob("*/__init__.py")} <= named
