"""Responses in other formats become banks through the command line; the formats are in unit tests."""

import functools
import json

import numpy as np
import pytest
import soundfile

from tests.lab_files import change_text, point_scene, write_bank
from tests.system import captures
from tests.system.captures import answered, wavefocus
from wavefocus.storage.bank.notes import add_note
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter

RATE_HZ, TAPS, ACTUATORS, POSITIONS = 2000.0, 60, 3, 12
PLACES_MM = np.array([[4.0 * (row % 4), 4.0 * (row // 4)] for row in range(POSITIONS)]) - 6.0
ACTUATORS_MM = np.array([[50.0, 0.0], [0.0, 48.5], [-50.0, 10.0]])
GREEN = (
    np.random.default_rng(7).standard_normal((POSITIONS, ACTUATORS, TAPS)) * 3e-3 * np.exp(-np.arange(TAPS) / 8)
).astype(np.float32)
NOTES = [
    "bolt 3 was loose",
    "Schraube l\u00f6ste sich,\nline 2 \\ -1" + 9 * " a very long story of what happened",
    "\U0001f527",
]


@pytest.fixture(scope="module")
def bank(tmp_path_factory):
    """A bank in a unit, as it is written: with a poor row and notes."""

    @functools.cache
    def bank_in(unit="m/s/V"):
        path = tmp_path_factory.mktemp("bank") / "plate of silicone, status 2, measured with the new coil and bolt 3.h5"
        units = (unit, unit.replace(" per ", "/").rpartition("/")[2])
        write_bank(path, GREEN, PLACES_MM, actuator_mm=ACTUATORS_MM, rate_hz=RATE_HZ, units=units)
        with BankWriter.open(path) as writer:
            writer.amend(1, status=4, leak_db=-200.0)
        for text in NOTES:
            add_note(path, text)
        return path

    return bank_in


@pytest.fixture
def imported(tmp_path, capsys):
    """Import a file with options; returns the bank and the report."""

    def do(source, *options):
        out = tmp_path / f"imported-{len(list(tmp_path.iterdir()))}.h5"
        return out, answered(capsys, "import", source, "--bank", out, *options)

    return do


@pytest.fixture
def refused(tmp_path, capsys):
    """Import a file that cannot be; returns the one sentence."""

    def do(source, *options):
        before = sorted(tmp_path.iterdir())
        line = captures.refused(capsys, "import", source, "--bank", tmp_path / "refused.h5", *options)
        assert sorted(tmp_path.iterdir()) == before
        return line

    return do


@pytest.mark.parametrize(
    ("kind", "unit", "comes_back"),
    [
        *((kind, "mm/s\u00b2/kN", "mm/s^2/kN") for kind in ("sofa", "uff", "wav", "netcdf")),
        *((kind, "m/s per mV", "m/s/mV") for kind in ("uff-binary", "mat", "npz")),
    ],
)
def test_our_own_export_then_the_bank_its_units_and_its_notes_come_back(
    bank, tmp_path, imported, capsys, kind, unit, comes_back
):
    bank = bank(unit)
    out = tmp_path / "there"
    assert wavefocus("export", bank, out, "--to", kind) == 0
    assert "uff" not in kind or all(len(line) <= 80 for line in out.read_bytes().split(b"\n")[:30])
    back, told = imported(out)
    assert told["format"] == kind.partition("-")[0]
    with open_bank(back, contents=True) as view, open_bank(bank) as origin:
        assert np.array_equal([view.green(row) for row in range(POSITIONS)], GREEN)
        assert np.abs(view.position_mm - PLACES_MM).max() < 1e-6
        assert np.abs(view.actuator_mm - ACTUATORS_MM).max() < 1e-6
        assert view.sample_rate_hz == RATE_HZ
        assert (view.response_unit, view.drive_unit) == (comes_back, comes_back.rpartition("/")[2])
        assert view.status.tolist()[:2] == [1, 4]
        assert view.quality["leak_db"][1] == -200.0 or kind not in ("netcdf", "mat", "npz")
        assert view.notes == origin.notes or kind in ("sofa", "mat", "uff", "uff-binary")
        assert [note.text for note in origin.notes] == NOTES
    if kind == "npz":
        assert wavefocus("check", back) == 0
        assert wavefocus("status", back) == 0
        assert told["paragraph"] in capsys.readouterr().out


def test_sound_files_of_an_earlier_version_with_an_actuator_each_then_they_are_read(bank, tmp_path, imported):
    folder = tmp_path / "there"
    assert wavefocus("export", bank(), folder, "--to", "wav") == 0
    facts = json.loads((folder / "bank.json").read_text(encoding="utf-8"))
    sound = np.stack([soundfile.read(folder / one["file"], dtype="float32")[0] for one in facts["files"]])
    facts["channels"], facts["files"] = "positions", [{"file": f"actuator-{number}.wav"} for number in range(ACTUATORS)]
    for number, one in enumerate(facts["files"]):
        soundfile.write(folder / one["file"], sound[:, :, number].T, int(RATE_HZ), subtype="FLOAT")
    (folder / "bank.json").write_text(json.dumps(facts), encoding="utf-8")
    with open_bank(imported(folder)[0]) as view:
        assert np.array_equal([view.green(row) for row in range(POSITIONS)], GREEN)


def write_array(folder, values, places_mm=PLACES_MM):
    """Write an array and a table of places; returns the array's file and the options that name the table."""
    np.save(folder / "g.npy", values)
    lines = [",".join(["x_mm", "y_mm", "z_mm"][: places_mm.shape[1]]), *(",".join(map(str, one)) for one in places_mm)]
    (folder / "places.csv").write_text("\n".join(lines), encoding="utf-8")
    return folder / "g.npy", ["--places", str(folder / "places.csv")]


def test_given_options_that_a_file_lacks_then_each_is_asked_for_by_its_name(tmp_path, refused):
    responses, places = write_array(tmp_path, np.fft.rfft(GREEN, 128))
    assert "--places" in refused(responses)
    assert "--frequencies" in refused(responses, *places)
    assert "--unit" in refused(responses, *places, "--frequencies", "0,15.625")
    np.save(responses, GREEN)
    assert "--sample-rate-hz" in refused(responses, *places, "--unit", "m/s/V")
    table = tmp_path / "places.csv"
    table.write_text(table.read_text(encoding="utf-8").replace("_mm", ""), encoding="utf-8")
    assert "--length-unit" in refused(responses, *places)


def test_given_a_bank_or_an_input_then_it_is_never_written_over(bank, tmp_path):
    source, places = write_array(tmp_path, GREEN)
    np.save(tmp_path / "f.npy", np.arange(3.0))
    options = [*places, "--unit", "m/s/V", "--sample-rate-hz", "2000", "--frequencies", str(tmp_path / "f.npy")]
    for victim in (bank(), source, tmp_path / "places.csv", tmp_path / "f.npy"):
        content = victim.read_bytes()
        for force in ([], ["--force"]):
            assert wavefocus("import", source, "--bank", victim, *options, *force) == 2
        assert victim.read_bytes() == content


def test_for_places_in_space_two_columns_are_chosen_and_the_rest_is_named(tmp_path, imported, refused, capsys):
    source, places = write_array(tmp_path, GREEN, np.column_stack([PLACES_MM, 30.0 * np.arange(POSITIONS) % 50.0]))
    options = [*places, "--unit", "m/s/V", "--sample-rate-hz", "2000"]
    assert "--columns" in refused(source, *options)
    back, told = imported(source, *options, "--columns", "x,y")
    assert set(told["unsuited"]) == {"kernel", "bilinear"}
    scene = tmp_path / "scene.toml"
    render = ["render", scene, "--bank", back, "--out", tmp_path / "drive.h5"]
    limit = '[output]\nlimit_v = 0.5\ninterpolation = "kernel"'
    sine = 'kind = "sine", frequency_hz = 150.0, duration_s = 0.02'
    scene.write_text(point_scene([2, 2], sine, limit), encoding="utf-8")
    assert "kernel" in captures.refused(capsys, *render)
    change_text(scene, "kernel", "nearest")
    assert told["caution"] in answered(capsys, *render)["warnings"]
