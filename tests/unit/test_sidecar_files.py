"""Files beside a bank are written neither through links nor over files of somebody else."""

import json
import os

import pytest

from wavefocus.campaign.sidecar_files import EventLog, VerifyLog, drift_path, log_path, write_whole
from wavefocus.config.messages.campaign import Drift
from wavefocus.storage.ledger.owner import owner_path, remove_owner, write_owner

pytestmark = pytest.mark.skipif(os.name == "nt", reason="needs symbolic links")
PRECIOUS = b"precious\n"


@pytest.fixture
def victim(tmp_path):
    (tmp_path / "victim").write_bytes(PRECIOUS)
    return tmp_path / "victim"


@pytest.mark.parametrize("path_of", [log_path, drift_path])
def test_given_a_link_or_a_file_of_another_then_no_log_is_written_there(victim, path_of):
    bank = victim.with_name("plate.h5")
    names = [bank.with_suffix(ending) for ending in (".events.jsonl", ".drift.jsonl")]
    for name in names:
        name.symlink_to(victim)
    drift = Drift(0, 0.0, 0.1, 0.0, 1.0, "steady", "run", "", ())
    with EventLog(path_of(bank), Drift) as written:
        written(drift)
    for name in names:
        name.unlink()
        name.write_bytes(PRECIOUS)
    with EventLog(path_of(bank), Drift) as written:
        written(drift)
    assert [name.read_bytes() for name in names] == [PRECIOUS, PRECIOUS]
    for name in names:
        name.unlink()
        os.mkfifo(name)
    with EventLog(path_of(bank), Drift) as written:
        written(drift)
    assert victim.read_bytes() == PRECIOUS


def test_given_a_link_then_the_owner_is_named_beside_the_bank_alone(victim):
    bank = victim.with_name("plate.h5")
    owner_path(bank).symlink_to(victim)
    write_owner(bank)
    assert json.loads(owner_path(bank).read_text())["pid"] == os.getpid()
    assert victim.read_bytes() == PRECIOUS
    remove_owner(bank)
    assert not os.path.lexists(owner_path(bank))


def test_given_a_file_of_another_then_no_owner_replaces_it(tmp_path):
    bank = tmp_path / "plate.h5"
    owner_path(bank).write_bytes(PRECIOUS)
    write_owner(bank)
    remove_owner(bank)
    assert owner_path(bank).read_bytes() == PRECIOUS


@pytest.mark.parametrize("by_many", [True, False])
def test_given_links_and_files_of_another_then_small_files_are_written_beside_them(victim, by_many):
    path = victim.with_name("plate.h5.heartbeat")
    for name in (path.with_name(f"{path.name}.new"), path.with_name(f"{path.name}.{os.getpid()}.new"), path):
        name.symlink_to(victim)
    write_whole(path, {"a": 1}, by_many=by_many)
    assert json.loads(path.read_text()) == {"a": 1}
    assert path.with_name(f"{path.name}.new").is_symlink()
    assert victim.read_bytes() == PRECIOUS
    path.write_bytes(PRECIOUS)
    with pytest.raises(FileExistsError):
        write_whole(path, {"a": 2}, by_many=by_many)
    assert path.read_bytes() == PRECIOUS


def test_given_what_a_killed_writer_left_then_the_next_one_removes_it(tmp_path):
    path = tmp_path / "plate.h5.heartbeat"
    (tmp_path / f".{path.name}.0123456789abcdef.new").write_bytes(b"{")
    write_whole(path, {"a": 1})
    assert [entry.name for entry in tmp_path.iterdir()] == [path.name]


def test_given_a_link_then_the_log_of_a_verification_is_written_beside_it(victim):
    (victim.parent / "verify.events.jsonl").symlink_to(victim)
    with VerifyLog(victim.parent / "verify.events.jsonl") as log:
        log.done(0, "done")
    assert victim.read_bytes() == PRECIOUS


def test_sector_of_garbage_after_power_cut_then_owner_s_name_is_written_and_removed(tmp_path):
    bank = tmp_path / "plate.h5"
    owner_path(bank).write_bytes(b"\xff\xa5" * 256)
    write_owner(bank)
    assert json.loads(owner_path(bank).read_text())["pid"] == os.getpid()
    owner_path(bank).write_bytes(b"\xff\xa5" * 200)
    remove_owner(bank)
    assert not owner_path(bank).exists()
    owner_path(bank).write_bytes(b"\xff\xa5" * 257)  # more than a power cut leaves
    remove_owner(bank)
    assert owner_path(bank).exists()
