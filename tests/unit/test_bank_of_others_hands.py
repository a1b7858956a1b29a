"""Banks that people have touched: attributes added, notes, copies object by object, repacked."""

import json
import os
import subprocess
import sys
import tempfile
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import h5py
import numpy as np
import pytest

import wavefocus as wf
from tests.lab_files import write_bank
from wavefocus import add_note, open_bank
from wavefocus.__main__ import run
from wavefocus.calibration.check import check_bank
from wavefocus.storage import durable
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import BankBusyError, InputError
from wavefocus.storage.ledger.owner import claimed


@pytest.fixture
def bank(tmp_path):
    return write_bank(tmp_path / "plate.h5", np.random.default_rng(4).normal(size=(4, 2, 16)), rows=range(3))


def by_objects(source, target, **options):
    for name in source:
        source.copy(name, target, **options)
    for name, value in source.attrs.items():
        target.attrs[name] = value


def by_values(source, target):
    def copy(name, found):
        if isinstance(found, h5py.Dataset):
            packed = {"compression": "gzip"} if name == "green" else {}
            target.create_dataset(name, data=found[...], **packed)

    source.visititems(copy)
    for name, value in source.attrs.items():
        target.attrs[name] = value


@pytest.mark.parametrize(
    ("copy", "libver"),
    [(by_objects, "earliest"), (by_values, "latest"), (partial(by_objects, expand_refs=True), "latest")],
    ids=["objects", "values", "references"],
)
def test_a_copy_object_by_object_reads_as_the_bank_and_a_changed_value_is_damage(bank, copy, libver):
    other = bank.with_name("copy.h5")
    with h5py.File(bank) as source, h5py.File(other, "w", libver=libver) as target:
        copy(source, target)
    with open_bank(bank) as own, open_bank(other) as copied:
        for position in range(own.positions):
            assert np.array_equal(own.green(position), copied.green(position))
        assert np.array_equal(own.status, copied.status)
        assert all(np.array_equal(own.quality[name], copied.quality[name], equal_nan=True) for name in own.quality)
        assert (own.plan_sha256, own.run_json) == (copied.plan_sha256, copied.run_json)
        assert copied.verify() == ()
    assert not [one for one in check_bank(other) if one.severity == "error"]
    with pytest.raises(InputError, match="cannot be written into"):
        BankWriter.open(other)
    with h5py.File(other, "r+") as target:
        target["green"][1, 0, 0] += 1
    with open_bank(other) as copied:
        assert copied.verify() == (1,)
        with pytest.raises(InputError, match="position 1 is damaged"):
            copied.green(1)
    assert {one.position for one in check_bank(other) if one.severity == "error"} == {1}


def test_attributes_that_a_person_added_then_the_bank_is_sound_and_they_are_named(bank):
    with h5py.File(bank, "r+") as file:
        file.attrs.update({"my remark": "made by me", "a": np.arange(4), "b": h5py.Empty("f4"), "c": b"\xff"})
    with open_bank(bank, contents=True) as view:
        assert view.unknown_attributes == ("a", "b", "c", "my remark")
    findings = check_bank(bank)
    assert not [one for one in findings if one.severity == "error"]
    assert any("my remark" in one.message for one in findings)
    with BankWriter.open(bank) as writer:  # and it can be measured into
        assert writer.status.any()
    with h5py.File(bank, "r+") as file:  # an attribute of its own counts all the same
        file["status"].attrs["flag_meanings"] = "valid"
    with pytest.raises(InputError, match="contents does not hold"):
        open_bank(bank, contents=True)


def test_given_notes_then_status_and_exports_show_them_and_the_bank_is_as_it_was(bank, capsys):
    with open_bank(bank) as before:
        rows = [before.green(row).copy() for row in range(before.positions)]
    assert run(["note", str(bank), "bolt 3 was loose"]) == 0
    assert run(["note", str(bank), 'new coil, "B" \u00fc']) == 0
    capsys.readouterr()
    assert run(["status", str(bank), "--json"]) == 0
    notes = json.loads(capsys.readouterr().out)["notes"]
    assert [note["text"] for note in notes] == ["bolt 3 was loose", 'new coil, "B" \u00fc']
    with open_bank(bank, contents=True) as view:
        assert [note.text for note in view.notes] == [note["text"] for note in notes]
        assert view.unknown_attributes == ()
        assert all(np.array_equal(view.green(row), green) for row, green in enumerate(rows))
    assert not [one for one in check_bank(bank) if one.severity == "error"]
    with BankWriter.open(bank) as writer:
        writer.amend(0, status=16)
    assert sorted(path.name for path in bank.parent.iterdir()) == ["plate.h5"]
    # test_import.py and test_export.py have the exports that are read back.
    wf.export_bank(bank, bank.with_name("out"), "sofa")
    with h5py.File(bank.with_name("out")) as file:
        assert "bolt 3 was loose" in file.attrs["Comment"].decode()
    wf.export_bank(bank, bank.with_name("rows.nc"), "netcdf")
    add_note(bank.with_name("rows.nc"), "of the copy")
    with open_bank(bank.with_name("rows.nc")) as copy:
        assert (copy.notes[:-1], copy.notes[-1].text) == (view.notes, "of the copy")


def test_a_text_that_is_no_note_or_a_file_that_takes_none_then_no_note_is_added(bank):
    before, link, text = bank.read_bytes(), bank.with_name("link.h5"), bank.with_name("text.h5")
    for words in ("", "  ", "a" * 4001, "bell\x07", "\x1b[31mred"):
        with pytest.raises(InputError):
            add_note(bank, words)
    text.write_text("no bank")
    if os.name != "nt":  # links need a privilege on Windows
        link.symlink_to(bank.name)
    for path in (link, text, bank.with_name("none.h5")):
        with pytest.raises(InputError):
            add_note(path, "x")
    assert bank.read_bytes() == before
    with BankWriter.open(bank), pytest.raises(BankBusyError):
        add_note(bank, "too early")
    add_note(bank, "now")


@pytest.mark.may_skip("Windows replaces no file that is open: the note is refused there")
@pytest.mark.skipif(sys.platform == "win32", reason="Windows replaces no file that is open")
def test_a_note_added_while_another_process_opens_the_bank_then_nothing_is_lost(bank, monkeypatch):
    opening, texts = durable.PositionedFile, ["one"]

    def open_slowly(path, *, write):
        file = opening(path, write=write)
        if texts:
            add_note(bank, texts.pop())
        return file

    with BankWriter.open(bank, open_file=open_slowly) as writer:
        writer.amend(0, status=16)
    texts.append("two")
    monkeypatch.setattr(durable, "PositionedFile", open_slowly)
    add_note(bank, "three")
    with open_bank(bank) as view:
        assert ([note.text for note in view.notes], view.status[0]) == (["one", "two", "three"], 16)


def test_on_windows_then_the_bank_is_closed_when_its_noted_copy_takes_its_name(bank, monkeypatch):
    def publish(staging):
        with durable.PositionedFile(bank) as file:
            assert not file.locked_elsewhere()

    monkeypatch.setattr("wavefocus.storage.bank.notes.sys", SimpleNamespace(platform="win32"))
    monkeypatch.setattr("wavefocus.storage.sidecar_files.StagingDir.publish", publish)
    add_note(bank, "x")


def test_given_a_bank_that_a_notebook_has_open_in_h5py_then_both_read_it(bank):
    with h5py.File(bank) as notebook, open_bank(bank) as view:
        assert np.array_equal(view.green(2), notebook["green"][2])
    with open_bank(bank) as view, h5py.File(bank) as notebook:
        assert np.array_equal(view.green(2), notebook["green"][2])


@pytest.mark.may_skip("permissions of POSIX")
@pytest.mark.skipif(os.name != "posix", reason="permissions of POSIX")
def test_given_a_closed_umask_then_the_lock_of_a_name_stays_open_to_other_users(tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    former = os.umask(0o077)
    try:
        with claimed("tasks of Dev1"):
            (lock,) = tmp_path.glob("*.lock")
            assert lock.stat().st_mode & 0o666 == 0o666
    finally:
        os.umask(former)


# Root becomes another user once all is imported: that user may not read the interpreter's folder.
ANOTHER_USER = """
import os, sys, tempfile
from wavefocus.console import one_line
from wavefocus.storage.ledger.owner import claimed
tempfile.tempdir = sys.argv[1]
os.umask(0o077)
if sys.argv[2] != "root":
    os.setgid(65534)
    os.setuid(65534)
try:
    with claimed("tasks of Dev1"):
        print("held", flush=True)
        sys.stdin.read()
except Exception as failure:
    print(type(failure).__name__, one_line(str(failure)))
"""


@pytest.mark.may_skip("only root can become another user")
@pytest.mark.skipif(not hasattr(os, "getuid") or os.getuid() != 0, reason="only root can become another user")
def test_the_lock_of_another_user_names_the_holder_and_a_dead_ones_is_taken():
    with tempfile.TemporaryDirectory(prefix="wavefocus-", dir="/tmp") as name:
        folder = Path(name)
        folder.chmod(0o1777)

        def started(user):
            words = [sys.executable, "-c", ANOTHER_USER, name, user]
            return subprocess.Popen(words, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)

        def said(user):
            return started(user).communicate("")[0].strip()

        for user, other in (("root", "nobody"), ("nobody", "root")):  # the second after the first is dead
            with started(user) as holder:
                assert holder.stdout.readline() == "held\n"
                assert said(other).startswith(f"BankBusyError tasks of Dev1 is held by process {holder.pid} on ")
                holder.kill()
        assert said("root") == "held"
        (lock,) = folder.glob("*.lock")
        os.chown(lock, 0, 0)
        lock.chmod(0o600)  # as an earlier version left it under a closed umask
        assert "belongs to user root: ask for chmod a+rw" in said("nobody")
