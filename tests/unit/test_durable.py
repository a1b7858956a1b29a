"""Writing that survives a crash, by the platform's calls and by the portable ones."""

import errno
import os
import stat
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavefocus.storage.durable import (
    PositionedFile,
    is_network_mount_in,
    publish_by_claim,
    publish_by_link,
    publish_new,
)
from wavefocus.storage.output_files import replacement


@pytest.fixture(params=["the platform's calls", "those of Windows"])
def calls(request, monkeypatch):
    """The calls by which files are read, written and reserved."""
    if request.param == "those of Windows":
        for name in ("preadv", "pwrite", "fdatasync", "posix_fallocate"):
            monkeypatch.delattr(os, name, raising=False)


@settings(max_examples=10)
@given(writes=st.lists(st.tuples(st.integers(0, 5000), st.binary(min_size=1, max_size=6000)), max_size=6))
def test_writes_at_offsets_then_are_read_back_where_they_were_put(tmp_path, calls, writes):
    path = tmp_path / "file"
    path.write_bytes(bytes(16_000))
    expected = bytearray(16_000)
    file = PositionedFile(path, write=True)
    for offset, data in writes:
        file.write(offset, data)
        expected[offset : offset + len(data)] = data
    file.sync()
    found = bytearray(15_000)
    file.read_into(500, memoryview(found))
    file.close()
    assert found == expected[500:15_500]
    assert path.read_bytes() == expected


def test_reserved_space_then_belongs_to_the_file_and_keeps_what_it_held(tmp_path, calls):
    path = tmp_path / "file"
    with path.open("wb") as holes:
        holes.write(b"front")
        holes.seek(3_000_000)
        holes.write(b"back")
    file = PositionedFile(path, write=True)
    file.reserve(5_000_000)
    file.sync()
    assert file.size() == 5_000_000
    file.close()
    content = path.read_bytes()
    assert content[:5] == b"front"
    assert content[3_000_000:3_000_004] == b"back"
    assert content.count(0) == 5_000_000 - 9
    if hasattr(path.stat(), "st_blocks"):
        assert path.stat().st_blocks * 512 >= 5_000_000


def test_a_locked_file_then_has_one_owner_until_it_is_closed(tmp_path):
    (tmp_path / "file").write_bytes(b"abc")
    first, second, reader = (PositionedFile(tmp_path / "file", write=write) for write in (True, True, False))
    assert not reader.locked_elsewhere()
    assert first.try_lock()
    assert not second.try_lock()
    assert reader.locked_elsewhere()
    first.close()
    assert not reader.locked_elsewhere()
    assert second.try_lock()
    second.close()
    reader.close()


@pytest.mark.parametrize("publish", [publish_new, publish_by_link, publish_by_claim])
def test_a_published_file_then_has_its_name_and_no_other_file_s(tmp_path, publish):
    (tmp_path / "temporary").write_bytes(b"old")
    publish(tmp_path / "temporary", tmp_path / "final")
    assert not (tmp_path / "temporary").exists()
    (tmp_path / "temporary").write_bytes(b"new")
    with pytest.raises(FileExistsError):
        publish(tmp_path / "temporary", tmp_path / "final")
    assert (tmp_path / "final").read_bytes() == b"old"
    assert (tmp_path / "temporary").read_bytes() == b"new"


@pytest.mark.skipif(os.name == "nt", reason="Windows has no such permissions")
def test_a_replacement_then_has_the_permissions_of_any_new_file(tmp_path):
    (tmp_path / "ordinary").write_bytes(b"")
    with replacement(tmp_path / "file") as temporary:
        temporary.write_bytes(b"new")
    modes = [stat.S_IMODE((tmp_path / name).stat().st_mode) for name in ("file", "ordinary")]
    assert modes[0] == modes[1]


MOUNTS = """\
/dev/vda / ext4 rw,relatime 0 0
server:/home /home nfs4 rw 0 0
//nas/lab /mnt/the\\040lab cifs rw 0 0
/dev/sdb /home/fast xfs rw 0 0
"""


@pytest.mark.skipif(os.name == "nt", reason="the paths are POSIX paths")
def test_a_path_then_counts_as_on_the_network_by_its_nearest_mount():
    network = {
        "/data/bank.h5": False, "/home/me/bank.h5": True, "/home/fast/bank.h5": False, "/homely/bank.h5": False,
        "/mnt/the lab/bank.h5": True,
    }  # fmt: skip
    assert {path: is_network_mount_in(MOUNTS, Path(path)) for path in network} == network


@pytest.mark.may_skip("Windows has other calls for locks")
@pytest.mark.skipif(os.name == "nt", reason="Windows has other calls for locks")
@pytest.mark.parametrize("number", [errno.ENOLCK, errno.EOPNOTSUPP])
def test_a_drive_that_keeps_no_locks_then_the_file_and_the_remedy_are_named(tmp_path, monkeypatch, number):
    def refused(descriptor, operation):
        raise OSError(number, os.strerror(number))

    monkeypatch.setattr("fcntl.flock", refused)  # as the system answers on such a mount
    path = tmp_path / "bank.h5"
    path.touch()
    with PositionedFile(path, write=True) as file, pytest.raises(OSError, match="folder of this") as caught:
        file.try_lock()
    assert (caught.value.errno, caught.value.filename) == (number, str(path))
