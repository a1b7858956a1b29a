"""Real files with parts that nobody needs, and kinds that are not read: the one is read, the other is named."""

import io
import struct

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse
import sofar
import soundfile

import wavefocus as wf
from wavefocus.storage.errors import InputError

GREEN = np.random.default_rng(0).standard_normal((4, 2, 16))
PLACES_MM = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [4.0, 4.0]])
NEEDED = {"green": GREEN, "position_mm": PLACES_MM, "sample_rate_hz": 1000.0}


def element(kind, content):
    return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def string_object(name):
    """A MATLAB string object: an array of class 17 without extents, as MATLAB writes it."""
    numbers = np.array([0xDD000000, 2, 1, 1, 1, 1], "<u4").tobytes()
    meta = element(14, element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
                   + element(6, numbers))  # fmt: skip
    flags = element(6, struct.pack("<II", 17, 0))
    return element(14, flags + element(1, name.encode()) + element(1, b"MCOS") + element(1, b"string") + meta)


def imported(source, **options):
    with wf.import_bank(source, source.with_suffix(".bank.h5"), unit="m/s/V", **options) as bank:
        return np.stack([bank.green(row) for row in range(bank.positions)])


def matlab(path, variables, after=b"", *, compressed=False):
    file = io.BytesIO()
    scipy.io.savemat(file, variables, do_compression=compressed)
    path.write_bytes(file.getvalue() + after)
    return path


@pytest.mark.parametrize("name", ["who", "comment", "description_of_the_test"])
def test_a_string_object_that_nobody_needs_then_is_passed_over(tmp_path, name):
    assert np.allclose(imported(matlab(tmp_path / "a.mat", NEEDED, string_object(name))), GREEN)


@pytest.mark.parametrize(
    "value", [np.array([1.0, "a"], object), scipy.sparse.eye(3), np.array([(1.0,), (2.0,)], [("gain", "O")])]
)
def test_a_variable_that_is_needed_and_of_another_kind_then_is_named(tmp_path, value):
    with pytest.raises(InputError, match="'green' is not an array of numbers"):
        imported(matlab(tmp_path / "a.mat", NEEDED | {"green": value}))
    with pytest.raises(InputError, match="'green' is not an array of numbers"):
        imported(matlab(tmp_path / "b.mat", {"position_mm": PLACES_MM}, string_object("green")))


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_fields_of_a_struct_then_are_named_with_dots(tmp_path, version):
    path = tmp_path / "a.mat"
    inner = {"h": GREEN, "xyz": PLACES_MM}
    if version == "5":
        matlab(path, {"meas": inner | {"setup": {"fs": 1000.0}}, "more": {"h": 1.0}})
    else:
        with h5py.File(path, "w", userblock_size=512) as file:
            for name, value in (inner | {"setup/fs": np.array([[1000.0]])}).items():
                file[f"meas/{name}"] = np.asarray(value).T
        with path.open("r+b") as raw:
            raw.write(b"MATLAB 7.3 MAT-file".ljust(124) + b"\0\2IM")
    names = {"green": "meas.h", "position_mm": "meas.xyz", "sample_rate_hz": "meas.setup.fs"}
    assert np.allclose(imported(path, names=names), GREEN)
    path.with_suffix(".bank.h5").unlink()
    with pytest.raises(InputError, match=r"'meas\.h'"):
        imported(path)


@pytest.mark.parametrize("where", ["/Comment", "/Title", "SourcePosition/Units", "ListenerView/Type"])
def test_a_sofa_file_with_an_empty_attribute_then_is_read(tmp_path, where):
    path = tmp_path / "a.sofa"
    sofa = sofar.Sofa("SimpleFreeFieldHRIR")
    sofa.Data_IR, sofa.Data_SamplingRate = GREEN, 48_000.0
    sofa.ReceiverPosition = np.array([[0, 0.09, 0], [0, -0.09, 0]])
    sofa.SourcePosition = np.array([[90.0 * row, 0, 1.4] for row in range(4)])
    sofar.write_sofa(str(path), sofa)
    with h5py.File(path, "r+") as file:
        variable, _, name = where.partition("/")
        holder = file[variable or "/"]
        if name in holder.attrs:
            del holder.attrs[name]
        holder.attrs[name] = h5py.Empty("S1")  # as netCDF writes an empty text
    assert np.allclose(imported(path), GREEN.transpose(1, 0, 2))


def test_a_bank_with_empty_attributes_then_has_defaults(tmp_path):
    with h5py.File(tmp_path / "a.h5", "w") as file:
        file["green"], file["position_mm"] = GREEN, PLACES_MM
        file.attrs["sample_rate_hz"] = 1000.0
        for name in ("response_unit", "drive_unit", "band_hz", "software"):
            file.attrs[name] = h5py.Empty("S1")
        file["green"].attrs["_FillValue"] = h5py.Empty("f8")
    with wf.open_bank(tmp_path / "a.h5") as bank:
        assert (bank.response_unit, bank.drive_unit, bank.band_hz) == ("m/s/V", "V", None)


@pytest.mark.parametrize("content", [b"wvpk" + bytes(60), b"hello", b""])
def test_a_sound_file_that_is_not_read_then_is_refused_by_name(tmp_path, content):
    (tmp_path / "sounds").mkdir()
    (tmp_path / "sounds" / "a.wav").write_bytes(content)
    (tmp_path / "places.csv").write_text("file,x_mm,y_mm\na.wav,0,0\n")
    with pytest.raises(InputError, match=r"a\.wav is not read .*convert it to a WAV file of PCM"):
        wf.import_bank(tmp_path / "sounds", tmp_path / "b.h5", places=tmp_path / "places.csv", unit="Pa/V")


@pytest.mark.parametrize("kind", ["PCM_U8", "PCM_24", "FLOAT", "ULAW", "IMA_ADPCM"])
def test_a_sound_file_that_is_read_then_says_how_its_samples_are_stored(tmp_path, kind):
    (tmp_path / "sounds").mkdir()
    soundfile.write(tmp_path / "sounds" / "a.wav", 0.5 * np.sin(np.arange(600) / 9), 8000, subtype=kind)
    (tmp_path / "places.csv").write_text("file,x_mm,y_mm\na.wav,0,0\n")
    with wf.import_bank(tmp_path / "sounds", tmp_path / "b.h5", places=tmp_path / "places.csv", unit="Pa/V") as bank:
        assert soundfile.available_subtypes("WAV")[kind] in bank.import_facts["read"][0]
