"""Banks exported through the command line, and read back with the packages that the formats belong to."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import pyuff
import scipy.io
import sofar
import soundfile

from wavefocus.__main__ import run

RATE_HZ, TAPS, ACTUATORS, POSITIONS = 2000.0, 60, 3, 6
STATUS = [1, 1, 0, 8, 4, 1]
KEPT = [0, 1, 4, 5]
PLACES_MM = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0], [0.0, 4.0], [4.0, 4.0], [8.0, 4.0]])
ACTUATORS_MM = np.array([[50.0, 0.0], [np.nan, np.nan], [-50.0, 10.0]])


@pytest.fixture
def bank(tmp_path: Path) -> Path:
    """A bank of another program: partly measured, one row failed, one actuator at an unknown place."""
    green = np.random.default_rng(7).standard_normal((POSITIONS, ACTUATORS, TAPS)).astype(np.float32) * 3e-3
    green[2] = 0.0
    green[3, 1, 5] = np.nan
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["green"], file["position_mm"], file["actuator_mm"] = green, PLACES_MM, ACTUATORS_MM
        file["status"] = np.array(STATUS, np.uint8)
        file.attrs["sample_rate_hz"] = RATE_HZ
    return tmp_path / "foreign.h5"


def green_of(bank: Path) -> np.ndarray:
    with h5py.File(bank, "r") as file:
        return np.asarray(file["green"])


def export(capsys: pytest.CaptureFixture[str], *arguments: object) -> dict[str, Any]:
    assert run(["export", *map(str, arguments), "--json"]) == 0
    return dict(json.loads(capsys.readouterr().out))


def test_given_a_bank_then_sofar_reads_what_acoustics_needs(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    told = export(capsys, bank, tmp_path / "bank.sofa", "--to", "sofa")
    assert (told["positions"], told["left_out"]) == (4, 2)
    sofa = sofar.read_sofa(str(tmp_path / "bank.sofa"), verbose=False)
    sofa.verify(issue_handling="raise")
    assert sofa.GLOBAL_SOFAConventions == "GeneralFIR-E"
    assert np.array_equal(sofa.Data_IR[:, 0], green_of(bank)[KEPT].transpose(0, 2, 1).astype(float))
    assert sofa.Data_SamplingRate == RATE_HZ
    assert np.allclose(sofa.ListenerPosition[:, :2] * 1e3, PLACES_MM[KEPT])
    assert np.allclose(sofa.EmitterPosition[:, :2] * 1e3, ACTUATORS_MM, equal_nan=True)
    assert sofa.BankPosition.tolist() == KEPT
    assert "m/s/V" in sofa.GLOBAL_Comment


def test_given_a_bank_then_pyuff_reads_nodes_and_functions(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export(capsys, bank, tmp_path / "bank.uff", "--to", "uff")
    sets = pyuff.UFF(str(tmp_path / "bank.uff")).read_sets()
    assert [int(one["type"]) for one in sets] == [164, 15] + [58] * (len(KEPT) * ACTUATORS)
    nodes = dict(zip(map(int, sets[1]["node_nums"]), zip(sets[1]["x"], sets[1]["y"], strict=True), strict=True))
    assert sorted(nodes) == [1, 2, 5, 6, POSITIONS + 1, POSITIONS + 3]
    green = green_of(bank)
    for function in sets[2:]:
        row, actuator = int(function["rsp_node"]) - 1, int(function["ref_node"]) - POSITIONS - 1
        assert np.allclose(function["data"], green[row, actuator], rtol=1e-7, atol=0)
        assert np.allclose(np.array(nodes[row + 1]) * 1e3, PLACES_MM[row])
        assert np.allclose(np.diff(function["x"]), 1 / RATE_HZ)


@pytest.mark.parametrize("per", ["position", "actuator"])
def test_given_a_bank_then_its_sound_files_hold_its_numbers_exactly(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], per: str
) -> None:
    export(capsys, bank, tmp_path / "sounds", "--to", "wav", "--per", per)
    facts = json.loads((tmp_path / "sounds" / "bank.json").read_text(encoding="utf-8"))
    green = green_of(bank)[KEPT]
    assert facts["position"] == KEPT
    assert facts["actuator_mm"] == [[50.0, 0.0], None, [-50.0, 10.0]]
    assert len(facts["files"]) == (len(KEPT) if per == "position" else ACTUATORS)
    for place, one in enumerate(facts["files"]):
        samples, rate_hz = soundfile.read(tmp_path / "sounds" / one["file"], dtype="float32", always_2d=True)
        expected = green[place] if per == "position" else green[:, place]
        assert rate_hz == RATE_HZ
        assert np.abs(samples).max() <= 1.0
        assert np.array_equal(samples.T * np.float32(facts["scale"]), expected)


@pytest.mark.parametrize("kind", ["mat", "npz"])
def test_given_nan_for_what_is_missing_then_arrays_hold_every_row(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str
) -> None:
    out = tmp_path / f"bank.{kind}"
    told = export(capsys, bank, out, "--to", kind, "--missing", "nan")
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


def test_given_rows_then_those_alone_are_exported_in_their_order(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    export(capsys, bank, tmp_path / "some.npz", "--to", "npz", "--positions", "5,0-1")
    arrays = np.load(tmp_path / "some.npz", allow_pickle=False)
    assert arrays["position"].tolist() == [5, 0, 1]
    assert np.array_equal(arrays["green"], green_of(bank)[[5, 0, 1]])


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["bank.uff", "--to", "uff", "--missing", "nan"], "hold no NaN"),
        (["bank.npz", "--to", "npz", "--positions", "2-3"], "nothing to export"),
        (["nowhere/bank.npz", "--to", "npz"], "there is no folder"),
        (["foreign.h5", "--to", "npz"], "is an input"),
        (["foreign.h5", "--to", "wav"], "is a file"),
        (["bank.doc", "--to", "doc"], "invalid choice: 'doc'"),
    ],
)
def test_given_what_cannot_be_exported_then_one_sentence_says_why(
    bank: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], told: str
) -> None:
    before = bank.read_bytes()
    assert run(["export", str(bank), str(tmp_path / arguments[0]), *arguments[1:]]) == 2
    lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("wavefocus:")]
    assert len(lines) == 1
    assert told in lines[0]
    assert bank.read_bytes() == before
    assert [one.name for one in tmp_path.iterdir()] == ["foreign.h5"]


@pytest.mark.parametrize(("kind", "package"), [("sofa", "sofar"), ("uff", "pyuff")])
def test_given_no_package_then_a_sentence_says_what_to_install(
    bank: Path, tmp_path: Path, kind: str, package: str
) -> None:
    without = f"import sys; sys.modules[{package!r}] = None; from wavefocus.__main__ import main; main()"
    command = [sys.executable, "-c", without, "export", str(bank), str(tmp_path / "out"), "--to", kind]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr.strip().endswith(f"pip install {package}")
    assert "Traceback" not in done.stderr
