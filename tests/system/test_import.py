"""Responses in other formats become banks through the command line: our own exports, and files as others make them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest

from storage.bank.reading import open_bank
from wavefocus.__main__ import run

RATE_HZ, TAPS, ACTUATORS, POSITIONS = 2000.0, 60, 3, 12
PLACES_MM = np.array([[4.0 * (row % 4), 4.0 * (row // 4)] for row in range(POSITIONS)]) - 6.0
ACTUATORS_MM = np.array([[50.0, 0.0], [0.0, 48.5], [-50.0, 10.0]])
GREEN = (
    np.random.default_rng(7).standard_normal((POSITIONS, ACTUATORS, TAPS)) * 3e-3 * np.exp(-np.arange(TAPS) / 8)
).astype(np.float32)


@pytest.fixture
def bank(tmp_path: Path) -> Path:
    """A bank of another program, with a status and one actuator's place."""
    with h5py.File(tmp_path / "foreign.h5", "w") as file:
        file["green"], file["position_mm"], file["actuator_mm"] = GREEN, PLACES_MM, ACTUATORS_MM
        file["status"] = np.array([1, 4, *[1] * (POSITIONS - 2)], np.uint8)
        file.attrs["sample_rate_hz"] = RATE_HZ
    return tmp_path / "foreign.h5"


@pytest.fixture
def imported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Import a file with options; returns the bank and the report."""

    def do(source: Path, *options: str) -> tuple[Path, dict[str, Any]]:
        out = tmp_path / f"imported-{len(list(tmp_path.iterdir()))}.h5"
        capsys.readouterr()
        assert run(["import", str(source), "--bank", str(out), *options, "--json"]) == 0, capsys.readouterr().err
        return out, dict(json.loads(capsys.readouterr().out))

    return do


@pytest.fixture
def refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Any:
    """Import a file that cannot be; returns the one sentence."""

    def do(source: Path, *options: str) -> str:
        before = sorted(tmp_path.iterdir())
        assert run(["import", str(source), "--bank", str(tmp_path / "refused.h5"), *options]) == 2
        lines = [line for line in capsys.readouterr().err.splitlines() if line.startswith("wavefocus:")]
        assert len(lines) == 1
        assert sorted(tmp_path.iterdir()) == before
        return lines[0]

    return do


def green_of(bank: Path) -> np.ndarray:
    with open_bank(bank, contents=True) as view:
        return np.stack([view.green(row) for row in range(view.positions)])


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        ("sofa", []),
        ("uff", []),
        ("uff", ["--binary"]),
        ("wav", []),
        ("wav", ["--per", "actuator"]),
        ("mat", []),
        ("npz", []),
        ("netcdf", []),
    ],
)
def test_given_our_own_export_then_the_bank_comes_back(
    bank: Path, tmp_path: Path, imported: Any, capsys: pytest.CaptureFixture[str], kind: str, options: list[str]
) -> None:
    assert run(["export", str(bank), str(tmp_path / "there"), "--to", kind, *options]) == 0
    back, told = imported(tmp_path / "there")
    assert told["format"] == kind
    assert np.abs(green_of(back) - GREEN).max() <= 1e-7 * np.abs(GREEN).max()
    with open_bank(back) as view:
        assert np.abs(view.position_mm - PLACES_MM).max() < 1e-6
        assert np.abs(view.actuator_mm - ACTUATORS_MM).max() < 1e-6
        assert view.sample_rate_hz == RATE_HZ
        assert (view.response_unit, view.drive_unit) == ("m/s/V", "V")
        assert view.status.tolist()[:2] == [1, 4]
    assert run(["check", str(back)]) == 0
    assert run(["status", str(back)]) == 0
    assert told["paragraph"] in capsys.readouterr().out
