"""Wrong types, words and shapes in Python: every parameter of every public function, one at a time."""

import inspect
import math
from collections.abc import Callable
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np
import pytest

import wavefocus as wf
from tests.lab_files import write_bank

RNG = np.random.default_rng(3)
PLACES_MM = np.array([[0.0, 0.0], [4.0, 0.0], [8.0, 0.0]])
BANK = wf.GreenArray(RNG.normal(size=(3, 2, 8)), PLACES_MM, 1000.0)
SOURCE = wf.Source(wf.Point((0.0, 0.0)), wf.Impulse())
SCENE = wf.Scene("tap", (SOURCE,))
DRIVE = wf.render(SCENE, BANK)
FIELD = wf.predict(DRIVE, BANK)
BENCH = wf.virtual_rig(actuators=2, position_mm=[[0, 0], [5, 0], [10, 0]])

# What a valid call has; of keywords that are not here the default.
VALID: dict[str, tuple[Callable[..., Any], dict[str, Any]]] = {
    "Circle": (wf.Circle, {"centre_mm": (0.0, 0.0), "radius_mm": 1.0}),
    "Drive": (wf.Drive, {one.name: getattr(DRIVE, one.name) for one in fields(DRIVE)}),
    "Field": (wf.Field, {one.name: getattr(FIELD, one.name) for one in fields(FIELD)}),
    "GreenArray": (
        wf.GreenArray, {"values": BANK.values, "position_mm": PLACES_MM, "sample_rate_hz": 1000.0, "status": [1, 1, 1]},
    ),
    "Line": (wf.Line, {"start_mm": (0.0, 0.0), "end_mm": (4.0, 0.0)}),
    "Noise": (wf.Noise, {"band_hz": (50.0, 450.0), "duration_s": 0.1}),
    "Point": (wf.Point, {"at_mm": (0.0, 0.0)}),
    "Polyline": (wf.Polyline, {"points_mm": [(0.0, 0.0), (4.0, 0.0)]}),
    "QuietPlace": (wf.QuietPlace, {"path": wf.Point((0.0, 0.0))}),
    "Scene": (wf.Scene, {"name": "tap", "sources": (SOURCE,)}),
    "Sine": (wf.Sine, {"frequency_hz": 100.0, "duration_s": 0.1}),
    "SoundFile": (wf.SoundFile, {"path": "none.wav"}),
    "Source": (wf.Source, {"path": wf.Point((0.0, 0.0)), "signal": wf.Impulse()}),
    "TrajectoryPath": (wf.TrajectoryPath, {"time_s": [0.0, 1.0], "points_mm": [(0.0, 0.0), (4.0, 0.0)]}),
    "VirtualBench.estimate": (BENCH.estimate, {}),
    "VirtualBench.measure": (BENCH.measure, {"bank": "new.h5"}),
    "VirtualBench.record": (BENCH.record, {"position": 0}),
    "VirtualBench.truth": (BENCH.truth, {"position": 0}),
    "GreenArray.green": (BANK.green, {"position": 0}),
    # Of a session that is not open: the arguments are looked at first.
    "LiveSources.end_source": (lambda **given: wf.LiveSources.end_source(None, **given), {"name": "a"}),
    "LiveSources.move": (lambda **given: wf.LiveSources.move(None, **given), {"name": "a", "at_mm": (0.0, 0.0)}),
    "LiveSources.set_signal": (
        lambda **given: wf.LiveSources.set_signal(None, **given), {"name": "a", "signal": wf.Impulse()},
    ),
    "add_note": (wf.add_note, {"path": "none.h5", "text": "x"}),
    "estimate": (wf.estimate, {"raw": "none.raw.h5", "bank": "new.h5"}),
    "estimate_positions": (wf.estimate_positions, {"raw": None, "estimator": None, "positions": [0], "workers": 1}),
    "estimator": (wf.estimator, {"raw": None}),
    "export_bank": (wf.export_bank, {"bank": "none.h5", "out": "new.mat", "to": "mat"}),
    "focus_figures": (wf.focus_figures, {"drive": DRIVE, "bank": BANK}),
    "import_bank": (wf.import_bank, {"source": "none.npz", "bank": "new.h5"}),
    "interpolate": (wf.interpolate, {"bank": BANK, "places_mm": [(0.0, 0.0)], "method": "nearest"}),
    "live": (wf.live, {"bank": "none.h5"}),
    "load_scene": (wf.load_scene, {"path": "none.toml"}),
    "open_bank": (wf.open_bank, {"path": "none.h5"}),
    "open_raw": (wf.open_raw, {"path": "none.h5"}),
    "predict": (wf.predict, {"drive": DRIVE, "bank": BANK}),
    "quiet_levels": (wf.quiet_levels, {"drive": DRIVE, "bank": BANK}),
    "read_drive": (wf.read_drive, {"path": "none.h5"}),
    "read_field": (wf.read_field, {"path": "none.h5"}),
    "render": (wf.render, {"scene": SCENE, "bank": BANK}),
    "virtual_rig": (wf.virtual_rig, {}),
    "write_drive": (wf.write_drive, {"path": "new.h5", "drive": DRIVE}),
    "write_field": (wf.write_field, {"path": "new.h5", "field": FIELD}),
}  # fmt: skip
MADE_BY_OTHERS = {"Bank", "FocusResults", "Impulse", "InputError", "LiveSources", "RawFile", "VirtualBench"}


class Stranger:
    """An object that fits nothing."""


def parameters(name):
    made: Any = wf
    for part in name.split("."):
        made = getattr(made, part)
    return [one for one in inspect.signature(made).parameters if one != "self"]


def test_given_the_public_names_then_every_one_that_takes_arguments_is_tried():
    assert {name.partition(".")[0] for name in VALID} | MADE_BY_OTHERS == set(wf.__all__)


@pytest.mark.parametrize("name", VALID)
@pytest.mark.parametrize(
    "wrong",
    [Stranger(), b"bytes", {"a": 1}, [Stranger()], [[1.0], [1.0, 2.0]], 1j],
    ids=["object", "bytes", "mapping", "list of objects", "ragged list", "complex"],
)
def test_given_a_wrong_type_then_it_is_an_input_error(name, wrong, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, valid = VALID[name]
    for parameter in parameters(name):
        if isinstance(wrong, dict) and parameter in ("names", "run", "rig"):
            continue  # a mapping is what they take
        with pytest.raises(
            wf.InputError, match=rf"\b{parameter}\b|none\.|shape|trajectory|bank|green|raw is|interpolation is"
        ):
            call(**{**valid, parameter: wrong})
    assert not list(tmp_path.iterdir())


WRONG: dict[str, list[dict[str, Any]]] = {
    "render": [
        {"method": "Exact"}, {"device": "gpu"}, {"tolerance_db": "-60"}, {"tolerance_db": math.nan}, {"bank": DRIVE},
        {"scene": DRIVE},
    ],
    "predict": [
        {"dtype": "complex128"}, {"dtype": "nonsense"}, {"rate_hz": 0.0}, {"rate_hz": -100.0}, {"device": ""},
        {"bank": SCENE}, {"on_progress": 3},
    ],
    "write_field": [{"dtype": "int8"}],
    "write_drive": [{"force": "no"}],
    "export_bank": [{"missing": "Nan"}, {"to": "MAT"}, {"binary": 1}],
    "import_bank": [
        {"kind": "xyz"}, {"measurements": "rows"}, {"band_hz": (50.0, 450.0, 3.0)}, {"taps": 1.5},
        {"names": {"green": 3}}, {"length_unit": "furlong"},
    ],
    "live": [{"gain_db": math.inf}],
    "estimate": [{"workers": 0}, {"workers": 2.5}],
    "virtual_rig": [
        {"actuators": 0}, {"actuators": -3}, {"actuators": "four"}, {"run": {"sweep": 3}}, {"run": {3: {}}},
    ],
    "GreenArray": [
        {"status": [1, 1]}, {"status": [1, 1, 256]}, {"band_hz": (500, 20)}, {"band_hz": (20.0,)}, {"response_unit": 3},
        {"actuator_mm": [[0.0, 0.0]]}, {"values": [["a"]]}, {"values": np.ones((3, 2, 8), complex)},
        {"sample_rate_hz": "1000"}, {"sample_rate_hz": True}, {"band_hz": (20.0, 600.0)},
    ],
    "Drive": [{"focus_sample": [0.5]}, {"drive_unit": 3}],
    "Field": [{"position_index": [0.5, 1, 2]}],
    "Scene": [{"sources": [3]}, {"sources": "ab"}],
    "Source": [{"emission": "Continuous"}, {"start_s": "0"}],
    "Point": [{"at_mm": ("0", "0")}, {"at_mm": (0.0, 0.0, 0.0)}],
    "Polyline": [{"points_mm": [0.0, 1.0]}],
    "Noise": [{"band_hz": 50.0}, {"seed": 1.5}],
    "TrajectoryPath": [{"time_s": 3.0}],
}  # fmt: skip


@pytest.mark.parametrize(("name", "given"), [(name, given) for name, rows in WRONG.items() for given in rows])
def test_given_a_wrong_word_number_or_shape_then_it_is_an_input_error(name, given, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    call, valid = VALID[name]
    with pytest.raises(wf.InputError):
        call(**{**valid, **given})
    assert not list(tmp_path.iterdir())


NOT_ROWS = [[1.9], [1.0], ["1"], [None], "1", 1.5, [3], [-1], [True, False], [[0, 1]], [1j], {"0": 1}, np.nan]


@pytest.mark.parametrize("positions", NOT_ROWS, ids=repr)
def test_given_something_else_than_rows_then_it_is_refused_everywhere(positions, tmp_path):
    bank = tmp_path / "bank.h5"
    write_bank(bank, BANK.values, PLACES_MM)
    for call in (
        lambda: wf.predict(DRIVE, BANK, positions),
        lambda: wf.export_bank(bank, tmp_path / "out.mat", "mat", positions=positions),
        lambda: BENCH.measure(tmp_path / "new.h5", positions),
    ):
        with pytest.raises(wf.InputError):
            call()
    assert [file.name for file in tmp_path.iterdir()] == ["bank.h5"]


@pytest.mark.parametrize(
    "positions",
    [
        [2, 0], (2, 0), np.array([2, 0], np.uint8), np.array([True, False, True]), [True, False, True],
        np.flatnonzero([True, False, True]), range(0, 3, 2),
    ],
    ids=repr,
)  # fmt: skip
def test_given_rows_or_a_mask_then_those_are_taken(positions, tmp_path):
    write_bank(tmp_path / "bank.h5", BANK.values, PLACES_MM)
    wanted = sorted([2, 0])
    assert sorted(wf.predict(DRIVE, BANK, positions).position_index) == wanted
    wf.export_bank(tmp_path / "bank.h5", tmp_path / "out.npz", "npz", positions=positions)
    assert sorted(np.load(tmp_path / "out.npz")["position_mm"][:, 0]) == PLACES_MM[wanted, 0].tolist()


def test_given_lists_and_arrays_in_place_of_tuples_then_they_are_the_same():
    assert wf.Scene("tap", [SOURCE]) == SCENE
    assert wf.Point([1, 2]) == wf.Point(np.array([1.0, 2.0])) == wf.Point((1.0, 2.0))
    assert wf.Polyline(np.array([[0, 0], [4, 0]])) == wf.Polyline([(0.0, 0.0), (4.0, 0.0)])
    assert wf.Noise([50, 450], 0.1) == wf.Noise((50.0, 450.0), 0.1)
    assert all(is_dataclass(one) for one in (SCENE, SOURCE))
