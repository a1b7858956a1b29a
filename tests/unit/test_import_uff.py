"""Universal files that pyuff writes: a modal test, coordinate systems, padded lines, types of functions."""

import codecs

import numpy as np
import pytest
import pyuff
from scipy.spatial.transform import Rotation

import wavefocus as wf
from wavefocus.storage.errors import InputError

# pyuff leaves binary files open.
pytestmark = [
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]
NODES = (3, 7, 12, 20)
DRIVEN = 101
BINS, STEP_HZ = 33, 10.0
TURN = Rotation.from_euler("zyx", [30, -20, 50], degrees=True)
SHIFT_M = np.array([0.02, -0.01, 0.005])
PLACES_M = np.array([[0.0, 0.0, 0.0], [0.011, 0.0, 0.0], [0.0, 0.012, 0.0], [0.013, 0.014, 0.0]])
RESPONSES = np.fft.rfft(
    np.random.default_rng(2).standard_normal((len(NODES), 3, 2 * BINS - 2)) * np.exp(-np.arange(2 * BINS - 2) / 6)
)
"""Responses of each node in the file's x, y and z."""


def text_18(number, kind, reference, turn, shift_m):
    """Set 18 by its three points (SDRL, dataset 18): origin, on +x, in the plane of +x and +z."""
    x, _, z = turn.as_matrix().T
    points = np.concatenate([shift_m, shift_m + 0.5 * x, shift_m + 0.3 * x + 0.4 * z])
    lines = ["".join(f"{one:13.5E}" for one in part) for part in (points[:6], points[6:])]
    head = "".join(f"{one:10d}" for one in (number, kind, reference, 8, 1))
    return f"    -1\n    18\n{head}\nsystem\n{lines[0]}\n{lines[1]}\n    -1\n"


def system_2420(number, kind, turn, shift_m):
    matrix = np.vstack([turn.as_matrix().T, shift_m])  # rows: unit vectors of x, y and z, then the origin
    return pyuff.prepare_2420(Part_UID=1, Part_Name="p", CS_sys_labels=[number], CS_types=[kind], CS_colors=[8],
                              CS_names=["system"], CS_matrices=[matrix], return_full_dict=True)  # fmt: skip


def nodes(own, definition=0, displacement=0, kind=2411, driven=((0.05, 0.0, 0.0),)):
    """Nodes with their own coordinates; the driven ones have those of the file."""
    count, others = len(own), len(driven)
    x, y, z = np.vstack([own, driven]).T.tolist()
    prepare = pyuff.prepare_15 if kind == 15 else pyuff.prepare_2411
    return prepare(node_nums=[*NODES[:count], *range(DRIVEN, DRIVEN + others)], x=x, y=y, z=z,
                   def_cs=[definition] * count + [0] * others, disp_cs=[displacement] * count + [0] * others,
                   color=[0] * (count + others), return_full_dict=True)  # fmt: skip


def functions(values, axes=(3,), step_hz=STEP_HZ, **changes):
    """Functions of each node's responses (nodes, 3, bins) in some directions."""
    plain = {
        "type": 58, "binary": 0, "func_type": 4, "ref_node": DRIVEN, "ref_dir": 3, "abscissa_spacing": 1,
        "abscissa_spec_data_type": 18, "ordinate_spec_data_type": 11, "orddenom_spec_data_type": 13, **changes,
    }  # fmt: skip
    return [
        plain | {"rsp_node": node, "rsp_dir": axis, "data": row[abs(axis) - 1] * np.sign(axis),
                 "x": step_hz * np.arange(row.shape[1])}
        for node, row in zip(NODES, values, strict=False) for axis in axes
    ]  # fmt: skip


def units(length=1.0):
    return pyuff.prepare_164(units_code=9, units_description="user", temp_mode=1, length=length, force=1.0, temp=1.0,
                             temp_offset=0.0, return_full_dict=True)  # fmt: skip


def written(path, *sets, text=""):
    """Write a file: metres, then sets, then text."""
    pyuff.UFF(str(path)).write_sets([units(), *sets], "overwrite")
    with path.open("a") as file:
        file.write(text)
    return path


def imported(path, **options):
    """Places in millimetres and the responses' spectra."""
    with wf.import_bank(path, path.with_suffix(".h5"), "uff", columns="x,y", **options) as bank:
        green = np.stack([bank.green(row)[0] for row in range(bank.positions)])
        return bank.position_mm, np.fft.rfft(green)


def own_coordinates(kind, turn, shift_m):
    """Coordinates of the places in a system, by its definition."""
    x, y, z = turn.inv().apply(PLACES_M - shift_m).T
    if kind == 0:
        return np.column_stack([x, y, z])
    angle = np.degrees(np.arctan2(y, x))
    if kind == 1:
        return np.column_stack([np.hypot(x, y), angle, z])
    radius = np.sqrt(x**2 + y**2 + z**2)
    return np.column_stack([radius, np.degrees(np.arccos(z / radius)), angle])


@pytest.mark.parametrize(
    ("number", "kind", "nodes_set", "binary"),
    [(18, 0, 15, False), (18, 2, 15, True), (2420, 0, 2411, True), (2420, 1, 15, False), (2420, 2, 2411, False)],
)
def test_places_in_a_system_of_their_own_then_are_those_of_the_file(tmp_path, number, kind, nodes_set, binary):
    sets = [nodes(own_coordinates(kind, TURN, SHIFT_M), definition=5, kind=nodes_set)]
    sets += functions(RESPONSES, binary=int(binary))
    if number == 2420:
        path = written(tmp_path / "a.uff", system_2420(5, kind, TURN, SHIFT_M), *sets)
    else:
        path = written(tmp_path / "a.uff", *sets, text=text_18(5, kind, 0, TURN, SHIFT_M))
    places_mm, spectra = imported(path)
    assert np.abs(places_mm - PLACES_M[:, :2] * 1e3).max() < 2e-3
    assert np.abs(spectra - RESPONSES[:, 2]).max() < 1e-4


def test_a_system_in_another_system_then_is_turned_by_both(tmp_path):
    inner, inner_shift = Rotation.from_euler("zyx", [-70, 10, 5], degrees=True), np.array([0.1, 0.2, 0.0])
    own = own_coordinates(1, TURN * inner, SHIFT_M + TURN.apply(inner_shift))
    systems = text_18(6, 1, 5, inner, inner_shift) + text_18(5, 0, 0, TURN, SHIFT_M)
    path = written(tmp_path / "a.uff", nodes(own, definition=6), *functions(RESPONSES), text=systems)
    assert np.abs(imported(path)[0] - PLACES_M[:, :2] * 1e3).max() < 5e-3


@pytest.mark.parametrize("kind", [0, 1])
def test_responses_in_directions_of_their_nodes_then_are_turned_to_those_of_the_file(tmp_path, kind):
    own = []
    for place, response in zip(PLACES_M, RESPONSES, strict=True):
        x, y, _ = TURN.inv().apply(place - SHIFT_M)
        at_node = TURN * Rotation.from_euler("z", np.arctan2(y, x) if kind == 1 else 0.0)
        own.append(at_node.inv().as_matrix() @ response)
    system = system_2420(5, kind, TURN, SHIFT_M)
    path = written(tmp_path / "a.uff", system, nodes(PLACES_M, displacement=5), *functions(own, axes=(1, -2, 3)))
    for axis in range(3):
        if kind == 1:
            assert np.abs(imported(path, direction="xyz"[axis])[1] - RESPONSES[:, axis]).max() < 1e-4
        path.with_suffix(".h5").unlink(missing_ok=True)
    if kind == 0:  # all are turned alike: they stay as measured
        assert np.abs(imported(path, direction="z")[1] - np.array(own)[:, 2]).max() < 1e-4


def test_a_node_whose_normal_points_down_then_has_its_sign_changed(tmp_path):
    system = system_2420(5, 0, Rotation.from_euler("x", 180, degrees=True), np.zeros(3))
    path = written(tmp_path / "a.uff", system, nodes(PLACES_M, displacement=5), *functions(RESPONSES))
    assert np.abs(imported(path)[1] + RESPONSES[:, 2]).max() < 1e-4


def test_what_cannot_be_turned_then_is_refused(tmp_path):
    system = system_2420(5, 1, TURN, SHIFT_M)
    path = written(tmp_path / "a.uff", system, nodes(PLACES_M, displacement=5), *functions(RESPONSES, axes=(1,)))
    with pytest.raises(InputError, match="displacement system 5"):
        imported(path)
    written(path, nodes(PLACES_M, definition=9), *functions(RESPONSES))
    with pytest.raises(InputError, match="coordinate system 9"):
        imported(path)
    table = tmp_path / "places.csv"
    table.write_text("node,x_mm,y_mm\n" + "".join(f"{node},{4 * node},0\n" for node in NODES))
    assert imported(path, places=table)[0][:, 0].tolist() == [4.0 * node for node in NODES]


def test_spectra_then_are_no_frequency_responses(tmp_path):
    path = written(tmp_path / "a.uff", nodes(PLACES_M), *functions(RESPONSES))
    sound = path.read_bytes()
    for kind in (2, 12):
        path.write_bytes(sound.replace(b"\n    4  ", b"\n%5d  " % kind))
        with pytest.raises(InputError, match=rf"types \[{kind}\]"):
            imported(path)
    pyuff.UFF(str(path)).write_sets(functions(RESPONSES), "add")
    assert np.abs(imported(path)[1] - RESPONSES[:, 2]).max() < 1e-4


@pytest.mark.parametrize("uneven", [False, True])
def test_a_last_line_that_is_filled_up_with_zeros_then_is_read(tmp_path, uneven):
    per_line, width = (6, 13) if uneven else (4, 20)
    lines = []
    for row in RESPONSES:
        values = row[2].view(np.float64)
        if uneven:  # single precision, with its own axis
            values = np.column_stack([STEP_HZ * np.arange(BINS), row[2].real, row[2].imag]).reshape(-1)
        filled = np.append(values, np.zeros(-len(values) % per_line))
        lines.append(
            "\n".join("".join(f"{one:{width}.{width - 8}E}" for one in part) for part in filled.reshape(-1, per_line))
        )
    assert (len(values) % per_line) != 0
    text = ""
    for node, numbers in zip(NODES, lines, strict=True):
        text += (
            "    -1\n    58\nid" + 4 * "\nNONE"
            + f"\n{4:5d}{0:10d}{1:5d}{0:10d} {'r':<10}{node:10d}{3:4d} {'f':<10}{DRIVEN:10d}{3:4d}\n"
            + f"{5 if uneven else 6:10d}{BINS:10d}{0 if uneven else 1:10d}{0:13.5E}{STEP_HZ:13.5E}{0:13.5E}\n"
        )  # fmt: skip
        for quantity, unit in ((18, "Hz"), (11, "m/s"), (13, "N"), (0, "NONE")):
            text += f"{quantity:10d}{0:5d}{0:5d}{0:5d} {'NONE':<20} {unit:<20}\n"
        text += f"{numbers}\n    -1\n"
    path = written(tmp_path / "a.uff", nodes(PLACES_M), text=text)
    assert np.abs(imported(path)[1] - RESPONSES[:, 2]).max() < 1e-3


@pytest.mark.parametrize("kind", [15, 2411])
def test_coordinates_whose_signs_take_the_space_between_them_then_are_read(tmp_path, kind):
    places = PLACES_M - [0.1, 0.2, 0.0]
    text = f"    -1\n{kind:6d}\n"
    for node, place in zip(NODES, places, strict=True):
        # A field as wide as a program that writes more digits than the standard has fills it.
        width, digits, newline = (13, 6, "") if kind == 15 else (25, 18, "\n")
        numbers = "".join(f"{one:{width}.{digits}E}" for one in place)
        text += f"{node:10d}{0:10d}{0:10d}{0:10d}{newline}{numbers}\n"
    path = written(tmp_path / "a.uff", *functions(RESPONSES), text=text + "    -1\n")
    path.write_bytes(codecs.BOM_UTF8 + path.read_bytes())  # as some editors save it
    assert np.abs(imported(path)[0] - places[:, :2] * 1e3).max() < 1e-3


@pytest.mark.parametrize("binary", [0, 1])
def test_frequency_responses_of_a_modal_test_then_become_causal_responses(tmp_path, binary):
    random, taps, driven_mm = np.random.default_rng(7), 60, [[50.0, 0.0, 0.0], [0.0, 48.5, 0.0], [-50.0, 10.0, 0.0]]
    green = random.standard_normal((len(NODES), 3, taps)) * 3e-3 * np.exp(-np.arange(taps) / 8)
    spectra = np.fft.rfft(green, 256)
    sets = [units(1e3), nodes(PLACES_M * 1e3, kind=15, driven=driven_mm)]
    for actuator in range(3):
        one = np.repeat(spectra[:, actuator, None], 3, axis=1)  # in every direction
        form = {"step_hz": 2000.0 / 256, "binary": binary, "ref_node": DRIVEN + actuator, "ordinate_spec_data_type": 12}
        sets += functions(one[:2], axes=(3, 1), **form) + functions(one, axes=(-3, 1), **form)[4:]
        sets += functions(np.ones_like(one), **{**form, "func_type": 6})  # coherences
    pyuff.UFF(str(tmp_path / "modal.uff")).write_sets(sets, "overwrite")
    with pytest.raises(InputError, match=r"--direction x\|z"):
        wf.import_bank(tmp_path / "modal.uff", tmp_path / "a.h5")
    with wf.import_bank(tmp_path / "modal.uff", tmp_path / "a.h5", direction="z", taps=taps) as bank:
        found = np.stack([bank.green(row) for row in range(bank.positions)])
        assert np.abs(found - green).max() < 2e-5 * np.abs(green).max()
        assert (bank.response_unit, bank.drive_unit) == ("mm/s^2/N", "N")
        assert np.allclose(bank.position_mm, PLACES_M[:, :2] * 1e3)
        assert np.allclose(bank.actuator_mm, np.array(driven_mm)[:, :2])
        assert bank.import_facts["residual_db"] < -80
        assert any("type 6" in one for one in bank.import_facts["left_out"])
    with wf.import_bank(tmp_path / "modal.uff", tmp_path / "b.h5", direction="z", swap_roles=True) as bank:
        assert (bank.positions, bank.actuators) == (3, len(NODES))
