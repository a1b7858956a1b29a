"""Tables of places as spreadsheets write them, places stated twice, and actuators off the surface."""

import numpy as np
import pytest
import sofar

import wavefocus as wf
from wavefocus.options import ImportOptions
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.places import coordinates, read_places

WANTED_MM = [[0.5, 1.0, 0.0], [4.5, 1.25, 0.0], [-8.5, 1e3, 0.0]]


def places_mm(tmp_path, content):
    path = tmp_path / "places.csv"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
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
        "x_mm;y_mm\n0.5;1.0\n4.5;1.25\n-8.5;1000\n",
        "x_mm,y_mm,x_m,y_m\n0.5,1,0.0005,0.001\n4.5,1.25,0.0045,0.00125\n-8.5,1000,,1\n",
        "x_mm,y_m,z_um\n0.5,0.001,0\n4.5,0.00125,0\n-8.5,1,0\n",
    ],
)
def test_a_table_as_spreadsheets_write_it_then_has_these_places(tmp_path, content):
    assert places_mm(tmp_path, content) == WANTED_MM


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("x_mm,y_mm\n0,5,1,0\n4,5,1,0\n", "line 2: has 4 cells and the header 2"),
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


def archive(path, **changes):
    green = np.random.default_rng(1).standard_normal((4, 2, 16))
    arrays = {"green": green, "sample_rate_hz": 1000.0, "response_unit": "m/s/V", "drive_unit": "V",
              "position_mm": [[0.0, 0.0], [40.0, 0.0], [0.0, 40.0], [40.0, 40.0]]}  # fmt: skip
    np.savez(path, **(arrays | changes))
    return path


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"position_m": np.ones((4, 2))}, "position_m and position_mm are different places"),
        ({"actuator_mm": np.ones((2, 2)), "actuator_in": np.ones((2, 2))}, "actuator_mm and actuator_in"),
        ({"time_s": np.arange(16) / 2000}, "sample_rate_hz is 1000, and time_s has 2000"),
        ({"drive_unit": "N"}, "drive_unit is 'N'"),
    ],
)
def test_facts_that_an_archive_states_twice_and_otherwise_then_are_refused(tmp_path, changes, message):
    with pytest.raises(InputError, match=message):
        wf.import_bank(archive(tmp_path / "a.npz", **changes), tmp_path / "a.h5")


def test_facts_that_an_archive_states_twice_are_taken_and_its_rate_stands(tmp_path):
    source = archive(tmp_path / "a.npz", position_m=np.array([[0, 0], [0.04, 0], [0, 0.04], [0.04, 0.04]]),
                     time_s=np.arange(16) / 1000)  # fmt: skip
    with wf.import_bank(source, tmp_path / "a.h5") as bank:
        assert bank.position_mm[1].tolist() == [40.0, 0.0]
    with pytest.raises(InputError, match="the file says 1000"):
        wf.import_bank(source, tmp_path / "b.h5", sample_rate_hz=2000.0)


@pytest.mark.parametrize(
    ("height_mm", "known"), [(0.0, True), (2.0, True), (-2.0, True), (60.0, False), (-60.0, False), (600.0, False)]
)
def test_actuators_off_the_surface_then_have_no_place_and_are_named(tmp_path, height_mm, known):
    places = np.array([[50.0, 0.0, height_mm], [0.0, 50.0, 0.0]])
    with wf.import_bank(archive(tmp_path / "a.npz", actuator_mm=places), tmp_path / "a.h5") as bank:
        assert bank.actuator_mm[1].tolist() == [0.0, 50.0]
        assert bank.actuator_mm[0].tolist() == [50.0, 0.0] if known else np.isnan(bank.actuator_mm[0]).all()
        warnings = bank.import_facts["warnings"]
        assert [("off the surface" in one and "the first is 0" in one) for one in warnings] == ([] if known else [True])


def test_sources_above_and_below_a_listener_then_are_not_one_place(tmp_path):
    sofa = sofar.Sofa("SimpleFreeFieldHRIR")
    sofa.Data_IR, sofa.Data_SamplingRate = np.random.default_rng(1).standard_normal((4, 2, 16)), 48_000.0
    sofa.ReceiverPosition = np.array([[0, 0.09, 0], [0, -0.09, 0]])
    sofa.SourcePosition = np.array([[0.0, 60, 1.4], [0, -60, 1.4], [0, 0, 1.4], [90, 0, 1.4]])
    sofar.write_sofa(str(tmp_path / "a.sofa"), sofa)
    with wf.import_bank(tmp_path / "a.sofa", tmp_path / "a.h5", unit="Pa/V") as bank:
        assert np.isnan(bank.actuator_mm[:2]).all()
        assert np.allclose(bank.actuator_mm[2:], [[1400, 0], [0, 1400]])
        assert "2 actuators lie off the surface" in bank.import_facts["warnings"][0]
