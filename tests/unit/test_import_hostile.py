"""Files that are damaged, or made to do harm, end an import in one sentence, in little memory."""

import io
import random
import shutil
import zipfile
import zlib

import h5py
import numpy as np
import pytest
import scipy.io

from tests.lab_files import attribute, put, without
from tests.unit.mutations import mutated
from wavefocus import export_bank
from wavefocus.__main__ import run
from wavefocus.calibration.imports.bank import import_bank
from wavefocus.options import ImportOptions

GREEN = np.random.default_rng(0).standard_normal((6, 2, 40)).astype(np.float32)
PLACES_MM = np.array([[4.0 * (row % 3), 4.0 * (row // 3)] for row in range(6)])
ARRAYS = {"green": GREEN, "position_mm": PLACES_MM, "sample_rate_hz": np.float64(2000.0), "response_unit": "m/s/V"}
BOMB_BYTES = 80 << 20


def exported(folder, kind):
    np.savez(folder / "b.npz", **ARRAYS)
    import_bank(folder / "b.npz", folder / "bank.h5", ImportOptions())
    out = folder / f"exported.{kind}"
    export_bank(folder / "bank.h5", out, kind.partition("-")[0], binary=kind.endswith("-binary"))
    return out


def hdf5(*changes):
    """A maker of a sound file with some changes."""

    def make(folder):
        with h5py.File(folder / "a.nc", "w") as file:
            for name, values in ARRAYS.items():
                if name != "response_unit":
                    file[name] = values
            file.attrs["response_unit"] = "m/s/V"
            for change in changes:
                change(file)
        return folder / "a.nc"

    return make


def dataset(**options):
    """A maker of a file whose responses are stored in another way."""

    def change(file):
        del file["green"]
        file.create_dataset("green", **options)

    return hdf5(change)


def zipped(values, header="", *, pickled=False):
    """A maker of a compressed archive whose responses may declare another shape."""

    def make(folder):
        content, shape = io.BytesIO(), str(values.shape).encode()
        np.lib.format.write_array(content, values, allow_pickle=pickled)
        np.savez(folder / "a.npz", **{name: values for name, values in ARRAYS.items() if name != "green"})
        with zipfile.ZipFile(folder / "a.npz", "a", zipfile.ZIP_DEFLATED) as file:
            file.writestr("green.npy", content.getvalue().replace(shape, header.encode() or shape))
        return folder / "a.npz"

    return make


def saved(name, save):
    """A maker of a file that one call writes."""

    def make(folder):
        save(folder / name)
        return folder / name

    return make


def archive(**changes):
    return saved("a.npz", lambda file: np.savez(file, **ARRAYS | changes))


def filled(attribute_name, taps):
    """A maker of a file with fill values of another type at a position."""
    green = GREEN.astype(np.float64)
    green[2, 1, taps] = 1e20
    return hdf5(put("green", green), attribute(attribute_name, np.float32(1e20), of="green"))


def unfolding_mat(tmp_path):
    scipy.io.savemat(tmp_path / "a.mat", {"green": GREEN})
    header = (tmp_path / "a.mat").read_bytes()[:128]
    piece = zlib.compress(bytes(BOMB_BYTES), 9)
    tag = np.array([15, len(piece)], "<u4").tobytes()
    (tmp_path / "a.mat").write_bytes(header + tag + piece)
    return tmp_path / "a.mat"


def ascii_short(tmp_path):
    file = exported(tmp_path, "uff")
    content = file.read_text(encoding="ascii")
    file.write_text(content.replace("        40         1", "  99999999         1", 1), encoding="ascii")
    return file


NOT_FINITE = np.where(np.arange(GREEN.size).reshape(GREEN.shape) == 287, np.nan, GREEN)
PICKLED, CELLS = np.array([{"a": 1}], object), np.empty((2, 1), object)
CELLS[:, 0] = [GREEN, "text"]
BOMB = np.broadcast_to(np.float32(0.0), (6, 2, BOMB_BYTES // 48))
HOSTILE = {
    "external link": (hdf5(put("green", h5py.ExternalLink("other.nc", "/green"))), "link"),
    "soft link": (hdf5(put("green", h5py.SoftLink("/position_mm"))), "link"),
    "hollow": (dataset(shape=(6, 10_000, 10_000), dtype="f4", chunks=(1, 100, 100)), "holds"),
    "unfolding HDF5": (dataset(data=BOMB, chunks=(1, 2, BOMB.shape[2]), compression=9), "holds"),
    "unfolding archive": (zipped(BOMB), "holds"),
    "huge shape": (zipped(GREEN, "(6, 2, 99999999999)"), "holds"),
    "pickled archive": (zipped(PICKLED, pickled=True), "pickled"),
    "pickled array": (saved("a.npy", lambda file: np.save(file, PICKLED, allow_pickle=True)), "pickled"),
    "unfolding MATLAB file": (unfolding_mat, "holds"),
    "cells": (saved("a.mat", lambda file: scipy.io.savemat(file, ARRAYS | {"green": CELLS})), "green"),
    "not finite": (archive(green=NOT_FINITE), "position 3 to actuator 1"),
    "control characters": (archive(response_unit="m/s/V\x1b[31m"), "control characters"),
    "two places": (archive(position_mm=PLACES_MM[:2]), "places of 2 positions"),
    "places in two units": (archive(position_m=np.ones((6, 2))), "position_m and position_mm are different places"),
    "actuators in two units": (
        archive(actuator_mm=np.ones((2, 2)), actuator_in=np.ones((2, 2))), "actuator_mm and actuator_in",
    ),
    "two rates": (archive(time_s=np.arange(40) / 4000), "sample_rate_hz is 2000, and time_s has 4000"),
    "two drives": (archive(drive_unit="N"), "drive_unit is 'N'"),
    "axes exchanged": (
        archive(green=GREEN.transpose(0, 2, 1), time_s=np.arange(40) / 2000),
        "the responses 2 samples; as many are needed, or another order of the axes with --axes",
    ),
    "some fill values": (filled("_FillValue", slice(8, None)), "position 2"),
    "all missing values": (filled("missing_value", slice(0, 40)), "position 2"),
    "time in ms": (
        hdf5(without("sample_rate_hz"), put("time_s", np.arange(40.0)), attribute("units", "ms", of="time_s")),
        "time_s states the units 'ms'",
    ),
    "places in m": (hdf5(attribute("units", "m", of="position_mm")), "position_mm states the units 'm'"),
    **{f"{rate_hz} Hz": (hdf5(put("sample_rate_hz", rate_hz)), "sample rate") for rate_hz in (1e-320, 1e40)},
    "1 Hz": (hdf5(put("sample_rate_hz", 1.0)), "sample rate is 1 Hz"),
    "short text": (ascii_short, "declares 99999999 numbers"),
}  # fmt: skip


@pytest.mark.parametrize(("make", "told"), HOSTILE.values(), ids=HOSTILE)
def test_given_a_hostile_file_then_one_sentence_says_why(tmp_path, capsys, make, told):
    source = make(tmp_path)
    before = sorted(tmp_path.iterdir())
    capsys.readouterr()
    assert run(["import", str(source), "--bank", str(tmp_path / "out.h5")]) == 2
    sentence = capsys.readouterr().err
    assert len(sentence.splitlines()) == 1
    assert told in sentence
    assert source.name in sentence
    assert "\x1b" not in sentence
    assert sorted(tmp_path.iterdir()) == before


KINDS = ["flip", "byte", "zero page", "double", "cut", "twice", "digit"]


def damaged(content, source):
    at = source.randrange(min(len(content), source.choice([256, 2048, len(content)])))
    return mutated(content, at, source.choice(KINDS), source)


def mutations(tmp_path, kind, count):
    """Damaged copies of a small file, with its format and options."""
    form, options = kind.partition("-")[0], list[str]()
    if kind == "npy":
        np.save(tmp_path / "exported.npy", GREEN)
        whole = tmp_path / "exported.npy"
        (tmp_path / "places.csv").write_text("x_mm,y_mm\n" + "".join(f"{x},{y}\n" for x, y in PLACES_MM.tolist()))
        options = ["--places", str(tmp_path / "places.csv"), "--unit", "m/s/V", "--sample-rate-hz", "2000"]
    else:
        whole = exported(tmp_path, kind)
    source, copy = random.Random(5), tmp_path / "copy"
    for _ in range(count):
        if whole.is_dir():
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(whole, copy)
            one = source.choice(sorted(copy.iterdir()))
            one.write_bytes(damaged(one.read_bytes(), source))
        else:
            copy.write_bytes(damaged(whole.read_bytes(), source))
        yield copy, form, options


@pytest.mark.timeout(900)
@pytest.mark.parametrize("count", [3, pytest.param(300, marks=pytest.mark.nightly)])
@pytest.mark.parametrize("kind", ["sofa", "uff", "mat", "npz", "netcdf", "wav", "uff-binary", "npy"])
def test_given_damaged_files_then_each_import_ends_with_a_bank_or_a_sentence(tmp_path, capsys, kind, count):
    for copy, form, options in mutations(tmp_path, kind, count):
        out = tmp_path / "out.h5"
        out.unlink(missing_ok=True)
        code = run(["import", str(copy), "--bank", str(out), "--from", form, *options])
        assert code in (0, 2)
        assert out.exists() == (code == 0)
        told = capsys.readouterr().err
        assert "Traceback" not in told
        assert code == 0 or len([line for line in told.splitlines() if line.startswith("wavefocus:")]) == 1
