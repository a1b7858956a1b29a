"""Banks exported through the command line, and read back with the packages that the formats belong to."""

import csv
import json

import h5py
import numpy as np
import pytest
import pyuff
import scipy.io
import sofar
import soundfile
import xarray

from tests.system.captures import answered, refused
from wavefocus.storage.bank.reading import open_bank

RATE_HZ, TAPS, ACTUATORS, POSITIONS = 2000.0, 60, 3, 6
STATUS = [1, 1, 0, 8, 4, 1]
KEPT = [0, 1, 4, 5]
PLACES_MM = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0], [0.0, 4.0], [4.0, 4.0], [8.0, 4.0]])
ACTUATORS_MM = np.array([[50.0, 0.0], [np.nan, np.nan], [-50.0, 10.0]])


@pytest.fixture
def bank(tmp_path):
    """A bank of another program and an odd name: partly measured, one row failed, one actuator's place is unknown."""
    green = np.random.default_rng(7).standard_normal((POSITIONS, ACTUATORS, TAPS)).astype(np.float32) * 3e-3
    green[2] = 0.0
    green[3, 1, 5] = np.nan
    path = tmp_path / "a\nb \u00e4.h5"
    with h5py.File(path, "w") as file:
        file["green"], file["position_mm"], file["actuator_mm"] = green, PLACES_MM, ACTUATORS_MM
        file["status"] = np.array(STATUS, np.uint8)
        file.attrs["sample_rate_hz"] = RATE_HZ
    return path


def green_of(bank):
    with h5py.File(bank, "r") as file:
        return np.asarray(file["green"])


def export(capsys, *arguments):
    return answered(capsys, "export", *arguments)


PUBLICATION = """
[publication]
title = "Plate \u00e4"
licence = "CC-BY-4.0"
organisation = "A University"
database = "plates"
room = "laboratory"
people = [{ name = "Jane D\u00f6e", orcid = "0000-0002-1825-0097" }, { name = "John Roe" }]
"""


@pytest.fixture
def publication(tmp_path):
    path = tmp_path / "publication.toml"
    path.write_text(PUBLICATION, encoding="utf-8")
    return path


def read_verified(path):
    sofa = sofar.read_sofa(str(path), verify=True, verbose=False)
    sofa.verify(issue_handling="raise")
    return sofa


def test_given_a_bank_then_sofar_reads_what_acoustics_needs(bank, tmp_path, capsys):
    told = export(capsys, bank, tmp_path / "bank.sofa", "--to", "sofa")
    assert (told["positions"], told["left_out"]) == (4, 2)
    sofa = read_verified(tmp_path / "bank.sofa")
    assert (sofa.GLOBAL_SOFAConventions, sofa.GLOBAL_DataType) == ("GeneralFIR-E", "FIR-E")
    assert np.array_equal(sofa.Data_IR[:, 0], green_of(bank)[KEPT].transpose(0, 2, 1).astype(float))
    assert sofa.Data_SamplingRate == RATE_HZ
    assert np.allclose(sofa.ListenerPosition[:, :2], PLACES_MM[KEPT] / 1e3, rtol=0, atol=1e-9)
    assert np.allclose(sofa.EmitterPosition[:, :2], ACTUATORS_MM / 1e3, rtol=0, atol=1e-9, equal_nan=True)
    assert sofa.BankPosition.tolist() == KEPT
    assert "m/s/V" in sofa.GLOBAL_Comment
    assert (sofa.GLOBAL_License, sofa.GLOBAL_RoomType) == ("not stated", "free field")


def test_a_publication_then_the_sofa_file_states_it_in_hdf5_that_libmysofa_reads(bank, tmp_path, publication, capsys):
    export(capsys, bank, tmp_path / "bank.sofa", "--to", "sofa", "--publication", publication)
    sofa = read_verified(tmp_path / "bank.sofa")
    assert (sofa.GLOBAL_Title, sofa.GLOBAL_License) == ("Plate \u00e4", "CC-BY-4.0")
    assert (sofa.GLOBAL_Organization, sofa.GLOBAL_DatabaseName) == ("A University", "plates")
    assert (sofa.GLOBAL_RoomType, sofa.GLOBAL_RoomDescription) == ("reverberant", "laboratory")
    assert sofa.GLOBAL_AuthorContact == "Jane D\u00f6e (https://orcid.org/0000-0002-1825-0097); John Roe"
    with h5py.File(tmp_path / "bank.sofa") as file:
        names: list[bytes] = []
        root = file["/"]
        root.id.links.iterate(names.append, idx_type=h5py.h5.INDEX_CRT_ORDER)
        assert (names[0], names[-1]) == (b"I", b"Data.IR")  # the order of creation is kept
        for name in file.attrs:
            kind = h5py.h5a.open(file.id, name.encode()).get_type()
            assert (kind.get_strpad(), kind.get_cset()) == (h5py.h5t.STR_NULLTERM, h5py.h5t.CSET_ASCII), name
        assert all(one.dtype == np.float64 and one.chunks is None for name, one in file.items() if len(name) > 1)


@pytest.mark.parametrize("form", ["uff", "uff-binary"])
def test_given_a_bank_then_pyuff_reads_nodes_and_functions(bank, tmp_path, capsys, form):
    export(capsys, bank, tmp_path / "bank.uff", "--to", form)
    sets = pyuff.UFF(str(tmp_path / "bank.uff")).read_sets()
    assert [int(one["type"]) for one in sets] == [164, 2411] + [58] * (len(KEPT) * ACTUATORS)
    nodes = dict(zip(map(int, sets[1]["node_nums"]), zip(sets[1]["x"], sets[1]["y"], strict=True), strict=True))
    assert sorted(nodes) == [1, 2, 5, 6, POSITIONS + 1, POSITIONS + 3]
    green = green_of(bank)
    for function in sets[2:]:
        row, actuator = int(function["rsp_node"]) - 1, int(function["ref_node"]) - POSITIONS - 1
        assert np.array_equal(function["data"].astype(np.float32), green[row, actuator])
        assert np.allclose(nodes[row + 1], PLACES_MM[row] / 1e3, rtol=0, atol=1e-9)
        assert np.allclose(np.diff(function["x"]), 1 / RATE_HZ)
        assert function["id2"].startswith(f"a?b \u00e4.h5, row {row}")


@pytest.mark.parametrize("engine", ["h5netcdf", "netcdf4"])
def test_given_a_bank_then_xarray_and_we_read_its_rows_with_labels(bank, tmp_path, publication, capsys, engine):
    export(capsys, bank, tmp_path / "bank.nc", "--to", "netcdf", "--publication", publication)
    with xarray.open_dataset(tmp_path / "bank.nc", engine=engine, chunks={}) as data:
        assert data.green.dims == ("position", "actuator", "time_s")
        assert data.green.chunks[0] == (1,) * len(KEPT)
        assert np.array_equal(data.green.values, green_of(bank)[KEPT])
        assert data.position.values.tolist() == KEPT
        assert np.array_equal(data.position_mm.values, PLACES_MM[KEPT])
        assert np.array_equal(data.actuator_mm.values, ACTUATORS_MM, equal_nan=True)
        assert set(data.green.coords) == {"position", "actuator", "time_s", "x_mm", "y_mm", "status"}
        assert {name: data[name].attrs["units"] for name in ("green", "time_s", "snr_db")} == {
            "green": "m/s/V", "time_s": "s", "snr_db": "0.1 lg(re 1)",
        }  # fmt: skip
        assert all("long_name" in one.attrs for one in data.variables.values())
        assert data.attrs["Conventions"].startswith("CF-")
        assert (data.attrs["license"], data.attrs["title"]) == ("CC-BY-4.0", "Plate \u00e4")
    with open_bank(tmp_path / "bank.nc") as copy:
        assert np.array_equal(copy.green(2), green_of(bank)[KEPT[2]])
        assert (copy.status.tolist(), copy.sample_rate_hz) == ([STATUS[row] for row in KEPT], RATE_HZ)


def test_given_a_bank_then_a_table_lists_its_positions(bank, tmp_path, capsys):
    export(capsys, bank, tmp_path / "places.csv", "--to", "csv", "--missing", "nan")
    with (tmp_path / "places.csv").open(encoding="utf-8", newline="") as file:
        lines = list(csv.DictReader(file))
    assert [int(line["index"]) for line in lines] == list(range(POSITIONS))
    assert [[float(line["x_mm"]), float(line["y_mm"])] for line in lines] == PLACES_MM.tolist()
    assert [line["status"] for line in lines] == ["valid", "valid", "not-measured", "failed", "poor", "valid"]
    assert {line["snr_db"] for line in lines} == {""}


def test_given_a_bank_then_its_sound_files_hold_its_numbers_exactly(bank, tmp_path, capsys):
    export(capsys, bank, tmp_path / "sounds", "--to", "wav")
    facts = json.loads((tmp_path / "sounds" / "bank.json").read_text(encoding="utf-8"))
    green = green_of(bank)[KEPT]
    assert facts["position"] == KEPT
    assert facts["actuator_mm"] == [[50.0, 0.0], None, [-50.0, 10.0]]
    assert len(facts["files"]) == len(KEPT)
    places = list(csv.DictReader((tmp_path / "sounds" / "places.csv").read_text(encoding="utf-8").splitlines()))
    assert [int(one["index"]) for one in places] == KEPT
    assert [one["file"] for one in places] == [one["file"] for one in facts["files"]]
    for place, one in enumerate(facts["files"]):
        samples, rate_hz = soundfile.read(tmp_path / "sounds" / one["file"], dtype="float32", always_2d=True)
        assert rate_hz == RATE_HZ
        assert np.abs(samples).max() <= 1.0
        assert np.array_equal(samples.T * np.float32(facts["scale"]), green[place])


@pytest.mark.parametrize("kind", ["mat", "npz"])
def test_given_nan_for_what_is_missing_then_arrays_hold_every_row(bank, tmp_path, publication, capsys, kind):
    out = tmp_path / f"bank.{kind}"
    told = export(capsys, bank, out, "--to", kind, "--missing", "nan", "--publication", publication)
    assert (told["positions"], told["nan"]) == (POSITIONS, 2)
    arrays = scipy.io.loadmat(out) if kind == "mat" else dict(np.load(out, allow_pickle=False))
    green = green_of(bank)
    green[[2, 3]] = np.nan
    assert np.array_equal(arrays["green"], green, equal_nan=True)
    assert arrays["green"].dtype == np.float32
    assert np.array_equal(arrays["position_mm"], PLACES_MM)
    assert arrays["status"].ravel().tolist() == STATUS
    assert float(np.squeeze(arrays["sample_rate_hz"])) == RATE_HZ
    assert str(np.squeeze(arrays["response_unit"])) == "m/s/V"
    assert arrays["quality_snr_db"].shape == (POSITIONS, ACTUATORS)
    if kind == "npz":
        export(capsys, bank, tmp_path / "some.npz", "--to", "npz", "--positions", "5,0-1")
        some = np.load(tmp_path / "some.npz", allow_pickle=False)
        assert some["position"].tolist() == [5, 0, 1]
        assert np.array_equal(some["green"], green[[5, 0, 1]])
    else:
        content = scipy.io.loadmat(out, simplify_cells=True)
        about = content["about"]  # a struct that explains the variables
        assert "green(p, a, k)" in about["readme"]
        assert set(about["units"]) <= set(content)
        assert (about["units"]["green"], about["publication"]["licence"]) == ("m/s/V", "CC-BY-4.0")


@pytest.mark.parametrize(
    ("out", "to", "options", "told"),
    [
        ("bank.uff", "uff", ["--missing", "nan"], " missing nan: uff files hold no NaN"),
        ("bank.npz", "npz", ["--positions", "2-3"], "nothing to export"),
        ("nowhere/bank.npz", "npz", [], "there is no folder"),
        ("a\nb \u00e4.h5", "npz", [], "is an input"),
        ("a\nb \u00e4.h5", "wav", [], "is a file; wav writes a folder of files"),
        ("bank.doc", "doc", [], "'doc' is not allowed"),
        ("bank.npz", "npz", ["--publication", "nowhere.toml"], "nowhere.toml: no such file"),
    ],
)
def test_given_what_cannot_be_exported_then_one_sentence_says_why(bank, tmp_path, capsys, out, to, options, told):
    before = bank.read_bytes()
    assert told in refused(capsys, "export", bank, tmp_path / out, "--to", to, *options)
    assert bank.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == [bank.name]


def test_given_a_wrong_publication_then_its_key_is_named(bank, tmp_path, capsys):
    wrong = tmp_path / "wrong.toml"
    for table, told in (
        ("[grid]\nspacing_mm = 4.0", "publication: is missing"),
        ("[publication]\nlicence = 4", "publication.licence = 4: must be text in quotes"),
        ("[publication]\nlicense = 'MIT'", "publication.license"),
        ('[publication]\ntitle = "a\\nb"', "must be one line of text"),
        ("[publication]\npeople = [{ name = 'A', orcid = '1' }]", "publication.people[0].orcid"),
    ):
        wrong.write_text(table, encoding="utf-8")
        words = ["export", bank, tmp_path / "bank.npz", "--to", "npz", "--publication", wrong]
        assert told in refused(capsys, *words)
