"""The page of constants that decide a verdict has the code's values, a source and both effects for each."""

from tools.constants_page import PAGE, page

ROWS = [line for line in PAGE.read_text(encoding="utf-8").splitlines() if line.startswith("| `")]


def test_the_page_then_has_the_values_of_the_code():
    assert PAGE.read_text(encoding="utf-8") == page()


def test_at_most_forty_constants_then_decide_and_each_has_a_source_and_both_effects():
    assert 30 <= len(ROWS) <= 40
    assert len({row.split()[1] for row in ROWS}) == len(ROWS)
    assert all(len([cell for cell in row.split(" | ") if cell.strip("| ")]) == 5 for row in ROWS)
