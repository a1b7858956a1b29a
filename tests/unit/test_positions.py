"""Lists of bank rows as people type them."""

import pytest

from wavefocus.input_files import parse_positions
from wavefocus.storage.errors import InputError


@pytest.mark.parametrize(
    ("text", "rows"),
    [("3", [3]), ("3,5-7", [3, 5, 6, 7]), (" 0 , 9 ", [0, 9]), ("2,2,1-2", [2, 1]), ("0-9", list(range(10)))],
)
def test_given_numbers_and_ranges_then_each_row_once_in_order(text, rows):
    assert parse_positions(text, 10) == rows


@pytest.mark.parametrize("text", ["", "a", "1,,2", "-1", "10", "3-10", "7-3", "1.5", "1;2", "9" * 30])
def test_given_anything_else_then_one_sentence_names_it(text):
    with pytest.raises(InputError, match="--positions") as told:
        parse_positions(text, 10)
    assert "\n" not in str(told.value)
