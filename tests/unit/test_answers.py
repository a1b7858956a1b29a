"""The file of answers: what is stored stays, what was not is cut off, and what others wrote is refused."""

import csv
import os
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from tests.lab_files import no_room_beyond
from wavefocus.config.messages import tag
from wavefocus.config.messages.trials import EVENTS, ORDERS
from wavefocus.storage.errors import BankBusyError, InputError
from wavefocus.trials.answers import (
    ANSWERS,
    COLUMNS,
    AnswersFile,
    Row,
    check_participant,
    read_answers,
    read_facts,
    write_facts,
)

ROW = Row(
    "P01", 1, 1, "", "right-40mm_s-burst", 'to the "right", slowly', "burst", 40.0, 0.1 + 0.2, 1, "right", True,
    0.612345678901234, -0.0625, 0.05, 0, 1, "keyboard", "2026-11-25T21:40:00.123+01:00", "a" * 64, "b" * 64, "c" * 64,
)  # fmt: skip
NEXT = replace(ROW, trial=2, correct=None, speed_mm_s=None, onset_error_ms=None, by="touch")


def stored(folder, *rows):
    with AnswersFile(folder) as file:
        for row in rows:
            file.append(row)
    return (folder / ANSWERS).read_bytes()


def test_given_answers_then_they_are_read_as_they_were_and_by_any_csv_reader(tmp_path):
    stored(tmp_path, ROW, NEXT)
    assert read_answers(tmp_path) == (ROW, NEXT)
    with (tmp_path / ANSWERS).open(newline="", encoding="utf-8") as file:
        first, second = csv.DictReader(file)
    assert tuple(first) == tuple(COLUMNS) == Row.__slots__
    assert float(first["amplitude"]) == 0.1 + 0.2
    assert (second["correct"], second["speed_mm_s"], first["path"]) == ("", "", 'to the "right", slowly')
    assert not (tmp_path / "trials.csv.owner").exists()


def test_a_power_cut_at_every_byte_of_header_or_answer_keeps_the_answers_before_it(tmp_path):
    header = stored(tmp_path)
    for length in (*range(0, len(header), 9), len(header) - 1):
        for rest in (b"", b"\0" * (len(header) - length)):
            (tmp_path / ANSWERS).write_bytes(header[:length] + rest)
            assert read_answers(tmp_path) == ()
            assert stored(tmp_path) == header
    before = stored(tmp_path, ROW)
    whole = stored(tmp_path, NEXT)
    for length in range(len(before), len(whole)):
        # A file system may have made room and written nothing.
        for rest in (b"", b"\0" * (len(whole) - length))[: 1 + (length % 20 == 0)]:
            (tmp_path / ANSWERS).write_bytes(whole[:length] + rest)
            kept = read_answers(tmp_path)
            assert kept in ((ROW,), (ROW, NEXT))
            assert (kept == (ROW, NEXT)) == (length >= len(whole) - 2 and not rest)
            if rest or length % 9 == 0 or length > len(whole) - 4:
                later = replace(NEXT, trial=3)
                stored(tmp_path, later)
                assert read_answers(tmp_path) == (*kept, later)


@pytest.mark.parametrize("padding", [0, 200, 700])
def test_a_power_cut_within_the_last_row_cuts_it_off_and_the_next_follows(tmp_path, padding):
    before = stored(tmp_path, ROW, replace(ROW, trial=2, path="p" * padding))
    whole = stored(tmp_path, replace(ROW, trial=3, path="q" * padding))
    first, last = len(before) // 512, (len(whole) - 1) // 512
    assert last > first
    for lost in range(1, 2 ** (last - first + 1)):
        content = bytearray(whole)
        for sector in range(first, last + 1):
            if lost >> (sector - first) & 1:
                start, end = max(512 * sector, len(before)), min(512 * (sector + 1), len(whole))
                content[start:end] = bytes(end - start)
        (tmp_path / ANSWERS).write_bytes(content)
        assert [row.trial for row in read_answers(tmp_path)] == [1, 2]
        assert stored(tmp_path, replace(ROW, trial=4)).startswith(before + b"P01,1,4,")
        assert [row.trial for row in read_answers(tmp_path)] == [1, 2, 4]


def test_given_a_column_more_then_answers_are_read_and_new_ones_leave_it_empty(tmp_path):
    stored(tmp_path, ROW, NEXT)
    with (tmp_path / ANSWERS).open(newline="", encoding="utf-8-sig") as file:
        rows = [{"remark": "tired, late", **row, "room": "3"} for row in csv.DictReader(file)]
    with (tmp_path / ANSWERS).open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, list(rows[0]), lineterminator="\n")
        table.writeheader()
        table.writerows(rows)
    assert read_answers(tmp_path) == (ROW, NEXT)
    later = replace(ROW, trial=3)
    stored(tmp_path, later)
    assert read_answers(tmp_path) == (ROW, NEXT, later)
    with (tmp_path / ANSWERS).open(newline="", encoding="utf-8") as file:
        more = [(row["room"], row["remark"]) for row in csv.DictReader(file)]
    assert more == [("3", "tired, late")] * 2 + [("", "")]


@pytest.mark.parametrize(
    ("find", "put"),
    [
        (b",reaction_s,", b",reaction,"),  # a column that is needed
        (b",replays,", b",block,"),  # a column that is there already
        (b",", b";"),
        (b"P01,1,1", b"P01,1,0"),
        (b"P01,1,1", b"Ann Smith,1,1"),
        (b"true", b"yes"),
        (b"40.0", b"inf"),
        (b"a" * 64, b"a" * 63),
        (b"burst,40", b"b\xffrst,40"),
        (b"burst,40", b"b\x00rst,40"),
        (b"burst,40", "b\u2028rst,40".encode()),
        (b",touch,", b",t\x00uch,"),  # in the last row: no power cut leaves a zero inside a sector
    ],
)
def test_given_answers_that_another_program_changed_then_they_are_refused_and_stay(tmp_path, find, put):
    content = stored(tmp_path, ROW, NEXT).replace(find, put)
    (tmp_path / ANSWERS).write_bytes(content)
    for opens in (read_answers, AnswersFile):
        with pytest.raises(InputError, match="line"):
            opens(tmp_path)
    assert (tmp_path / ANSWERS).read_bytes() == content


def test_given_a_link_or_a_second_process_then_nothing_is_written(tmp_path):
    (tmp_path / "elsewhere.csv").write_bytes(b"")
    (tmp_path / ANSWERS).symlink_to(tmp_path / "elsewhere.csv")
    with pytest.raises(InputError):
        AnswersFile(tmp_path)
    with AnswersFile(tmp_path / "folder"), pytest.raises(BankBusyError, match=str(os.getpid())):
        AnswersFile(tmp_path / "folder")


@pytest.mark.may_skip("limits of files are POSIX")
def test_given_a_full_disk_then_the_file_that_cannot_be_begun_is_named(tmp_path):
    with no_room_beyond(100), pytest.raises(InputError, match=r"trials\.csv cannot be written: "):
        AnswersFile(tmp_path)
    stored(tmp_path, ROW)
    assert read_answers(tmp_path) == (ROW,)


@settings(max_examples=8)
@example(text="oui\u00a0! \u0645\u06cc\u200c\u0634\u0648\u062f", number=1.0)  # no-break space, non-joiner
@given(
    text=st.text(st.characters(exclude_categories=["Cc", "Cs", "Zl", "Zp"]), max_size=20),
    number=st.floats(allow_nan=False, allow_infinity=False),
)
def test_given_any_texts_and_numbers_then_a_row_comes_back_to_the_bit(tmp_path_factory, text, number):
    folder = tmp_path_factory.mktemp("answers")
    row = replace(ROW, stimulus=text, answer=text, amplitude=number, reaction_s=np.float64(number))
    stored(folder, row)
    assert astuple(read_answers(folder)[0]) == astuple(row)


def test_given_names_of_people_then_they_are_no_codes():
    assert check_participant("P-07") == "P-07"
    for name in ("", "Ann Smith", "x" * 21, "../P1", "Ä", "P1\n"):
        with pytest.raises(InputError, match="participant"):
            check_participant(name)


def test_given_facts_then_they_come_back_with_every_column(tmp_path):
    write_facts(tmp_path, {"name": "paper"})
    assert read_facts(tmp_path)["name"] == "paper"
    assert set(read_facts(tmp_path)["columns"]) == set(Row.__slots__)
    for content in ("{}", '{"format": "wavefocus-trials", "format_version": 2}'):
        (tmp_path / "trials.json").write_text(content)
        with pytest.raises(InputError):
            read_facts(tmp_path)


def test_given_the_reference_page_then_it_names_every_order_and_event():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "trials.md").read_text(encoding="utf-8")
    assert "\n<!-- columns -->\n" in page
    for kind in (*ORDERS, *EVENTS):
        word = tag(kind)
        rows = [line for line in page.splitlines() if line.startswith(f"| `{word}` |")]
        assert any(all(f"`{field}`" in row for field in kind.__struct_fields__) for row in rows), word
