"""The hidden folder where a file is made: gone afterwards, and what a killed maker left of it."""

import os

import pytest

from wavefocus.storage.sidecar_files import clear_leftovers, staging_dir


def leftover(path, name="dead", **files):
    """What a maker that was killed left beside `path`."""
    folder = path.with_name(f".{path.name}.{name}.partial")
    folder.mkdir()
    for key, content in files.items():
        (folder / {"made": path.name}.get(key, key)).write_bytes(content)
    return folder


def names(folder):
    return sorted(entry.name for entry in folder.iterdir())


def test_another_process_that_removes_empty_folder_first_then_what_was_made_stands(tmp_path):
    path = tmp_path / "bank.h5"
    with staging_dir(path) as place:
        place.temporary.write_bytes(b"whole")
        place.temporary.replace(path)
        (place.temporary.parent / "owner").unlink()
        clear_leftovers(tmp_path, path.name)
    assert path.read_bytes() == b"whole"
    assert names(tmp_path) == ["bank.h5"]


@pytest.mark.parametrize(
    ("there", "files", "after"),
    [
        (None, {}, {}),
        (None, {"owner": b""}, {}),
        (None, {"owner": b"", "made": b"half"}, {}),
        (None, {"made": b"half"}, {}),
        # A name that was claimed and not filled: the complete file takes it, and no other.
        (b"", {"owner": b"complete", "made": b"whole"}, {"bank.h5": b"whole"}),
        (b"", {"owner": b"", "made": b"ha"}, {"bank.h5": b""}),
        (b"", {"owner": b"complet", "made": b"ha"}, {"bank.h5": b""}),
        (b"precious", {"owner": b"complete", "made": b"whole"}, {"bank.h5": b"precious"}),
    ],
)
def test_what_a_killed_maker_left_is_removed_or_takes_the_name_that_it_claimed(tmp_path, there, files, after):
    path = tmp_path / "bank.h5"
    if there is not None:
        path.write_bytes(there)
    leftover(path, **files)
    clear_leftovers(tmp_path, path.name)
    assert {entry.name: entry.read_bytes() for entry in tmp_path.iterdir()} == after


def test_given_a_maker_that_lives_or_folders_of_others_then_they_stay(tmp_path):
    path, elsewhere = tmp_path / "bank.h5", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "bank.h5").write_bytes(b"precious")
    if os.name != "nt":
        (tmp_path / ".bank.h5.link.partial").symlink_to(elsewhere)
    with_more = leftover(path, "more", owner=b"", made=b"half", notes=b"mine")
    of_another = leftover(tmp_path / "bank.h5.old", owner=b"", made=b"half")
    with staging_dir(path) as place:
        place.temporary.write_bytes(b"half")
        clear_leftovers(tmp_path, path.name)
        assert place.temporary.read_bytes() == b"half"
    assert names(elsewhere) == ["bank.h5"]
    assert names(with_more) == ["bank.h5", "notes", "owner"]
    assert names(of_another) == ["bank.h5.old", "owner"]


def test_a_folder_killed_between_two_renames_gets_the_new_one_under_its_name(tmp_path):
    path = tmp_path / "crate"
    hidden = leftover(path, owner=b"complete")
    for name, content in (("crate", "new"), ("previous", "old")):
        (hidden / name).mkdir()
        (hidden / name / "README.md").write_text(content, encoding="utf-8")
    clear_leftovers(tmp_path, path.name)
    assert names(tmp_path) == ["crate"]
    assert (path / "README.md").read_text(encoding="utf-8") == "new"
