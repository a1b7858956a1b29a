"""Reading banks: measured by this program, or written by any other."""

import h5py
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.lab_files import attribute, green_of, put, without, write_bank
from wavefocus import InputError, open_bank
from wavefocus.calibration.check import check_bank


def measured(path):
    return write_bank(path, np.stack([green_of(position) for position in range(3)]))


def foreign(path, green, **options):
    with h5py.File(path, "w") as file:
        file.attrs["sample_rate_hz"] = 8000
        file.create_dataset("green", data=green, **options)
        file["position_mm"] = np.arange(2.0 * len(green)).reshape(-1, 2)
    return path


def overwrite(path, offset, content):
    with path.open("r+b") as file:
        file.seek(offset)
        file.write(content)


def test_a_bank_with_a_torn_text_heap_then_is_refused_instead_of_hanging(tmp_path):
    path = measured(tmp_path / "bank.h5")
    heap = path.read_bytes().index(b"GCOL")
    overwrite(path, heap + 16, bytes(16))  # an object without index and size: HDF5 2.0 never returns from it
    with pytest.raises(InputError, match="its texts are not readable"):
        open_bank(path)


@settings(max_examples=15)
@given(
    dtype=st.sampled_from(["<f2", "<f4", "<f8", ">f4", ">f8", "<i2", ">i2", "u1"]),
    options=st.sampled_from([{}, {"chunks": (2, 1, 3)}, {"compression": "gzip"}, {"shuffle": True, "chunks": True}]),
    shape=st.tuples(st.integers(1, 5), st.integers(1, 3), st.integers(1, 9)),
    seed=st.integers(0, 2**32 - 1),
)
def test_a_foreign_bank_of_any_number_type_and_layout_then_reads_its_values(tmp_path, dtype, options, shape, seed):
    values = (np.random.default_rng(seed).normal(size=shape) * 50).clip(0, 250).astype(dtype)
    if "chunks" in options and options["chunks"] is not True:
        options = {"chunks": tuple(map(min, (2, 1, 3), shape))}
    with open_bank(foreign(tmp_path / "foreign.h5", values, **options)) as bank:
        wanted = np.float32 if np.dtype(dtype).kind == "f" and np.dtype(dtype).itemsize <= 4 else np.float64
        for position in range(shape[0]):
            green = bank.green(position)
            assert green.dtype == np.dtype(wanted)
            assert green.dtype.isnative
            assert np.array_equal(green, values[position].astype(np.float64))


@pytest.mark.parametrize("empty", [(), ("response_unit", "drive_unit", "band_hz", "software")])
def test_a_bank_with_only_what_is_needed_then_gets_the_documented_defaults(tmp_path, empty):
    green = np.ones((3, 2, 4))
    green[1] = 0
    path = foreign(tmp_path / "foreign.h5", green)
    with h5py.File(path, "r+") as file:
        file["green"].attrs["_FillValue"] = h5py.Empty("f8")
        for name in empty:
            file.attrs[name] = h5py.Empty("S1")
    with open_bank(path) as bank:
        assert bank.sample_rate_hz == 8000.0
        assert bank.status.tolist() == [1, 0, 1]
        assert np.isnan(bank.actuator_mm).all()
        assert bank.actuator_mm.shape == (2, 2)
        assert bank.band_hz is None
        assert (bank.response_unit, bank.drive_unit) == ("m/s/V", "V")
        assert (bank.rig_json, bank.run_json, bank.plan_sha256, bank.software) == (None, None, None, None)
        assert bank.time_s.tolist() == [0, 1 / 8000, 2 / 8000, 3 / 8000]
        assert bank.quality["attempts"].tolist() == [0, 0, 0]
        assert np.isnan(bank.quality["snr_db"]).all()
        assert bank.verify() == ()
        for position in (-1, 3):
            with pytest.raises(InputError, match=rf"foreign\.h5: position is {position}; allowed are 0 to 2"):
                bank.green(position)


@pytest.mark.parametrize("make", [measured, lambda path: foreign(path, np.ones((3, 2, 4)))], ids=["own", "foreign"])
def test_a_bank_that_is_closed_then_says_so_and_is_not_called_damaged(tmp_path, make):
    with open_bank(make(tmp_path / "bank.h5")) as bank:
        pass
    with pytest.raises(InputError, match=r"bank\.h5: .*position 0 is not readable: the file is closed; open it again"):
        bank.green(0)


def test_a_bank_after_contract_section_2_by_another_program_then_is_read_as_it_says(tmp_path):
    path = foreign(tmp_path / "foreign.h5", np.ones((2, 3, 4), ">f4"))
    with h5py.File(path, "r+") as file:
        file.attrs.update(format="wavefocus-bank", format_version=1, band_hz=[30.0, 400.0], response_unit="m/V")
        file.attrs.update(rig="{}", plan_sha256=np.bytes_(b"cd"))
        file["status"] = np.array([4, 1], np.uint8)
        file["actuator_mm"] = np.arange(6.0).reshape(3, 2)
        file["quality/snr_db"] = np.array([10.0, 20.0], np.float32)
        file["quality/attempts"] = np.array([2, 1], np.float32)
    with open_bank(path) as bank:
        assert bank.band_hz == (30.0, 400.0)
        assert bank.response_unit == "m/V"
        assert bank.plan_sha256 == "cd"
        assert bank.status.tolist() == [4, 1]
        assert bank.actuator_mm[2].tolist() == [4.0, 5.0]
        assert bank.quality["snr_db"].tolist() == [[10.0] * 3, [20.0] * 3]
        assert bank.quality["attempts"].tolist() == [2, 1]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (without("green"), "has no dataset /green"),
        (without("position_mm"), "has no dataset /position_mm"),
        (without("sample_rate_hz"), "has no attribute sample_rate_hz"),
        (attribute("sample_rate_hz", -1.0), "the sample rate is -1 Hz; 10 to 1e\\+09 Hz are allowed"),
        (attribute("units", "m", of="position_mm"), "position_mm states the units 'm'; its name says mm"),
        (attribute("sample_rate_hz", np.nan), "sample_rate_hz is nan; a finite number"),
        (attribute("sample_rate_hz", "8 kHz"), "sample_rate_hz is '8 kHz'; a finite number"),
        (attribute("sample_rate_hz", h5py.Empty("f8")), "sample_rate_hz"),
        (attribute("band_hz", [1.0, 2.0, 3.0]), "2 finite numbers"),
        (attribute("band_hz", [500.0, 20.0]), "band_hz is 500 to 20"),
        (attribute("response_unit", 3), "response_unit holds no text"),
        (attribute("format", "wavefocus-drive"), "'wavefocus-bank' is needed"),
        (put("green", np.ones((2, 4))), r"/green has shape \(2, 4\)"),
        (put("green", np.ones((0, 2, 4))), r"/green has shape \(0, 2, 4\)"),
        (put("green", np.ones((2, 2, 4), complex)), "/green holds no plain numbers"),
        (put("green", np.array(["a"], h5py.string_dtype())), "/green holds no plain numbers"),
        (put("green", h5py.ExternalLink("other.h5", "/green")), "/green is a link to elsewhere"),
        (put("position_mm", np.ones((3, 2))), r"/position_mm has shape \(3, 2\); \(2, 2\) is needed"),
        (put("position_mm", np.array([[0, 0], [0, np.inf]])), "/position_mm is not finite at position 1"),
        (put("actuator_mm", np.ones((2, 3))), r"/actuator_mm has shape \(2, 3\)"),
        (put("time_s", np.arange(4) / 999.0), "/time_s has .* they must agree"),
        (attribute("scale_factor", np.nan, of="green"), r"/green is packed \(scale_factor\)"),
        (put("status", np.array([1, 77])), "/status holds 1 to 77"),
        (put("status", np.array([1.0, 0.0])), "/status holds floats; integers are needed"),
        (put("quality/snr_db", np.ones((3, 3))), r"/quality/snr_db has shape \(3, 3\)"),
        (put("quality", h5py.ExternalLink("other.h5", "/quality")), "/quality is a link to elsewhere"),
    ],
)
def test_a_foreign_bank_with_something_wrong_then_is_refused_by_name(tmp_path, change, message):
    path = foreign(tmp_path / "foreign.h5", np.ones((2, 2, 4)))
    with h5py.File(path, "r+") as file:
        change(file)
    before = path.read_bytes()
    with pytest.raises(InputError, match=message) as refusal:
        open_bank(path)
    assert "foreign.h5" in str(refusal.value)
    assert "\n" not in str(refusal.value)
    assert path.read_bytes() == before


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_a_value_that_is_not_finite_then_is_named_by_position_and_actuator(tmp_path, bad):
    green = np.ones((3, 2, 4))
    green[2, 1, 3] = bad
    with open_bank(foreign(tmp_path / "foreign.h5", green)) as bank:
        assert bank.status.tolist() == [1, 1, 0]
        with pytest.raises(InputError, match="position 2, actuator 1 holds NaN or infinities"):
            bank.green(2)
    found = [one for one in check_bank(tmp_path / "foreign.h5") if one.position == 2]
    assert [(one.severity, "actuator 1" in one.message) for one in found] == [("error", True)]


def test_a_compressed_row_that_is_damaged_then_is_refused_in_one_line(tmp_path):
    path = foreign(tmp_path / "foreign.h5", np.ones((2, 2, 400)), compression="gzip", chunks=(1, 2, 400))
    with h5py.File(path, "r") as file:
        offset = file["green"].id.get_chunk_info(1).byte_offset
    overwrite(path, offset, b"\xff" * 8)
    with open_bank(path) as bank:
        assert bank.green(0).all()
        with pytest.raises(InputError, match="/green at position 1 is damaged") as refusal:
            bank.green(1)
    assert "\n" not in str(refusal.value)


def test_integers_then_are_read_as_floats_and_missing_ones_not_measured(tmp_path):
    stored = np.arange(24, dtype=np.int16).reshape(3, 2, 4)
    stored[2] = -32768
    path = foreign(tmp_path / "foreign.h5", stored)
    with h5py.File(path, "r+") as file:
        file["green"].attrs["_FillValue"] = np.int16(-32768)
        del file["position_mm"]
        file["position_mm"] = np.array([[0, 0], [4, 0], [8, 0]], np.int16)
    with open_bank(path) as bank:
        assert np.array_equal(bank.green(1), stored[1])
        assert bank.position_mm[:, 0].tolist() == [0.0, 4.0, 8.0]
        assert bank.status.tolist() == [1, 1, 0]
