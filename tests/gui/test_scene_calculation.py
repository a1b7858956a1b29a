"""Scenes as the process beside the window calculates them: equal to what the commands make, bounded, and refused."""

from __future__ import annotations

from pathlib import Path
from types import NoneType

import h5py
import numpy as np
import pytest

from tests.gui.conftest import line_scene
from tests.lab_files import RIG
from wavefocus.__main__ import run
from wavefocus.config.scene import Regularisation, SceneConfig
from wavefocus.gui.scene.calculation import (
    Answer,
    DriveResult,
    Finished,
    FocusFigures,
    PredictedField,
    SceneRequest,
    interpolate_frame,
)
from wavefocus.gui.scene.draft import changed, scene_toml
from wavefocus.gui.scene.drives_and_foci import render_while_edited
from wavefocus.gui.scene.worker import Calculator, SupersededError
from wavefocus.rendering.drive.coil_limits import DriveLimits
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.field.prediction import predict
from wavefocus.rendering.scene.model import Scene, Source
from wavefocus.rendering.scene.paths import Line, Point
from wavefocus.rendering.scene.signals import Noise, Sine
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.drive_file import read_drive
from wavefocus.storage.errors import InputError


def scene_draft(
    end_mm: float = 4.5, saturation: float = 0.0, limit_v: float = 100.0, emission: str = "continuous"
) -> SceneConfig:
    draft = line_scene(end_mm, emission=emission, limit_v=limit_v)
    return changed(draft, regularisation=Regularisation(saturation=saturation))


class Listener:
    """A calculator, and the end of its connection that keeps its answers; `superseded_by` ends a calculation."""

    def __init__(self, superseded_by: type = NoneType, **options: int) -> None:
        self.told: list[Answer] = []
        self._superseded_by = superseded_by
        self.calculator = Calculator(self, **options)

    def send(self, answer: Answer) -> None:
        self.told.append(answer)

    def poll(self, _wait_s: float) -> bool:
        return any(isinstance(one, self._superseded_by) for one in self.told)

    def calculate(self, draft: SceneConfig, bank: Path, rig: Path | None = None) -> bool:
        self.told.clear()
        return self.calculator.calculate(SceneRequest(1, draft, bank.with_name("scene.toml"), bank, rig), 0.0)

    def one(self, kind):
        (found,) = [told for told in self.told if isinstance(told, kind)]
        return found

    @property
    def field(self) -> np.ndarray:
        return self.one(PredictedField).field


@pytest.mark.smoke
@pytest.mark.parametrize(("saturation", "limit_v", "emission"), [(0.0, 100.0, "continuous"), (0.5, 0.01, "per_point")])
def test_given_a_scene_then_drives_and_field_are_those_of_render_and_predict(
    finished: Path, saturation: float, limit_v: float, emission: str
) -> None:
    draft = scene_draft(4.5, saturation, limit_v, emission)
    listener = Listener()
    assert listener.calculate(draft, finished)
    driven, begun = listener.one(DriveResult), listener.one(PredictedField)
    scene_file = finished.with_name("scene.toml")
    scene_file.write_text(scene_toml(draft), encoding="utf-8")
    out = finished.with_name("drive.h5")
    assert run(["render", str(scene_file), "--bank", str(finished), "--out", str(out)]) == 0
    drive = read_drive(out)
    assert np.linalg.norm(driven.drive_v - drive.drive_v) < 1.1e-3 * np.linalg.norm(drive.drive_v)
    assert driven.limiting.scale == pytest.approx(drive.scale, rel=1e-3)
    assert driven.start_s == drive.start_s
    np.testing.assert_array_equal(driven.focus_s, drive.focus_sample / drive.sample_rate_hz)
    np.testing.assert_allclose(driven.peak_v, np.abs(drive.drive_v).max(axis=1), rtol=5e-3)
    with open_bank(finished) as bank:
        whole = predict(drive, bank).field
    field = listener.field
    assert field.shape[1] == 12
    factor = round(drive.sample_rate_hz / begun.sample_rate_hz)
    assert factor > 4
    largest = np.abs(whole).max()
    for place in (200.0, 260.0 + 2 / factor, 300.0 + 3 / factor):
        np.testing.assert_allclose(
            interpolate_frame(field, place), whole[:, round(place * factor)], atol=3e-3 * largest
        )  # fmt: skip
    figures = listener.one(FocusFigures)
    marks_s = np.array(begun.marks_s)
    np.testing.assert_array_equal(figures.time_s, marks_s)
    row = drive.focus_position[np.searchsorted(driven.focus_s, marks_s, side="right") - 1]
    sample = np.round((marks_s - drive.start_s) * drive.sample_rate_hz).astype(int)
    assert begun.limit == pytest.approx(np.abs(whole[row, sample]).max(), rel=5e-3)
    np.testing.assert_allclose(figures.off_mm, 0.0, atol=6.0)
    assert listener.told[-1] == Finished(1)


def test_given_the_same_bank_again_then_its_surface_is_kept_and_the_answer_is_the_same(finished: Path) -> None:
    listener = Listener()
    listener.calculate(scene_draft(), finished)
    first = listener.one(PredictedField)
    listener.calculate(scene_draft(), finished)
    again = listener.one(PredictedField)
    assert again.surface is first.surface
    np.testing.assert_array_equal(again.field, first.field)
    np.testing.assert_array_equal(again.rows, np.arange(12))


def test_given_a_rig_then_its_limits_count_where_they_are_stricter(finished: Path) -> None:
    rig = finished.with_name("loud.toml")
    rig.write_text(RIG + "\n[player]\nlimit_v = 0.02\ncoil_resistance_ohm = 8.0\nlimit_power_w = 1e-6\n", "utf-8")
    listener = Listener()
    assert listener.calculate(scene_draft(), finished, rig)
    driven = listener.one(DriveResult)
    assert driven.limits.peak_key == "player.limit_v"
    assert driven.limiting.decided_by == "player.limit_power_w"
    assert driven.rms_v.max() ** 2 / 8.0 == pytest.approx(1e-6, rel=1e-6)
    scene_file, out = finished.with_name("scene.toml"), finished.with_name("drive.h5")
    scene_file.write_text(scene_toml(scene_draft()), encoding="utf-8")
    assert run(["render", str(scene_file), "--bank", str(finished), "--out", str(out), "--rig", str(rig)]) == 0
    assert driven.limiting.scale == pytest.approx(read_drive(out).scale, rel=1e-3)
    four = finished.with_name("four.toml")
    four.write_text('[rig]\nname = "x"\n[actuators]\nposition_mm = [[110.0, 0.0]]\n', encoding="utf-8")
    assert not listener.calculate(scene_draft(), finished, four)
    assert "has 1 actuators" in listener.one(Finished).problem


def test_given_rows_that_are_not_measured_then_they_are_listed(finished: Path, tmp_path: Path) -> None:
    bank = foreign_copy(finished, tmp_path / "filling.h5", missing=[1, 2])
    listener = Listener()
    assert not listener.calculate(scene_draft(), bank)
    sentence = listener.one(Finished).problem
    assert "no measurement at 2 positions on the scene's paths: 1, 2." in sentence
    foreign_copy(finished, tmp_path / "filled.h5", missing=[]).replace(bank)
    assert listener.calculator.cache.changed(bank)
    assert listener.calculate(scene_draft(), bank)
    assert listener.one(DriveResult).drive_v.any()
    bank.unlink()
    assert not listener.calculate(scene_draft(), bank)
    assert "is missing" in listener.one(Finished).problem


def test_given_a_field_that_is_too_long_then_its_beginning_is_predicted(finished: Path) -> None:
    whole, short = Listener(), Listener(most_field_bytes=4 * 12 * 90)
    whole.calculate(scene_draft(), finished)
    short.calculate(scene_draft(), finished)
    begun = short.one(PredictedField)
    assert len(begun.field) == 90
    assert begun.lasts_s == whole.one(PredictedField).lasts_s > 90 / begun.sample_rate_hz
    np.testing.assert_allclose(
        short.field, whole.field[:90], atol=1e-4 * np.abs(whole.field).max()
    )  # the low-pass stops 80 dB


def test_given_a_drive_that_is_too_long_then_its_beginning_is_rendered(finished: Path) -> None:
    source = Source(Line((0.0, 0.0), (4.5, 0.0)), Noise((50.0, 400.0), 0.3, 1), speed_mm_s=15.0, step_mm=1.5)
    scene = Scene("long", (source,))
    with open_bank(finished) as bank:
        whole, _ = render_with_report(scene, bank)
        rendered = render_while_edited(
            scene, bank, DriveLimits(peak_v=1e-3), lambda done, total: None, most_bytes=8 * 3 * 2500
        )
    drive, limiting = rendered.drive, rendered.limiting
    assert drive.drive_v.shape == (3, 2500)
    assert rendered.lasts_s == pytest.approx(whole.drive_v.shape[1] / whole.sample_rate_hz, abs=1e-3)
    expected = limiting.scale * whole.drive_v[:, :2500]
    assert np.linalg.norm(drive.drive_v - expected) < 2e-3 * np.linalg.norm(expected)
    assert limiting.decided_by == "limit_v"
    assert "only their first" in rendered.warnings[0]


def test_given_a_scene_of_hours_then_it_is_refused_at_once(finished: Path) -> None:
    scene = Scene("hours", (Source(Point((0.0, 0.0)), Sine(100.0, 7200.0)),))
    with open_bank(finished) as bank, pytest.raises(InputError, match="lasts 2 h 00 min"):
        render_while_edited(scene, bank, DriveLimits(), lambda done, total: None)


def test_given_a_newer_order_then_what_is_under_way_is_given_up(finished: Path) -> None:
    listener = Listener(superseded_by=DriveResult)
    with pytest.raises(SupersededError):
        listener.calculate(scene_draft(), finished)
    assert not any(isinstance(one, PredictedField | Finished) for one in listener.told)


def foreign_copy(bank: Path, copy: Path, missing: list[int]) -> Path:
    with h5py.File(bank, "r", locking=False) as source, h5py.File(copy, "w") as target:
        for name in ("sample_rate_hz", "band_hz", "response_unit", "drive_unit"):
            target.attrs[name] = source.attrs[name]
        for name in ("green", "position_mm", "actuator_mm"):
            target[name] = source[name][...]
        status = np.ones(len(source["position_mm"]), np.uint8)
        status[missing] = 0
        target["status"] = status
    return copy
