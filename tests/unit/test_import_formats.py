"""One table per format of import: what real files hold, what becomes of it, and the sentence for what is not read."""

import io
import struct

import h5py
import numpy as np
import pytest
import scipy.io
import scipy.sparse
import soundfile

import wavefocus as wf
from tests.lab_files import write_arrays
from wavefocus.options import ImportOptions
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.places import coordinates, read_places

RNG = np.random.default_rng(0)
GREEN = RNG.standard_normal((4, 2, 16))
PLACES_MM = np.array([[0.0, 0.0], [4.0, 0.0], [0.0, 4.0], [4.0, 4.0]])
NEEDED = {"green": GREEN, "position_mm": PLACES_MM, "sample_rate_hz": 1000.0}


@pytest.fixture
def imported(tmp_path):
    """Import a file; returns the bank's Green's functions and the bank."""

    def do(source, *, unit="m/s/V", **options):
        out = tmp_path / f"{len(list(tmp_path.iterdir()))}.bank.h5"
        with wf.import_bank(source, out, unit=unit, **options) as bank:
            return np.stack([bank.green(row) for row in range(bank.positions)]), bank

    return do


# Arrays by name: archives of NumPy, files of MATLAB.


def archive(path, **changes):
    np.savez(path, **(NEEDED | {"response_unit": "m/s/V", "drive_unit": "V"} | changes))
    return path


def test_facts_that_an_archive_states_twice_are_taken_and_its_rate_stands(tmp_path, imported):
    source = archive(tmp_path / "a.npz", position_m=PLACES_MM / 1e3, time_s=np.arange(16) / 1000)
    assert imported(source)[1].position_mm[1].tolist() == [4.0, 0.0]
    early, bank = imported(archive(tmp_path / "b.npz", time_s=np.arange(-4, 12) / 1000))
    assert np.allclose(early, GREEN[..., 4:])
    assert "samples before 0 s, which are left out, hold" in bank.import_facts["warnings"][0]
    with pytest.raises(InputError, match="the file says 1000"):
        imported(source, sample_rate_hz=2000.0)


@pytest.mark.parametrize(("height_mm", "known"), [(2.0, True), (-2.0, True), (-60.0, False), (600.0, False)])
def test_actuators_off_the_surface_then_have_no_place_and_are_named(tmp_path, imported, height_mm, known):
    places = np.array([[50.0, 0.0, height_mm], [0.0, 50.0, 0.0]])
    _, bank = imported(archive(tmp_path / "a.npz", actuator_mm=places, position_mm=10 * PLACES_MM))
    assert bank.actuator_mm[1].tolist() == [0.0, 50.0]
    assert bank.actuator_mm[0].tolist() == [50.0, 0.0] if known else np.isnan(bank.actuator_mm[0]).all()
    warnings = bank.import_facts["warnings"]
    assert [("off the surface" in one and "the first is 0" in one) for one in warnings] == ([] if known else [True])


def element(kind, content):
    return struct.pack("<II", kind, len(content)) + content + b"\0" * (-len(content) % 8)


def string_object(name):
    """A MATLAB string object: an array of class 17 without extents, as MATLAB writes it."""
    numbers = np.array([0xDD000000, 2, 1, 1, 1, 1], "<u4").tobytes()
    meta = element(14, element(6, struct.pack("<II", 13, 0)) + element(5, struct.pack("<ii", 6, 1)) + element(1, b"")
                   + element(6, numbers))  # fmt: skip
    flags = element(6, struct.pack("<II", 17, 0))
    return element(14, flags + element(1, name.encode()) + element(1, b"MCOS") + element(1, b"string") + meta)


def matlab(path, variables, after=b""):
    file = io.BytesIO()
    scipy.io.savemat(file, variables)
    path.write_bytes(file.getvalue() + after)
    return path


@pytest.mark.parametrize("name", ["who", "comment", "description_of_the_test", "response_unit"])
def test_a_string_object_that_nobody_needs_then_is_passed_over(tmp_path, imported, name):
    assert np.allclose(imported(matlab(tmp_path / "a.mat", NEEDED, string_object(name)))[0], GREEN)


@pytest.mark.parametrize(
    "value",
    [np.array([1.0, "a"], object), scipy.sparse.eye(3), np.array([(1.0,), (2.0,)], [("gain", "O")]), None],
    ids=["cells", "sparse", "struct", "string object"],
)
def test_a_variable_that_is_needed_and_of_another_kind_then_is_named(tmp_path, imported, value):
    variables, after = NEEDED | {"green": value}, b""
    if value is None:
        variables, after = {"position_mm": PLACES_MM}, string_object("green")
    with pytest.raises(InputError, match="'green' is not an array of numbers"):
        imported(matlab(tmp_path / "a.mat", variables, after))


@pytest.mark.parametrize("version", ["5", "7.3"])
def test_fields_of_a_struct_then_are_named_with_dots(tmp_path, imported, version):
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
    assert np.allclose(imported(path, names=names)[0], GREEN)
    with pytest.raises(InputError, match=r"'meas\.h'"):
        imported(path)


@pytest.mark.parametrize("ending", ["mat", "npz"])
def test_given_arrays_under_other_names_and_in_another_order_then_they_are_mapped(tmp_path, imported, ending):
    path = tmp_path / f"a.{ending}"
    arrays = {"h": GREEN.transpose(2, 0, 1), "xyz": PLACES_MM / 1e3, "fs": 1000.0, "note": "of a gel"}
    scipy.io.savemat(path, arrays, do_compression=True) if ending == "mat" else np.savez(path, **arrays)
    names = {"green": "h", "position_m": "xyz", "sample_rate_hz": "fs"}
    found, bank = imported(path, names=names, axes="time,position,actuator")
    assert np.allclose(found, GREEN)
    assert any("note" in one for one in bank.import_facts["left_out"])
    _, bank = imported(path, names=names, axes="time,position,direction", direction="1")
    assert bank.actuators == 1


# netCDF and HDF5; tests/system/test_import_packed.py has packed and masked values.


@pytest.mark.long  # xarray, and with it dask, takes seconds to load
@pytest.mark.parametrize("engine", ["h5netcdf", "netcdf4", "scipy"])
def test_a_dimension_without_values_and_words_for_units_are_read_as_xarray_writes(tmp_path, engine, imported):
    import xarray

    data = xarray.Dataset(
        {"green": (("position", "actuator", "time_s"), GREEN),
         "position_mm": (("position", "axis"), PLACES_MM, {"units": "millimeters"})},
        attrs={"sample_rate_hz": 1000.0},
    )  # fmt: skip
    data.to_netcdf(tmp_path / "a.nc", engine=engine)
    assert np.allclose(imported(tmp_path / "a.nc")[0], GREEN)
    if engine != "scipy":
        with wf.open_bank(tmp_path / "a.nc") as bank:  # without an import
            assert np.array_equal(bank.green(3), GREEN[3])


def test_a_level_that_no_instrument_measures_beside_the_others_is_not_valid(tmp_path, imported):
    green = GREEN.copy()
    green[2] = 1e25
    _, bank = imported(write_arrays(tmp_path / "a.nc", green, PLACES_MM, 1000.0))
    assert bank.status.tolist() == [1, 1, 4, 1]
    assert any("position" in warning and "200 dB" in warning for warning in bank.import_facts["warnings"])
    with wf.open_bank(tmp_path / "a.nc") as bank:  # without an import
        assert bank.status.tolist() == [1, 1, 0, 1]


# SOFA


def sofa_file(path, convention, responses, rate_hz=48_000.0, **fields):
    import sofar

    sofa = sofar.Sofa(convention)
    sofa.Data_IR, sofa.Data_SamplingRate = responses, rate_hz
    for name, value in fields.items():
        setattr(sofa, name, value)
    sofar.write_sofa(str(path), sofa)
    return path


EARS = np.array([[0.0, 0.09, 0.0], [0.0, -0.09, 0.0]])


def test_sources_above_and_below_are_not_one_place_also_with_empty_attributes(tmp_path, imported):
    places = np.array([[0.0, 60, 1.4], [0, -60, 1.4], [0, 0, 1.4], [90, 0, 1.4]])
    path = sofa_file(tmp_path / "a.sofa", "SimpleFreeFieldHRIR", GREEN, ReceiverPosition=EARS, SourcePosition=places)
    for emptied in ((), ("//Comment", "//Title", "SourcePosition/Units", "ListenerView/Type")):
        with h5py.File(path, "r+") as file:
            for where in emptied:
                file[where.rpartition("/")[0]].attrs[where.rpartition("/")[2]] = h5py.Empty("S1")  # as netCDF does
        found, bank = imported(path)
        assert np.allclose(found, GREEN.transpose(1, 0, 2))
        assert np.isnan(bank.actuator_mm[:2]).all()
        assert np.allclose(bank.actuator_mm[2:], [[1400, 0], [0, 1400]])
        assert "2 actuators lie off the surface" in bank.import_facts["warnings"][0]


def test_a_moving_listener_or_source_makes_positions_or_actuators_measurements(tmp_path, imported):
    responses = RNG.standard_normal((8, 2, 50))
    places = np.column_stack([45.0 * np.arange(8), np.zeros(8), np.full(8, 1.2)])
    head = sofa_file(tmp_path / "head.sofa", "SimpleFreeFieldHRIR", responses, Data_Delay=np.array([[3.0, 0.0]]),
                     ReceiverPosition=EARS, SourcePosition=places)  # fmt: skip
    green, bank = imported(head, unit="1")
    assert green.shape == (2, 8, 53)
    assert np.allclose(green[0, :, 3:], responses[:, 0], atol=1e-6)
    assert not green[0, :, :3].any()
    assert np.allclose(green[1, :, :50], responses[:, 1], atol=1e-6)
    assert np.allclose(bank.actuator_mm[2], [0.0, 1200.0], atol=1e-9)
    room = sofa_file(tmp_path / "room.sofa", "GeneralFIR", responses[:, :1], 4000.0, Data_Delay=np.zeros((1, 1)),
                     ListenerPosition=np.array([[0.1 * (row // 2), 0.1 * (row // 2) ** 2, 1.5] for row in range(8)]),
                     SourcePosition=np.array([[2.0 if row % 2 else -2.0, 0.0, 1.5] for row in range(8)]),
                     SourcePosition_Type="cartesian", SourcePosition_Units="metre")  # fmt: skip
    green, _ = imported(room, unit="Pa/V")
    assert green.shape == (4, 2, 50)
    assert np.allclose(green[2, 1], responses[5, 0], atol=1e-6)


# Sound files, with a table of places.


def test_given_sound_files_and_a_table_then_each_pair_is_found(tmp_path, imported):
    folder, table = tmp_path / "rooms", tmp_path / "p.csv"
    folder.mkdir()
    sound = RNG.standard_normal((4, 2, 300)).astype(np.float32) * 0.1
    lines = ["file,x_m,y_m,actuator,role"]
    for place in range(4):
        for source, name in enumerate(("left", "right")):
            soundfile.write(folder / f"{place}{name}.wav", sound[place, source], 48_000, subtype="FLOAT")
            lines.append(f"{place}{name}.wav,{0.5 * place},{0.1 * place**2},{name},")
    table.write_text("\ufeff" + "\n".join([*lines, ",2,0,right,actuator"]).replace(",", ";"), encoding="utf-8")
    green, bank = imported(folder, places=table, unit="Pa/V")
    assert np.array_equal(green[:, [1, 0]], sound)
    assert bank.sample_rate_hz == 48_000
    assert np.allclose(bank.position_mm, [[500.0 * one, 100.0 * one**2] for one in range(4)])
    assert bank.actuator_mm.tolist()[0] == [2000.0, 0.0]
    assert np.isnan(bank.actuator_mm[1]).all()
    assert "kernel" in bank.import_facts["unsuited"]
    table.write_text("file,x_m,y_m\n../rooms/0left.wav,0,0\n", encoding="utf-8")
    with pytest.raises(InputError, match="outside the folder"):
        imported(folder, places=table, unit="Pa/V")


@pytest.fixture
def one_sound(tmp_path):
    """A folder for a.wav, and a table with its place."""
    (tmp_path / "sounds").mkdir()
    (tmp_path / "places.csv").write_text("file,x_mm,y_mm\na.wav,0,0\n")
    return tmp_path / "sounds", {"places": tmp_path / "places.csv", "unit": "Pa/V"}


@pytest.mark.parametrize("content", [b"wvpk" + bytes(60), b"hello", b""])
def test_a_sound_file_that_is_not_read_then_is_refused_by_name(imported, one_sound, content):
    (one_sound[0] / "a.wav").write_bytes(content)
    with pytest.raises(InputError, match=r"a\.wav is not read .*convert it to a WAV file of PCM"):
        imported(one_sound[0], **one_sound[1])


@pytest.mark.parametrize(
    ("kind", "held_in", "at", "unknown"),  # sizes that programs write which do not know it
    [
        ("PCM_24", "WAV", 4, (bytes(4), b"\xff" * 4)), ("FLOAT", "W64", 16, (bytes(8), b"\xff" * 8)),
        *(
            pytest.param(*case, marks=pytest.mark.long)
            for case in (
                *((kind, "WAV", 4, (bytes(4), b"\xff" * 4)) for kind in ("ULAW", "IMA_ADPCM")),
                ("PCM_24", "RF64", 20, (bytes(8), b"\xff" * 8)), ("PCM_24", "AIFF", 4, (bytes(4), b"\x7f\0\0\x2e")),
                ("PCM_16", "AU", 8, (b"\xff" * 4,)),
            )
        ),
    ],
)  # fmt: skip
def test_a_sound_file_that_is_read_then_says_how_its_samples_are_stored(
    imported, one_sound, kind, held_in, at, unknown
):
    soundfile.write(one_sound[0] / "a.wav", 0.5 * np.sin(np.arange(600) / 9), 8000, kind, format=held_in)
    _, bank = imported(one_sound[0], **one_sound[1])
    assert soundfile.available_subtypes(held_in)[kind] in bank.import_facts["read"][0]
    whole = (one_sound[0] / "a.wav").read_bytes()
    for file in (*(whole[:at] + size + whole[at + len(size) :] for size in unknown), whole[:-1], whole + b"TAG"):
        (one_sound[0] / "a.wav").write_bytes(file)
        imported(one_sound[0], **one_sound[1])
    (one_sound[0] / "a.wav").write_bytes(whole[:300])
    with pytest.raises(InputError, match=rf"a\.wav is truncated: it holds 300 of {len(whole)} bytes"):
        imported(one_sound[0], **one_sound[1])


def test_given_a_table_of_many_places_then_each_actuator_has_its_own_number(imported, one_sound):
    soundfile.write(one_sound[0] / "a.wav", np.full((8, 1), 0.5, np.float32), 8000, subtype="FLOAT")
    lines = "".join(f"a.wav,0,0,a{number}\n" for number in range(2000))
    one_sound[1]["places"].write_text("file,x_mm,y_mm,actuator\n" + lines)
    assert imported(one_sound[0], **one_sound[1])[0].shape == (1, 2000, 8)


# Tables of places, as spreadsheets write them.


def places_mm(tmp_path, content):
    path = tmp_path / "places.csv"
    path.write_bytes(content.encode())
    return (coordinates(read_places(path, ImportOptions())) * 1e3).round(9).tolist()


@pytest.mark.parametrize(
    "content",
    [
        "x_mm;y_mm\n0,5;1,0\n4,5;1,25\n-8,5;1,0E+03\n",
        "x_mm\ty_mm\r\n0,5\t1\r\n4,5\t1,25\r\n-8,5\t1000\r\n",
        '\ufeffx_mm;y_mm;note\r\n0,5;1,0;\r\n4,5;1,25;"a;b"\r\n-8,5;1000;1.5\r\n',
        "sep=;\r\nX_mm;Y_mm\r\n0,5;1,0\r\n4,5;1,25\r\n-8,5;1000,0\r\n;\r\n",
        "x_mm,y_mm\n0.5,1.0\n4.5,1.25\n-8.5,1.0e3\n",
        'x_mm,y_mm\n"0.5","1.0"\n4.5,1.25,,\n-8.5,1000,\n',
        "x_mm;y_mm;;\n0.5;1.0;;\n4.5;1.25\n-8.5;1000\n",
        "x_\u00b5m,y_\u03bcm\n500,1000\n4500,1250\n-8500,1e6\n",
        "x_mm,y_mm,x_m,y_m\n0.5,1,0.0005,0.001\n4.5,1.25,0.0045,0.00125\n-8.5,1000,,1\n",
        "x_mm,y_m,z_um\n0.5,0.001,0\n4.5,0.00125,0\n-8.5,1,0\n",
    ],
)
def test_a_table_as_spreadsheets_write_it_then_has_these_places(tmp_path, content):
    assert places_mm(tmp_path, content) == [[0.5, 1.0, 0.0], [4.5, 1.25, 0.0], [-8.5, 1e3, 0.0]]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("x_mm,y_mm\n0,5,1,0\n4,5,1,0\n", "line 2: has 4 cells and the header 2"),
        ("x_mm,y_mm,X_mm\n0,5,1\n", "names the column 'x_mm' twice"),
        ("0,0\n4,0\n", "its header is '0,0'; columns x_mm,y_mm"),
        ("x_mm,y_mm\n0,5\n4,5,1\n", "line 3: has 3 cells"),
        ("x_mm;y_mm\n0,5;1.5\n", r"decimal points \(line 2\) and decimal commas"),
        ("x_mm;y_mm\n1.000,5;1\n", "line 2: x_mm is '1.000,5'"),
        ("x_mm;y_mm\n1,000,5;1\n", "line 2: x_mm is '1,000,5'"),
        ('x_mm,y_mm\n"1,5",2\n', "line 2: x_mm is '1,5'"),
        ("x_mm,y_mm\n1_0,2\n", "line 2: x_mm is '1_0'"),
        ("x_mm,y_mm,x_m\n1,2,1\n", "line 2: x_m and x_mm are different places"),
        ("azimuth_deg,elevation_deg,radius_m,radius_mm\n0,0,1,1\n", "radius_m and radius_mm"),
    ],
)
def test_a_table_that_can_be_read_in_two_ways_then_is_refused(tmp_path, content, message):
    with pytest.raises(InputError, match=message):
        places_mm(tmp_path, content)
