"""The calibration file: written, read, named in the rig file, and warned of where it is old or of another device."""

import json
import re
import tomllib
from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

from wavefocus.config import calibration as cal
from wavefocus.config.rig import RigConfig
from wavefocus.config.run import RunConfig
from wavefocus.configuration import load_rig, plan_sha256
from wavefocus.drivers.protocols import DeviceIdentity
from wavefocus.rig.calibration_validity import calibrated_elsewhere, calibration_warnings
from wavefocus.rig.virtual_bench import virtual_settings
from wavefocus.storage.errors import InputError

AT = datetime(2026, 11, 21, 22, 10, tzinfo=UTC)
MAP = ((1.02e-3, 3e-5, 0.01), (-2e-5, 0.98e-3, -0.005), (1e-4, -5e-5, 1.0))
POSITIONS = np.array([[0.0, 0.0], [4.0, 0.0]])
RIG = """
[actuators]
position_mm = [[0, 0], [10, 0]]
[player]
limit_v = 3.0
[calibration]
file = "cal.toml"
"""


def outputs_measured(*channel):
    return cal.OutputsMeasured(at=AT, device="p", identity=DeviceIdentity("", "p"), loopback_channel=2, channel=channel)


def measured(**changes):
    marks = [cal.Fiducial(place_mm=(x, y), angles_mrad=(x, y), residual_mm=0.1) for x, y in np.eye(4, 2).tolist()]
    parts: dict[str, object] = {
        "mirror": cal.MirrorMeasured(
            at=AT, device="m", identity=DeviceIdentity("", "m"), map=MAP, residual_rms_mm=0.1, fiducial=tuple(marks)
        ),
        "inputs": cal.InputsMeasured(at=AT, device="r", identity=DeviceIdentity("", "r"), inter_channel_delay_s=7.5e-6),
        "outputs": outputs_measured(
            cal.OutputMeasured(channel=2, latency_s=0.0, full_scale_v=4.9, polarity=1),
            cal.OutputMeasured(channel=0, latency_s=1e-6, full_scale_v=5.1, polarity=-1),
            cal.OutputMeasured(channel=1, latency_s=-1e-6, polarity=1),
        ),
        "actuators": cal.ActuatorsMeasured(
            at=AT, device="p", identity=DeviceIdentity("", "p"), distance_mm=30.0, actuator=tuple(
                cal.ActuatorMeasured(actuator=n, channel=n, polarity=1, level_db=0.5, verdict="good") for n in (0, 1)
            ),
        ), **changes,
    }  # fmt: skip
    head = {"format": "wavefocus-calibration", "format_version": 1, "made": AT, "software": "wavefocus 0.1.0"}
    return cal.CalibrationRecord.model_validate({**head, "rig": "two coils", **parts})


def lab(tmp_path, record, rig=RIG):
    cal.write_calibration(tmp_path / "cal.toml", record)
    (tmp_path / "rig.toml").write_text(rig)
    return tmp_path / "rig.toml"


@pytest.mark.parametrize(
    "name", ["Dev1", "a\"b\\c'", "\x00\x1f\x7f\x85", "\u2028 \U0001f527 \ud7ff", '"""', "# [a]\r\n"]
)
def test_given_any_device_name_then_its_file_reads_back_equal(tmp_path, name):
    identity = None if name == "Dev1" else DeviceIdentity("", name, name)
    inputs = cal.InputsMeasured(at=AT, device=name, identity=identity, inter_channel_delay_s=-1.25e-7)
    cal.write_calibration(tmp_path / "cal.toml", measured(inputs=inputs))
    assert cal.load_calibration(tmp_path / "cal.toml") == measured(inputs=inputs)
    text = (tmp_path / "cal.toml").read_text(encoding="utf-8")
    assert ("identity" in tomllib.loads(text)["inputs"]) == (identity is not None)


def test_given_a_calibration_then_what_it_measured_wins_over_the_rig_file(tmp_path):
    rig = load_rig(
        lab(tmp_path, measured(), RIG + "[mirror]\ndistance_mm = 900\n[recorder]\ninter_channel_delay_s = 5e-6\n")
    )
    with pytest.raises(InputError, match=r"cal\.toml: is there already and is not overwritten"):
        cal.write_calibration(tmp_path / "cal.toml", measured(inputs=None))
    assert rig.mirror.matrix == MAP
    assert rig.recorder.inter_channel_delay_s == 7.5e-6
    assert rig.player.channel_full_scale_v == (5.1, 5.0, 4.9)
    assert rig.player.largest_v == 3.0
    assert rig.calibration.measured == measured()
    (tmp_path / "cal.toml").unlink()
    assert RigConfig.model_validate_json(rig.model_dump_json()) == rig  # its JSON alone says all of it
    # Where a part was not measured, the rig file holds.
    rig = load_rig(
        lab(tmp_path, measured(mirror=None, outputs=None, actuators=None), RIG + "[mirror]\ndistance_mm = 900\n")
    )
    assert rig.mirror.distance_mm == 900
    assert rig.player.channel_full_scale_v is None
    assert rig.recorder.inter_channel_delay_s == 7.5e-6


CONTRADICTIONS = [
    ("mirror", "map = [[0.001, 0, 0], [0, 0.001, 0], [0, 0, 1]]", "contradicts the calibration file"),
    ("player", "channel_full_scale_v = [1.0, 1.0, 1.0]", "contradicts the calibration file"),
    ("player", "loopback_channel = 5", "must be 2, as in the calibration file, or that was measured with another"),
    ("player", "channels = [1, 0]", "must have actuator 0 on output 0, as in the calibration file, or that"),
]
SPOILT = [
    ("format_version = 1", "format_version = 2", "format_version = 2: must be 1; a newer wavefocus wrote it"),
    ('"wavefocus-calibration"', '"wavefocus-bank"', 'format = "wavefocus-bank": must be "wavefocus-calibration"'),
    ("latency_s = 1e-06", "latency_us = 1.0", "latency_us = 1.0: unknown key; did you mean latency_s?"),
    ("polarity = -1", "polarity = 0", "outputs.channel[1].polarity = 0: must be 1 or -1"),
    ("channel = 1,", "channel = 0,", "outputs.channel[2].channel = 0: is there already"),
    ("7.5e-06", "nan", "inputs.inter_channel_delay_s = nan: must be a finite number"),
    ("made = 2026", "made = ", "not TOML"),
]


def test_a_spoilt_calibration_file_or_a_contradiction_to_it_is_refused_in_one_line(tmp_path):
    def refused(rig):
        (tmp_path / "rig.toml").write_text(rig)
        with pytest.raises(InputError) as told:
            load_rig(tmp_path / "rig.toml")
        return str(told.value)

    lab(tmp_path, measured())
    for table, line, told in CONTRADICTIONS:
        heading = f"[{table}]\n"
        rig = RIG.replace(heading, f"{heading}{line}\n") if heading in RIG else f"{RIG}{heading}{line}"
        assert refused(rig).startswith(f"{tmp_path / 'rig.toml'}: {table}.{line}: {told}")
    text = (tmp_path / "cal.toml").read_text()
    for old, new, told in SPOILT:
        assert old in text
        (tmp_path / "cal.toml").write_text(text.replace(old, new, 1))
        assert re.match(rf"{re.escape(str(tmp_path / 'cal.toml'))}.*{re.escape(told)}", refused(RIG))


def sha256(rig):
    return plan_sha256(rig, RunConfig(), POSITIONS)


def test_what_was_measured_is_in_the_plans_hash_dates_latencies_and_levels_are_not(tmp_path):
    hashes = set()
    record = json.loads(measured().model_dump_json())
    for name, changes in (("a", {}), ("b", {"made": "2027-01-01T00:00:00Z"}), ("c", {"actuators": None})):
        (tmp_path / name).mkdir()
        changed = cal.CalibrationRecord.model_validate({**record, **changes})
        hashes.add(sha256(load_rig(lab(tmp_path / name, changed))))
    (tmp_path / "rig.toml").write_text(RIG.replace('file = "cal.toml"', ""))
    assert len(hashes) == 1
    assert hashes != {sha256(load_rig(tmp_path / "rig.toml"))}


def test_given_a_calibrated_virtual_rig_then_what_calibration_found_is_gone(tmp_path):
    emulation = "[emulation]\noutput_gain_spread_db = 1.0\nreversed_outputs = [1]\n"
    emulation += "mirror_map = [[1, 0, 0], [0, 1, 0], [0, 0, 900]]\n"
    (tmp_path / "rig.toml").write_text(RIG.replace('file = "cal.toml"', "") + emulation)
    before = virtual_settings(load_rig(tmp_path / "rig.toml"))
    assert before.output_gain is not None
    true_v = [5.0 * abs(gain) for gain in before.output_gain]
    channels = [
        cal.OutputMeasured(channel=one, latency_s=0.0, full_scale_v=volts, polarity=1)
        for one, volts in enumerate(true_v)
    ]
    cal.write_calibration(tmp_path / "cal.toml", measured(outputs=outputs_measured(*channels)))
    (tmp_path / "rig.toml").write_text(RIG + emulation)
    after = virtual_settings(load_rig(tmp_path / "rig.toml"))
    assert after.output_gain == pytest.approx([1.0, -1.0, 1.0])
    assert after.mirror.matrix == before.mirror.matrix == ((1, 0, 0), (0, 1, 0), (0, 0, 900))


THERE = {role: DeviceIdentity("", role[0]) for role in ("mirror", "recorder", "player")}


def calibrated(**care):
    actuators = {"position_mm": [[0, 0], [10, 0]]}
    care = {"file": "cal.toml", "measured": measured().model_dump(), **care}
    return RigConfig.model_validate({"actuators": actuators, "calibration": care})


def test_a_fresh_calibration_is_trusted_and_every_part_of_an_old_one_warned_of():
    assert calibration_warnings(calibrated(), THERE, AT + timedelta(days=89)) == []
    told = calibration_warnings(calibrated(stale_after_days=10.0), THERE, AT + timedelta(days=30))
    assert told[0].reason == "cal.toml: inputs measured 30 days ago, trusted for 10"
    assert told[0].remedy == "run wavefocus calibrate --only inputs"
    assert len(told) == 4


def test_another_device_then_its_parts_are_warned_of_where_devices_can_be_compared():
    told = calibration_warnings(calibrated(), {**THERE, "player": DeviceIdentity("", "other")}, AT)
    assert [one.part for one in told] == ["outputs", "actuators"]
    assert "measured on another device (p); this is other" in told[0].reason
    older = measured().model_dump()
    del older["inputs"]["identity"]
    rig, there = calibrated(measured=older), {**THERE, "recorder": DeviceIdentity("", "other")}
    assert calibrated_elsewhere(rig, there) == {}
    (one,) = calibration_warnings(rig, there, AT)
    assert "inputs not comparable: the file names its device only in words" in one.reason
    # Windows counts an interface anew at another socket.
    named = [DeviceIdentity("", f"Speakers ({name} USB)") for name in ("2- One 20", "3- One 20", "3- One 8")]
    outputs = measured().outputs.model_copy(update={"identity": named[0]})
    rig = calibrated(measured=measured(outputs=outputs).model_dump())
    assert ["outputs" in calibrated_elsewhere(rig, {"player": one}) for one in named] == [False, False, True]


NEW = "calibration-2026-11-21.toml"


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("[rig]\nname = 'a'  # mine\n", f"[rig]\nname = 'a'  # mine\n\n[calibration]\nfile = \"{NEW}\"\n"),
        (
            "[calibration]  # of the rig\n# file = 'x'\nstale_after_days = 3.0  # days\n\n[rig]\n",
            f"[calibration]  # of the rig\n# file = 'x'\nstale_after_days = 3.0  # days\nfile = \"{NEW}\"\n\n[rig]\n",
        ),
        ("[calibration]\nfile = 'old.toml' # c\n[rig]\n", f'[calibration]\nfile = "{NEW}" # c\n[rig]\n'),
        ("", f'[calibration]\nfile = "{NEW}"\n'),
        ('calibration = { file = "old.toml" } # c\n', f'calibration = {{ file = "{NEW}" }} # c\n'),
        ("calibration = {}\n", f'calibration = {{file = "{NEW}"}}\n'),
        ('calibration.file = "old.toml" # c\nx = 1\n', f'calibration.file = "{NEW}" # c\nx = 1\n'),
        ("calibration.stale_after_days = 3.0\n", f'calibration.stale_after_days = 3.0\ncalibration.file = "{NEW}"\n'),
        ('text = """\n[calibration]\n"""\n', f'text = """\n[calibration]\n"""\n\n[calibration]\nfile = "{NEW}"\n'),
        ("a = 1\r\n[calibration]\r\nfile = 'x'\r\n", f'a = 1\r\n[calibration]\r\nfile = "{NEW}"\r\n'),
    ],
)
def test_given_a_rig_file_then_only_the_name_of_the_calibration_changes(tmp_path, text, expected):
    file = tmp_path / "rig.toml"
    file.write_bytes(text.encode())
    file.chmod(0o640)
    cal.name_calibration(file, NEW)
    assert file.read_bytes().decode() == expected
    assert tomllib.loads(expected)["calibration"]["file"] == NEW
    assert file.stat().st_mode & 0o777 == 0o640
    assert list(tmp_path.iterdir()) == [file]
    for name in ("calibrations/new.toml", r"calibrations\new.toml", 'a"b.toml', "Plätte.toml", r"C:\n"):
        cal.name_calibration(file, name)
        assert tomllib.loads(file.read_text(encoding="utf-8"))["calibration"]["file"] == name


DEEP = f"a = {'[' * 200}{']' * 200}\n"  # Python reads it; the editor of TOML does not


@pytest.mark.parametrize("text", ["calibration = 3\n", "[[calibration]]\nfile = 'x'\n", "[calibration\n", DEEP])
def test_given_a_file_that_has_no_such_table_then_it_is_left_alone(tmp_path, text):
    file = tmp_path / "rig.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=r"rig\.toml: "):
        cal.name_calibration(file, NEW)
    assert file.read_text(encoding="utf-8") == text
