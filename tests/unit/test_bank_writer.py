"""Measuring into a bank: order of writes, replacement, refusal, one owner, power cuts."""

import errno
import json
import os
import shutil
import socket
import subprocess
import sys
import zlib
from dataclasses import replace

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.lab_files import attribute, flip, green_of, record_of, without, write_bank
from wavefocus.calibration.check import check_bank
from wavefocus.rendering.greens.regularisation import rms_map
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter, create_bank
from wavefocus.storage.durable import PositionedFile
from wavefocus.storage.errors import BankBusyError, InputError, WavefocusError
from wavefocus.storage.ledger.owner import bank_owner, owner_path


def header(positions=4, actuators=2, taps=16):
    grid = np.stack([np.arange(positions) * 4.0, np.zeros(positions)], axis=1)
    return BankHeader(
        np.float64(10_000.0), taps, (20.0, 500.0), grid, np.full((actuators, 2), np.nan), '{"rig": "virtual"}',
        '{"grid": {"spacing_mm": 4}}', "ab" * 32, "wavefocus test",
    )  # fmt: skip


def measured(path, positions=4):
    """A bank of four positions of which the first are measured."""
    return write_bank(path, np.stack([green_of(position) for position in range(4)]), rows=range(positions))


def test_plain_h5py_reads_contract_section_2_and_during_a_run_what_is_measured(tmp_path):
    path = tmp_path / "bank.h5"
    create_bank(path, header())
    with open_bank(path) as bank:  # nothing is measured
        assert bank.status.tolist() == [0, 0, 0, 0]
        assert not bank.green(3).any()
        assert bank.quality["attempts"].tolist() == [0, 0, 0, 0]
        assert np.isnan(bank.quality["snr_db"]).all()
    with BankWriter.open(path) as writer:
        for position in range(4):
            writer.commit(position, green_of(position), record_of(position))
            with h5py.File(path, "r", locking=False) as file:
                assert file["status"][...].tolist() == [1] * (position + 1) + [0] * (3 - position)
                for name in ("snr_db", "residual_db", "coherence", "peak_v"):
                    assert np.array_equal(file["quality"][name][position], getattr(record_of(position), name))
                assert np.array_equal(file["green"][position], green_of(position))
            with open_bank(path) as bank:
                assert np.array_equal(bank.green(position), green_of(position))
    with h5py.File(path, "r") as file:
        stated = {"format": "wavefocus-bank", "format_version": 1, "sample_rate_hz": 1e4, "plan_sha256": "ab" * 32}
        assert {name: file.attrs[name] for name in stated} == stated
        assert file.attrs["band_hz"].tolist() == [20.0, 500.0]
        assert json.loads(file.attrs["run"]) == {"grid": {"spacing_mm": 4}}
        green = file["green"]
        assert (green.dtype, green.chunks, green.compression) == (np.float32, (1, 2, 16), None)
        assert (file["status"].dtype, file["quality/snr_db"].dtype) == (np.uint8, np.float32)
        assert np.array_equal(file["position_mm"][...], header().position_mm)
        assert np.array_equal(file["time_s"][...], np.arange(16) / 10_000)
        assert file["quality/attempts"][...].tolist() == [1, 1, 1, 1]


@pytest.mark.long  # xarray, and with it dask, takes seconds to load
def test_a_bank_opened_by_xarray_then_shows_labelled_dimensions_and_units(tmp_path):
    import xarray

    path = measured(tmp_path / "bank.h5")
    with xarray.open_dataset(path, engine="h5netcdf") as dataset:
        assert {name: dataset[name].dims for name in ("green", "position_mm", "actuator_mm", "status")} == {
            "green": ("position", "actuator", "time_s"), "position_mm": ("position", "axis"),
            "actuator_mm": ("actuator", "axis"), "status": ("position",),
        }  # fmt: skip
        assert dataset["axis"].values.tolist() == ["x", "y"]
        assert dataset["green"].attrs["units"] == "m/s/V"
        assert dataset["time_s"].attrs["units"] == "s"
        assert np.array_equal(dataset["green"].sel(position=3).values, green_of(3))
    with xarray.open_dataset(path, engine="h5netcdf", group="quality") as quality:
        assert quality["snr_db"].dims == ("position", "actuator")
        assert quality["snr_db"].attrs["units"] == "dB"


@settings(max_examples=3)
@given(
    positions=st.integers(1, 5),
    actuators=st.sampled_from([1, 2, 20, 300]),  # 300: a ledger row of two pages
    taps=st.integers(1, 40),
    seed=st.integers(0, 2**32 - 1),
)
def test_rows_committed_in_any_order_then_come_back_bit_for_bit(tmp_path, positions, actuators, taps, seed):
    path = tmp_path / f"{positions}-{actuators}-{taps}-{seed}.h5"
    path.unlink(missing_ok=True)
    rng = np.random.default_rng(seed)
    rows = rng.normal(size=(positions, actuators, taps)).astype(np.float32)
    create_bank(path, header(positions, actuators, taps))
    with BankWriter.open(path) as writer:
        for position in rng.permutation(positions).tolist():
            writer.commit(position, rows[position], record_of(position, 2, actuators, status=5))
    with open_bank(path) as bank, h5py.File(path, "r") as file:
        for position in range(positions):
            assert np.array_equal(bank.green(position), rows[position])
        assert bank.verify() == ()
        assert bank.status.tolist() == [5] * positions
        assert np.array_equal(file["green"][...], rows)
        assert np.array_equal(file["quality/snr_db"][...], bank.quality["snr_db"])
    path.unlink()


def test_a_path_that_exists_or_a_bank_larger_than_the_disk_then_is_refused(tmp_path):
    (tmp_path / "old.h5").write_bytes(b"precious")
    with pytest.raises(InputError, match=r"old\.h5 exists already"):
        create_bank(tmp_path / "old.h5", header())
    assert (tmp_path / "old.h5").read_bytes() == b"precious"
    free = shutil.disk_usage(tmp_path).free
    too_many = free // (20 * 200_000 * 4) + 100
    with pytest.raises(InputError, match=r"bank\.h5 needs \d+ bytes and its disk has \d+ free"):
        create_bank(tmp_path / "bank.h5", header(too_many, 20, 200_000))
    assert [entry.name for entry in tmp_path.iterdir()] == ["old.h5"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"sample_rate_hz": 0.0}, "sample_rate_hz is 0"),
        ({"taps": 0}, "taps is 0"),
        ({"band_hz": (500.0, 20.0)}, "band_hz is 500 to 20"),
        ({"band_hz": (20.0, 6000.0)}, "<= 5000"),
        ({"position_mm": np.zeros((0, 2))}, "position_mm has shape"),
        ({"position_mm": np.array([[np.nan, 0.0]])}, "position_mm holds values"),
        ({"rig_json": "a\0b"}, "rig_json holds a zero character"),
    ],
)
def test_a_wrong_header_then_is_refused_by_name(change, message):
    with pytest.raises(InputError, match=message):
        replace(header(), **change)


def test_a_position_measured_again_is_replaced_and_a_disabled_one_keeps_its_data(tmp_path):
    path = measured(tmp_path / "bank.h5")
    with BankWriter.open(path) as writer:
        writer.commit(1, green_of(1, 2), record_of(1, 2, status=4))
        writer.amend(2, status=16)
        assert writer.status.tolist() == [1, 4, 16, 1]
        assert writer.attempts.tolist() == [1, 2, 1, 1]
        assert np.array_equal(writer.green(1), green_of(1, 2))
    with open_bank(path) as bank, h5py.File(path, "r") as file:
        assert np.array_equal(bank.green(1), green_of(1, 2))
        assert file["status"][...].tolist() == bank.status.tolist() == [1, 4, 16, 1]
        assert not file["durability/journal"][...].any()
        assert np.array_equal(bank.green(2), green_of(2))
        assert bank.quality["snr_db"][2].tolist() == [1.0, 1.0]


def test_a_wrong_commit_then_is_refused_and_writes_nothing(tmp_path):
    path = measured(tmp_path / "bank.h5")
    before = path.read_bytes()
    with BankWriter.open(path) as writer:
        for position, green, message in (
            (4, green_of(0), "position 4 is not in bank"), (-1, green_of(0), "position -1 is not in bank"),
            (0, np.zeros((2, 15), np.float32), r"green of position 0 has shape \(2, 15\); \(2, 16\) is needed"),
            (0, np.full((2, 16), np.nan, np.float32), "green of position 0 holds values that are not finite"),
        ):  # fmt: skip
            with pytest.raises(InputError, match=message):
                writer.commit(position, green, record_of(0))
    assert path.read_bytes() == before


class FailingFile(PositionedFile):
    """A file whose disk fails at the n-th write or sync."""

    left = 0

    def write(self, offset, data):
        self._count()
        super().write(offset, data)

    def sync(self):
        self._count()
        super().sync()

    def _count(self):
        FailingFile.left -= 1
        if FailingFile.left == 0:
            raise OSError(errno.EIO, os.strerror(errno.EIO))


@pytest.mark.parametrize(
    ("position", "failing"),
    [(1, failing) for failing in range(1, 10)] + [(3, failing) for failing in range(1, 10, 3)],  # replaced; new
)
def test_a_write_that_fails_then_is_told_and_every_earlier_position_is_intact(tmp_path, failing, position):
    path = measured(tmp_path / "bank.h5", 3)
    FailingFile.left = 0
    writer = BankWriter.open(path, open_file=FailingFile)
    FailingFile.left = failing
    with pytest.raises(WavefocusError, match=f"writing position {position}: .*measured before is safe"):
        writer.commit(position, green_of(position, 2), record_of(position, 2))
    with pytest.raises(WavefocusError, match="takes no more commits"):
        writer.commit(0, green_of(0), record_of(0))
    writer.close()
    with BankWriter.open(path) as writer:
        for earlier in {0, 1, 2} - {position}:
            assert np.array_equal(writer.green(earlier), green_of(earlier))
        choices = [green_of(position, 2), green_of(position, 1) if position == 1 else np.zeros((2, 16))]
        assert any(np.array_equal(writer.green(position), choice) for choice in choices)


def edited(change):
    def edit(path):
        with h5py.File(path, "r+") as file:
            change(file)

    return edit


def external_storage(file):
    del file["position_mm"]
    file.create_dataset("position_mm", (4, 2), "<f8", external=[("/etc/passwd", 0, h5py.h5f.UNLIMITED)])


def virtual_status(file):
    layout = h5py.VirtualLayout((4,), "u1")
    layout[:] = h5py.VirtualSource("other.h5", "status", (4,))
    del file["status"]
    file.create_virtual_dataset("status", layout)


def flip_in_header(path):
    with h5py.File(path, "r") as file:
        offset = file["position_mm"].id.get_offset()
    flip(path, offset + 6)


def other_schema(path):
    with h5py.File(path, "w") as file:
        file["temperature"] = np.zeros(3)


REFUSED = [
    (edited(external_storage), "/position_mm keeps its data in other files"),
    (edited(virtual_status), "/status keeps its data in other files"),
    (edited(attribute("format_version", 2)), "version 2"),
    (edited(attribute("plan_sha256", "cd" * 32)), "header's checksum"),
    (edited(attribute("sample_rate_hz", 5000.0)), "damaged"),
    (edited(without("durability")), "made by another program"),
    (lambda path: os.truncate(path, path.stat().st_size - 8192), "is truncated"),
    (lambda path: os.truncate(path, 0), "is not an HDF5 file"),
    (lambda path: path.write_text("position,actuator\n"), "is not an HDF5 file"),
    (flip_in_header, "header's checksum"),
    (lambda path: flip(path, 20), "is damaged or not readable"),
    (other_schema, "says no format"),
]


@pytest.mark.parametrize(("change", "message"), REFUSED, ids=[message for _, message in REFUSED])
def test_a_file_that_is_no_sound_bank_then_is_refused_in_one_line_and_untouched(tmp_path, change, message):
    path = measured(tmp_path / "bank.h5")
    change(path)
    before, changed = path.read_bytes(), path.stat().st_mtime_ns
    with pytest.raises(InputError, match=message) as refusal:
        BankWriter.open(path)
    assert str(path) in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert path.read_bytes() == before
    assert path.stat().st_mtime_ns == changed
    assert [entry.name for entry in tmp_path.iterdir()] == ["bank.h5"]


def test_a_path_that_is_no_file_or_a_bank_of_another_plan_is_refused_and_untouched(tmp_path):
    path = measured(tmp_path / "bank.h5")
    (tmp_path / "link.h5").symlink_to(path)
    before, changed = path.read_bytes(), path.stat().st_mtime_ns
    for name, plan, message in (
        ("bank.h5", "cd", r"bank\.h5 belongs to another plan \(ababababab.*; resume it"),
        ("link.h5", "ab", r"link\.h5 is a symbolic link to .*bank\.h5"),
        ("missing.h5", "ab", "does not exist"), (".", "ab", "not a regular file"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=message):
            BankWriter.open(tmp_path / name, plan_sha256=plan * 32)
    assert (path.read_bytes(), path.stat().st_mtime_ns) == (before, changed)
    with BankWriter.open(path, plan_sha256="ab" * 32) as writer:
        assert writer.header.plan_sha256 == "ab" * 32


# It has a forked child, where there are such, that outlives it, as worker processes may.
HOLD = """
import os, sys
from wavefocus.storage.bank.writer import BankWriter
writer = BankWriter.open(sys.argv[1])
if not hasattr(os, "fork") or os.fork() == 0:
    print("open", flush=True)
sys.stdin.readline()
"""


def test_a_second_process_is_told_who_owns_the_bank_until_it_dies_leaving_a_child(tmp_path):
    path = measured(tmp_path / "bank.h5")
    command = [sys.executable, "-W", "ignore", "-c", HOLD, str(path)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as other:
        assert other.stdout.readline() == "open\n"
        with pytest.raises(BankBusyError, match=f"process {other.pid} on {socket.gethostname()}"):
            BankWriter.open(path)
        owner = bank_owner(path)
        assert (owner.host, owner.pid) == (socket.gethostname(), other.pid)
        other.kill()
        other.wait()
        assert owner_path(path).exists()  # left behind by the kill
        assert bank_owner(path) is None
        with BankWriter.open(path):
            assert json.loads(owner_path(path).read_text())["pid"] == os.getpid()
            with pytest.raises(BankBusyError, match=f"process {os.getpid()} on"):
                BankWriter.open(path)
    assert not owner_path(path).exists()


def _without_stored_rms(path, position):
    """Write a ledger row as versions before the stored rms did."""
    with h5py.File(path, "r") as file:
        offset = file["durability/ledger"].id.get_offset() + 4096 * position
    content = bytearray(path.read_bytes())
    page = content[offset : offset + 4096]
    page[48 + 16 * 2 :] = bytes(4096 - 48 - 16 * 2)
    page[8:12] = zlib.crc32(page[12:], zlib.crc32(page[:8])).to_bytes(4, "little")
    content[offset : offset + 4096] = page
    path.write_bytes(content)


def test_only_rows_of_an_older_version_are_read_for_the_rms_of_a_bank(tmp_path):
    path = measured(tmp_path / "bank.h5")
    _without_stored_rms(path, 2)
    true_rms = np.sqrt(np.mean(np.array([green_of(position) for position in range(4)], np.float64) ** 2, axis=2))
    with open_bank(path) as bank:
        assert np.isnan(bank.rms).all(axis=1).tolist() == [False, False, True, False]
        np.testing.assert_allclose(rms_map(bank), true_rms, rtol=1e-12)
    with h5py.File(path, "r+", locking=False) as file:
        file["green"][0] = 0  # a row that no scene visits
    with open_bank(path) as bank:
        np.testing.assert_allclose(rms_map(bank), true_rms, rtol=1e-12)


@pytest.mark.parametrize("first_edition", [False, True])
def test_a_row_measured_aside_then_says_so_also_in_a_bank_of_the_first_edition(tmp_path, first_edition):
    path, stated = measured(tmp_path / "bank.h5"), {"moved_mm": 0.141, "reference_db": -0.037}
    if first_edition:
        with h5py.File(path, "r+") as file:  # what it did not have
            del file["quality/moved_mm"], file["quality/reference_db"]
            del file.attrs["layout_later_crc32"], file.attrs["contents_sha256"]
    with open_bank(path) as bank:
        assert bank.status.tolist() == [1, 1, 1, 1]
        assert np.isnan(bank.quality["moved_mm"]).all()
    with BankWriter.open(path) as writer:
        writer.commit(2, green_of(2), replace(record_of(2), moved_mm=0.1414, reference_db=-0.0372))
        assert writer.reference_before_db(3) == pytest.approx(-0.037)
        assert writer.reference_before_db(2) is None
    with open_bank(path) as bank, h5py.File(path, "r", locking=False) as file:
        assert bank.verify() == ()
        for name, value in stated.items():
            assert bank.quality[name][2] == pytest.approx(value)
            assert np.isnan(bank.quality[name][[0, 1, 3]]).all()
            assert first_edition or np.array_equal(file["quality"][name], bank.quality[name], equal_nan=True)
    BankWriter.open(path).close()
    assert not [one for one in check_bank(path) if "differ" in one.message]
