"""Pages name the modules and functions that do what they explain; these are where the pages say."""

import re
from pathlib import Path

import pytest

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
