"""The record of a verification: what was found can be read again, and what was spoilt is a sentence."""

import dataclasses
import json
from functools import cache

import numpy as np
import pytest

from tests.unit.line_verification import GRID_MM, RATE_HZ, bank, rendered, scan_of, scene_of
from wavefocus import InputError, Line, predict, write_field
from wavefocus.config.scene import Output
from wavefocus.rendering.drive.rendering import render_with_report
from wavefocus.rendering.verify.field_pair import read_pair
from wavefocus.rendering.verify.record import RECORD_NAME, RecordedSource, read_record, write_record
from wavefocus.rendering.verify.results import remedy, sentence
from wavefocus.rendering.verify.verdict import compare

NOT_SCANNED = 3
NAMES = {"scene_file": "line.toml", "bank": "plate.h5", "rig": "virtual"}


def known_but_one():
    """The bank, without the place of one actuator."""
    actuator_mm = bank().actuator_mm.copy()
    actuator_mm[2] = np.nan
    return dataclasses.replace(bank(), actuator_mm=actuator_mm)


@cache
def fields():
    """A prediction, a scan that is five percent louder, noisy, and lacks a position, and their comparison."""
    drive, prediction = rendered()
    noise = np.random.default_rng(5).normal(size=prediction.field.shape)
    louder = 1.05 * prediction.field + 0.01 * np.abs(prediction.field).max() * noise
    there = prediction.position_index != NOT_SCANNED
    scan = dataclasses.replace(
        prediction, field=louder[there].astype(np.float32), position_index=prediction.position_index[there]
    )
    measured = scan_of(scan.field, scan.start_s, RATE_HZ, position_index=scan.position_index)
    return prediction, scan, compare(prediction, measured, drive, bank())


@pytest.fixture
def record_file(tmp_path):
    prediction, scan, verification = fields()
    write_field(tmp_path / "prediction.h5", prediction)
    write_field(tmp_path / "scan.h5", scan)
    write_record(
        tmp_path, verification=verification, scene=scene_of(), prediction=prediction, bank=known_but_one(), names=NAMES
    )
    return tmp_path / RECORD_NAME


def test_given_a_record_then_it_says_what_the_comparison_found(record_file):
    verification = fields()[2]
    record = read_record(record_file)
    json.loads(record_file.read_text(encoding="utf-8"), parse_constant=pytest.fail)  # no NaN, no infinity
    assert record.passed == verification.passed
    by_name = {figure.name: figure for figure in record.figures}
    for check in verification.checks:
        figure = by_name[check.name]
        assert (figure.value, figure.limit, figure.passed) == (check.value, check.limit, check.passed)
    assert by_name["normalised error"].difference == pytest.approx(100 * verification.fields.error)
    assert by_name["level"].value == pytest.approx(verification.fields.level_db)
    path_point = by_name["focus to path point"]
    assert path_point.difference == pytest.approx(path_point.scanned - path_point.predicted)
    assert list(record.position_index) == list(range(len(GRID_MM)))
    np.testing.assert_array_equal(record.position_mm, GRID_MM)
    compared = verification.fields.position_index
    np.testing.assert_allclose(record.position_error[compared], verification.fields.position_error)
    assert np.flatnonzero(np.isnan(record.position_error)).tolist() == [NOT_SCANNED]
    assert np.isnan(record.actuator_places_mm[2]).all()
    assert len(record.focus_s) == len(verification.fields.instant)
    assert (record.scene, record.scene_file, record.rig) == ("line", "line.toml", "virtual")
    (source,) = record.sources
    assert source.at_mm(-0.01) is None
    np.testing.assert_allclose(source.at_mm(0.06), (0.0, 0.0), atol=1e-3)
    np.testing.assert_allclose(source.at_mm(9.0), (12.0, 0.0))
    rest = RecordedSource(0.5, 0.5, ((3.0, 4.0),))
    assert rest.at_mm(0.4) is None
    np.testing.assert_array_equal(rest.at_mm(0.5), (3.0, 4.0))


def test_given_causes_of_this_and_of_earlier_versions_then_they_are_read(record_file):
    content = json.loads(record_file.read_text(encoding="utf-8"))
    mirror = {"code": "mirror", "value": [0.4, 1.0, 0.05], "explained": 0.99, "affine": [[0.05, 0, 0.4], [0, 0, 0]]}
    earlier = {"code": "shifted", "value": 4.0, "positions": [5, 6], "shift_mm": [4.0, 0.0], "certain": False}
    content["symptoms"] = [mirror, earlier, {"code": "damping", "value": 3.0}]
    record_file.write_text(json.dumps(content), encoding="utf-8")
    read = read_record(record_file).symptoms
    assert [symptom.code for symptom in read] == ["mirror", "shifted", "damping"]
    assert read[0].value == (0.4, 1.0, 0.05)
    assert all("nan" not in sentence(symptom) and remedy(symptom) for symptom in read)


def test_path_between_positions_then_record_has_point_asked_for_and_position_used(tmp_path):
    source = dataclasses.replace(scene_of().sources[0], path=Line((-12.0, 1.5), (12.0, 1.5)))
    scene = dataclasses.replace(scene_of(), sources=(source,), output=Output(interpolation="nearest"))
    drive, report = render_with_report(scene, bank())
    prediction = predict(drive, bank())
    scan, between = scan_of(prediction.field, prediction.start_s, RATE_HZ), report.interpolation_errors.overall
    verification = compare(prediction, scan, drive, bank(), interpolation_error=between)
    write_record(tmp_path, verification=verification, scene=scene, prediction=prediction, bank=bank(), names=NAMES)
    record = read_record(tmp_path / RECORD_NAME)
    assert [focus.at_mm[1] for focus in record.foci] == pytest.approx([1.5] * len(record.foci))
    assert all(GRID_MM[focus.position, 1] == 0.0 for focus in record.foci)
    by_name = {figure.name: figure for figure in record.figures}
    assert by_name["focus to path point"].scanned == pytest.approx(1.5, abs=0.5)
    expected = by_name["interpolation error expected"]
    assert (expected.relation, expected.limit) == ("at most", 5.0)
    assert expected.value == pytest.approx(100.0 * between)
    assert expected.value > 5.0
    assert not record.passed
    assert "interpolation error expected" in record.summary


def test_given_a_spoilt_record_then_one_sentence_says_what(record_file):
    sound = record_file.read_text(encoding="utf-8")
    for spoil, words in (
        (lambda content: content.update(format="other"), "is not the record of a verification"),
        (lambda content: content.update(format_version=2), "a newer wavefocus wrote it"),
        (lambda content: content.update(made="yesterday"), "made: "),
        (lambda content: content["figures"][0].update(value="much"), "figures[0].value: "),
        (lambda content: content["positions"].update(error=[1.0]), "positions.error"),
        (lambda content: content["positions"].update(at_mm=[[0.0, 0.0]]), "positions.at_mm"),
        (lambda content: content["sources"][0].update(path_mm=[["a", "b"]]), "damaged"),
        (lambda content: content["positions"].pop("correlation"), "correlation"),
    ):
        content = json.loads(sound)
        spoil(content)
        record_file.write_text(json.dumps(content), encoding="utf-8")
        with pytest.raises(InputError, match="verify") as refusal:
            read_record(record_file)
        assert words in str(refusal.value)
        assert "\n" not in str(refusal.value)


def test_given_both_fields_then_the_pair_gives_them_within_the_band_if_of_one_scan(record_file):
    prediction, scan, verification = fields()
    folder = record_file.parent
    compared = verification.fields
    pair = read_pair(folder / "prediction.h5", folder / "scan.h5", compared.band_hz)
    for number, instant in enumerate(compared.instant):
        predicted, scanned = pair.fields[:, :, pair.sample_at(instant.sample / RATE_HZ)]
        np.testing.assert_allclose(predicted[compared.position_index], compared.predicted_snapshot[number], atol=1e-5)
        np.testing.assert_allclose(scanned[compared.position_index], compared.scanned_snapshot[number], atol=1e-5)
    assert np.isnan(scanned[NOT_SCANNED])
    at = int(compared.position_index[40])
    known = np.isfinite(read_record(record_file).position_error)
    loudest, difference = pair.loudest(np.arange(pair.samples), known)
    assert 0.0 < difference < loudest <= np.abs(pair.fields[:, known]).max()
    assert pair.loudest(np.arange(pair.samples), np.zeros(len(GRID_MM), bool)) == (0.0, 0.0)
    unlimited = read_pair(folder / "prediction.h5", folder / "scan.h5", None)
    np.testing.assert_array_equal(unlimited.fields[0, at], prediction.field[at].astype(np.float32))
    # Of two verifications.
    write_field(folder / "late.h5", dataclasses.replace(scan, start_s=scan.start_s + 1.0))
    with pytest.raises(InputError, match="start_s"):
        read_pair(folder / "prediction.h5", folder / "late.h5", None)
    elsewhere = np.arange(len(scan.position_index)) + 500
    write_field(folder / "other.h5", dataclasses.replace(scan, position_index=elsewhere))
    with pytest.raises(InputError, match="position 500"):
        read_pair(folder / "prediction.h5", folder / "other.h5", None)
