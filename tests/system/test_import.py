"""Responses in other formats become banks through the command line: our own exports, and files as others make them."""

import json
from typing import Any

import h5py
import numpy as np
import pytest
import pyuff
import scipy.io
import sofar
import soundfile

from wavefocus.__main__ import run
from wavefocus.storage.bank.reading import open_bank

RATE_HZ, TAPS, ACTUATORS, POSITIONS = 2000.0, 60, 3, 12
PLACES_MM = np.array([[4.0 * (row % 4), 4.0 * (row // 4)] for row in range(POSITIONS)]) - 6.0
ACTUATORS_MM = np.array([[50.0, 0.0], [0.0, 48.5], [-50.0, 10.0]])
GREEN = (
    np.random.default_rng(7).standard_normal((POSITIONS, ACTUATORS, TAPS)) * 3e-3 * np.exp(-np.arange(TAPS) / 8)
).astype(np.float32)


@pytest.fixture
def bank(tmp_path):
    """A bank of another program, with a status and one actuator's place."""
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["green"], file["position_mm"], file["actuator_mm"] = GREEN, PLACES_MM, ACTUATORS_MM
        file["status"] = np.array([1, 4, *[1] * (POSITIONS - 2)], np.uint8)
        file.attrs["sample_rate_hz"] = RATE_HZ
    return tmp_path / "foreign.h5"


@pytest.fixture
def imported(tmp_path, capsys):
    """Import a file with options; returns the bank and the report."""

    def do(source, *options):
        out = tmp_path / f"imported-{len(list(tmp_path.iterdir()))}.h5"
        capsys.readouterr()
        assert run(["import", str(source), "--bank", str(out), *options, "--json"]) == 0, capsys.readouterr().err
        return out, dict(json.loads(capsys.readouterr().out))

    return do


@pytest.fixture
def refused(tmp_path, capsys):
    """Import a file that cannot be; returns the one sentence."""

    def do(source, *options):
        before = sorted(tmp_path.iterdir())
        assert run(["import", str(source), "--bank", str(tmp_path / "refused.h5"), *options]) == 2
        lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("wavefocus:")]
        assert len(lines) == 1
        assert sorted(tmp_path.iterdir()) == before
        return lines[0]

    return do


def green_of(bank):
    with open_bank(bank, contents=True) as view:
        return np.stack([view.green(row) for row in range(view.positions)])


@pytest.mark.parametrize("kind", ["sofa", "uff", "uff-binary", "wav", "wav-actuator", "mat", "npz", "netcdf"])
def test_given_our_own_export_then_the_bank_comes_back(bank, tmp_path, imported, capsys, kind):
    assert run(["export", str(bank), str(tmp_path / "there"), "--to", kind]) == 0
    back, told = imported(tmp_path / "there")
    assert told["format"] == kind.partition("-")[0]
    assert np.array_equal(green_of(back), GREEN)
    with open_bank(back) as view:
        assert np.abs(view.position_mm - PLACES_MM).max() < 1e-6
        assert np.abs(view.actuator_mm - ACTUATORS_MM).max() < 1e-6
        assert view.sample_rate_hz == RATE_HZ
        assert (view.response_unit, view.drive_unit) == ("m/s/V", "V")
        assert view.status.tolist()[:2] == [1, 4]
    assert run(["check", str(back)]) == 0
    assert run(["status", str(back)]) == 0
    assert told["paragraph"] in capsys.readouterr().out


def test_given_options_that_a_file_lacks_then_each_is_asked_for_by_its_name(tmp_path, refused):
    responses = tmp_path / "frf.npy"
    np.save(responses, np.fft.rfft(GREEN, 128))
    (tmp_path / "places.csv").write_text(table(PLACES_MM), encoding="utf-8")
    places = ["--places", str(tmp_path / "places.csv")]
    assert "--places" in refused(responses)
    assert "--frequencies" in refused(responses, *places)
    assert "--unit" in refused(responses, *places, "--frequencies", "0,15.625")
    np.save(responses, GREEN)
    assert "--sample-rate-hz" in refused(responses, *places, "--unit", "m/s/V")
    (tmp_path / "places.csv").write_text(table(PLACES_MM).replace("_mm", ""), encoding="utf-8")
    assert "--length-unit" in refused(responses, *places)


def test_given_an_older_bank_then_it_is_never_written_over(bank, tmp_path, imported):
    assert run(["export", str(bank), str(tmp_path / "b.npz"), "--to", "npz"]) == 0
    older, _ = imported(tmp_path / "b.npz")
    content = older.read_bytes()
    for force in ([], ["--force"]):
        assert run(["import", str(tmp_path / "b.npz"), "--bank", str(older), *force]) == 2
        assert run(["import", str(tmp_path / "b.npz"), "--bank", str(tmp_path / "b.npz"), *force]) == 2
    assert older.read_bytes() == content


def test_for_places_in_space_two_columns_are_chosen_and_the_rest_is_named(tmp_path, imported, refused, capsys):
    np.save(tmp_path / "g.npy", GREEN)
    places_mm = np.column_stack([PLACES_MM, 30.0 * np.arange(POSITIONS) % 50.0])
    (tmp_path / "places.csv").write_text(table(places_mm), encoding="utf-8")
    options = ["--places", str(tmp_path / "places.csv"), "--unit", "m/s/V", "--sample-rate-hz", "2000"]
    assert "--columns" in refused(tmp_path / "g.npy", *options)
    back, told = imported(tmp_path / "g.npy", *options, "--columns", "x,y")
    assert set(told["unsuited"]) == {"kernel", "bilinear"}
    scene = tmp_path / "scene.toml"
    scene.write_text(SCENE.format(kind="kernel"), encoding="utf-8")
    assert run(["render", str(scene), "--bank", str(back), "--out", str(tmp_path / "drive.h5")]) == 2
    assert "kernel" in capsys.readouterr().err
    scene.write_text(SCENE.format(kind="nearest"), encoding="utf-8")
    assert run(["render", str(scene), "--bank", str(back), "--out", str(tmp_path / "drive.h5"), "--json"]) == 0
    assert told["caution"] in json.loads(capsys.readouterr().out)["warnings"]


def test_given_sound_files_and_a_table_then_each_pair_is_found(tmp_path, imported, refused):
    folder = tmp_path / "rooms"
    folder.mkdir()
    sound = np.random.default_rng(3).standard_normal((4, 2, 300)).astype(np.float32) * 0.1
    lines = ["file,x_m,y_m,actuator,role"]
    for place in range(4):
        for source, name in enumerate(("left", "right")):
            soundfile.write(folder / f"{place}{name}.wav", sound[place, source], 48_000, subtype="FLOAT")
            lines.append(f"{place}{name}.wav,{0.5 * place},{0.1 * place**2},{name},")
    table_text = "\n".join([*lines, ",2,0,right,actuator"])
    (tmp_path / "p.csv").write_text("\ufeff" + table_text.replace(",", ";"), encoding="utf-8")
    back, told = imported(folder, "--places", str(tmp_path / "p.csv"), "--unit", "Pa/V")
    assert np.array_equal(green_of(back)[:, [1, 0]], sound)
    with open_bank(back) as view:
        assert view.sample_rate_hz == 48_000
        assert np.allclose(view.position_mm, [[500.0 * one, 100.0 * one**2] for one in range(4)])
        assert view.actuator_mm.tolist()[0] == [2000.0, 0.0]
        assert np.isnan(view.actuator_mm[1]).all()
    assert "kernel" in told["unsuited"]
    (tmp_path / "p.csv").write_text("file,x_m,y_m\n../rooms/0left.wav,0,0\n", encoding="utf-8")
    assert "outside the folder" in refused(folder, "--places", str(tmp_path / "p.csv"), "--unit", "Pa/V")


@pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning")  # pyuff leaves binary files open
def test_given_frequency_responses_of_a_modal_test_then_they_become_causal_responses(tmp_path, imported, refused):
    period, step_hz = 256, RATE_HZ / 256
    spectra = np.fft.rfft(GREEN.astype(float), period)
    sets: list[dict[str, Any]] = [units_of("mm", 1e3), nodes_of(PLACES_MM, 1), nodes_of(ACTUATORS_MM, 101)]
    for position in range(POSITIONS):
        for actuator in range(ACTUATORS):
            sign = -1 if position % 2 else 1
            sets.append(function(sign * spectra[position, actuator], step_hz, position + 1, 3 * sign, 101 + actuator))
            sets.append(function(spectra[position, actuator], step_hz, position + 1, 1, 101 + actuator))
            coherence = function(np.ones(period // 2 + 1), step_hz, position + 1, 3, 101 + actuator)
            sets.append(coherence | {"func_type": 6})
    for binary in (0, 1):
        file = tmp_path / f"modal{binary}.uff"
        pyuff.UFF(str(file)).write_sets([one | {"binary": binary} for one in sets], mode="overwrite")
        assert "--direction x|z" in refused(file)
        back, told = imported(file, "--direction", "z", "--taps", str(TAPS))
        assert told["residual_db"] < -80
        assert np.abs(green_of(back) - GREEN).max() < 2e-5 * np.abs(GREEN).max()
        assert any("type 6" in one for one in told["left_out"])
        with open_bank(back) as view:
            assert (view.response_unit, view.drive_unit) == ("mm/s^2/N", "N")
            assert np.allclose(view.position_mm, PLACES_MM)
            assert np.allclose(view.actuator_mm, ACTUATORS_MM)
    _, told = imported(file, "--direction", "z", "--swap-roles")
    assert (told["positions"], told["actuators"]) == (ACTUATORS, POSITIONS)


def test_a_moving_listener_or_source_makes_positions_or_actuators_measurements(tmp_path, imported):
    responses = np.random.default_rng(2).standard_normal((8, 2, 50))
    head = sofar.Sofa("SimpleFreeFieldHRIR")
    head.Data_IR, head.Data_SamplingRate, head.Data_Delay = responses, 48_000.0, np.array([[3.0, 0.0]])
    head.SourcePosition = np.column_stack([45.0 * np.arange(8), np.zeros(8), np.full(8, 1.2)])
    head.ReceiverPosition = np.array([[0.0, 0.09, 0.0], [0.0, -0.09, 0.0]])
    sofar.write_sofa(str(tmp_path / "head.sofa"), head)
    back, told = imported(tmp_path / "head.sofa", "--unit", "1")
    assert (told["positions"], told["actuators"], told["taps"]) == (2, 8, 53)
    green = green_of(back)
    assert np.allclose(green[0, :, 3:], responses[:, 0], atol=1e-6)
    assert not green[0, :, :3].any()
    assert np.allclose(green[1, :, :50], responses[:, 1], atol=1e-6)
    with open_bank(back) as view:
        assert np.allclose(view.actuator_mm[2], [0.0, 1200.0], atol=1e-9)

    room = sofar.Sofa("GeneralFIR")
    room.Data_IR, room.Data_SamplingRate, room.Data_Delay = responses[:, :1], 4000.0, np.zeros((1, 1))
    room.ListenerPosition = np.array([[0.1 * (row // 2), 0.1 * (row // 2) ** 2, 1.5] for row in range(8)])
    room.SourcePosition = np.array([[2.0 if row % 2 else -2.0, 0.0, 1.5] for row in range(8)])
    room.SourcePosition_Type, room.SourcePosition_Units = "cartesian", "metre"
    sofar.write_sofa(str(tmp_path / "room.sofa"), room)
    back, told = imported(tmp_path / "room.sofa", "--unit", "Pa/V")
    assert (told["positions"], told["actuators"]) == (4, 2)
    assert np.allclose(green_of(back)[2, 1], responses[5, 0], atol=1e-6)


def test_given_arrays_under_other_names_and_in_another_order_then_they_are_mapped(tmp_path, imported):
    names = ["--names", "green=h", "--names", "position_m=xyz", "--names", "sample_rate_hz=fs", "--unit", "m/s/V"]
    arrays = {"h": GREEN.transpose(2, 0, 1), "xyz": PLACES_MM / 1e3, "fs": RATE_HZ, "note": "of a gel"}
    scipy.io.savemat(tmp_path / "a.mat", arrays, do_compression=True)
    np.savez(tmp_path / "a.npz", **arrays)
    for file in ("a.mat", "a.npz"):
        back, told = imported(tmp_path / file, *names, "--axes", "time,position,actuator")
        assert np.array_equal(green_of(back), GREEN)
        assert any("note" in one for one in told["left_out"])
    _, told = imported(tmp_path / "a.mat", *names, "--axes", "time,position,direction", "--direction", "2")
    assert told["actuators"] == 1


SCENE = """
[scene]
name = "one"
[[source]]
path = {{ kind = "point", at_mm = [2, 2] }}
signal = {{ kind = "sine", frequency_hz = 150.0, duration_s = 0.02 }}
[output]
interpolation = "{kind}"
limit_v = 0.5
"""


def table(places):
    names = ["x_mm", "y_mm", "z_mm"][: places.shape[1]]
    return "\n".join([",".join(names), *(",".join(map(str, one)) for one in places.tolist())]) + "\n"


def units_of(name, per_metre):
    return {
        "type": 164, "units_code": 10, "units_description": name, "temp_mode": 1, "length": per_metre, "force": 1.0,
        "temp": 1.0, "temp_offset": 273.15,
    }  # fmt: skip


def nodes_of(places_mm, first):
    numbers, zero = list(range(first, first + len(places_mm))), [0] * len(places_mm)
    return {
        "type": 15, "node_nums": numbers, "def_cs": zero, "disp_cs": zero, "color": zero,
        "x": places_mm[:, 0].tolist(), "y": places_mm[:, 1].tolist(), "z": [0.0] * len(places_mm),
    }  # fmt: skip


def function(values, step_hz, node, direction, reference):
    return {
        "type": 58, "binary": 0, "func_type": 4, "rsp_node": node, "rsp_dir": direction, "ref_node": reference,
        "ref_dir": 3, "data": values, "x": step_hz * np.arange(len(values)), "abscissa_spacing": 1,
        "abscissa_spec_data_type": 18, "ordinate_spec_data_type": 12, "orddenom_spec_data_type": 13,
    }  # fmt: skip
