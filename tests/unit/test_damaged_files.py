"""Damaged and hostile HDF5 files, fault x kind of file: what changes a value is found, and none ends in a traceback."""

import zlib

import h5py
import numpy as np
import pytest

from tests.lab_files import raw_header, write_bank
from tests.unit.mutations import mutations, snapshot, stored_bytes
from wavefocus import Drive, InputError, open_bank, read_drive, write_drive
from wavefocus.calibration.check import check_file
from wavefocus.storage.field_file import Field, FieldRowReader, read_field, write_field
from wavefocus.storage.raw.writer import RawWriter, create_raw, open_raw

RNG = np.random.default_rng(0)
LARGE = 10**12


def a_bank(path):
    green = RNG.normal(size=(5, 3, 100)) * np.exp(-np.arange(100) / 7)
    write_bank(path, green, rows=range(4))  # the last one is not measured


def a_raw_file(path):
    create_raw(path, raw_header(5, 3, 400))
    with RawWriter.open(path) as writer:
        for position in range(4):
            volts = RNG.integers(-999, 999, (2, 3, 400)).astype(np.float32) / np.float32(1024)
            writer.commit(position, volts[0], volts[1])


def a_drive(path):
    foci = np.arange(7)
    write_drive(path, Drive(RNG.normal(size=(3, 300)), 1e4, -0.01, "sampled", 0.5, 1e-6, foci, foci % 5, foci * 0))


def a_field(path):
    write_field(path, Field(RNG.normal(size=(5, 400)), np.arange(5), 1e4, -0.01, "m/s"))


MAKERS = {"bank": a_bank, "raw": a_raw_file, "drive": a_drive, "field": a_field}


@pytest.fixture(scope="module", params=MAKERS)
def sound(request, tmp_path_factory):
    """A sound file of each kind."""
    path = tmp_path_factory.mktemp("sound") / "file.h5"
    MAKERS[request.param](path)
    assert check_file(path) == []
    return path.read_bytes()


@pytest.mark.timeout(600)
@pytest.mark.parametrize("count", [6, pytest.param(1000, marks=pytest.mark.nightly)])
def test_single_mutations_then_are_found_where_they_change_a_value(tmp_path, sound, count):
    path, missed = tmp_path / "file.h5", []
    path.write_bytes(sound)
    before = snapshot(path)
    for what, changed in mutations(sound, stored_bytes(path), count, seed=1):
        path.write_bytes(changed)
        try:
            passed = not any(one.severity == "error" for one in check_file(path))
        except InputError:
            continue
        if passed and snapshot(path) != before:
            missed.append(what)
    assert missed == []


VALUES: list[object] = [
    "x", "", b"\xff\xfe", -1, 0, 1e308, 5e-324, np.nan, np.array([], np.float64), np.zeros((3, 3)), h5py.Empty("f8"),
    True, np.array([(1, 2.0)], [("a", "i4"), ("b", "f8")]), 1 + 2j, 2**63,
    np.array(["a", "b"], dtype=h5py.string_dtype()),
]  # fmt: skip


def keys_of(path):
    """All attributes of a file, and those that files of others may have."""
    found = []
    with h5py.File(path, "r") as file:
        found += [("/", key) for key in file.attrs]
        file.visititems(lambda name, item: found.extend((name, key) for key in item.attrs))
    datasets = sorted({name for name, _ in found if name != "/"})
    of_others = ("scale_factor", "add_offset", "_FillValue", "volts_per_count")
    scales = {"DIMENSION_LIST", "REFERENCE_LIST", "CLASS", "NAME"}
    return [(name, key) for name, key in found if key not in scales] + [(a, b) for a in datasets for b in of_others]


@pytest.mark.parametrize(
    ("count", "checked"),
    [(3, True), (8, False), *(pytest.param(500, checked, marks=pytest.mark.nightly) for checked in (True, False))],
)
def test_a_hostile_attribute_then_never_ends_in_a_traceback(tmp_path, sound, count, *, checked):
    path = tmp_path / "file.h5"
    path.write_bytes(sound)
    cases = [(*where, value) for where in keys_of(path) for value in VALUES]
    for number in np.random.default_rng(3).permutation(len(cases))[:count].tolist():
        name, key, value = cases[number]
        path.write_bytes(sound)
        with h5py.File(path, "r+") as file:
            file[name].attrs[key] = value
            if not checked:  # so that each value is met by what reads it, not by a checksum before
                file.attrs.pop("contents_sha256", None)
        try:
            check_file(path)
        except InputError as refusal:
            told = str(refusal)
        else:
            told = ""
        assert "\n" not in told, cases[number]


def declared(name, shape, chunks, **options):
    """A file of a bank, drive or field that declares the shape of its largest dataset and holds nothing of it."""

    def make(path):
        with h5py.File(path, "w") as file:
            file.create_dataset(name, shape, "f4", chunks=chunks, **options)
            file.create_dataset("position_mm", (shape[0], 2), "f8", chunks=(1, 2))
            if name != "green":
                file.attrs.update(format=f"wavefocus-{name}", format_version=1, start_s=0.0, response_unit="m/s")
                file["position_index"] = [0, 1]
            file.attrs["sample_rate_hz"] = 1e4

    return make


def declared_raw(path):
    with h5py.File(path, "w") as file:
        file.attrs.update(format="wavefocus-raw", format_version=1, sample_rate_hz=1e4, taps=16, band_hz=[1.0, 9.0])
        for name in ("response", "reference"):
            file.create_dataset(name, (LARGE, 1, 64), "i2", chunks=(16, 1, 64))
        file.create_dataset("position_mm", (LARGE, 2), "f8", chunks=(16, 2))
        file["schedule/actuator"] = [[0]]
        file["schedule/delay_s"] = file["schedule/gain"] = np.ones((1, 1))


@pytest.mark.parametrize(
    ("make", "read"),
    [
        (declared("green", (14, 4, LARGE), (14, 4, 16)), open_bank),
        (declared("green", (LARGE, 1, 1), (16, 1, 1)), open_bank),
        (declared("green", (14, 10**9, 10), (14, 16, 10)), check_file),
        (declared("drive", (2, LARGE), (2, 16)), read_drive),
        (declared("field", (2, LARGE), (2, 16)), read_field),
        (declared("field", (2, LARGE), (2, 16)), FieldRowReader),
        (declared_raw, open_raw),
    ],
)
def test_a_small_file_that_declares_terabytes_then_is_refused_with_the_size(tmp_path, make, read):
    make(tmp_path / "file.h5")
    with pytest.raises(InputError, match=r"(TiB|GiB).*WAVEFOCUS_MOST_GIB"):
        read(tmp_path / "file.h5")


def test_a_chunk_that_unfolds_to_gigabytes_or_to_more_than_declared_is_not_read(tmp_path, monkeypatch):
    path, longer = tmp_path / "bank.h5", tmp_path / "longer.h5"
    for file, taps, actuators in ((path, 1 << 20, 4), (longer, 1 << 14, 1)):
        declared("green", (1, actuators, taps), (1, actuators, taps), compression="gzip")(file)
    with h5py.File(path, "r+") as file, h5py.File(longer, "r+") as other:
        file["green"][0] = np.zeros((4, 1 << 20), "f4")  # 16 MiB in 16 kB
        other["green"].id.write_direct_chunk((0, 0, 0), zlib.compress(RNG.bytes(1 << 17)))
    with pytest.raises(InputError, match="compressed chunk"):
        open_bank(longer)
    with open_bank(path) as bank:
        assert bank.green(0).shape == (4, 1 << 20)
    for most, told in (("0.01", "16 MiB"), ("lots", "WAVEFOCUS_MOST_GIB is 'lots'")):
        monkeypatch.setenv("WAVEFOCUS_MOST_GIB", most)
        with pytest.raises(InputError, match=told):
            open_bank(path)
