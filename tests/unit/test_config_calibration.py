"""The calibration file: written, read, taken into the rig, and refused where it contradicts it."""

import json
import tomllib
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from wavefocus.config.calibration import (
    ActuatorMeasured,
    ActuatorsMeasured,
    CalibrationRecord,
    Fiducial,
    InputsMeasured,
    MirrorMeasured,
    OutputMeasured,
    OutputsMeasured,
    load_calibration,
    write_calibration,
)
from wavefocus.config.rig import RigConfig, default_rig
from wavefocus.config.run import default_run
from wavefocus.configuration import load_rig, plan_sha256
from wavefocus.drivers.protocols import DeviceIdentity
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


def outputs_measured(*channel: OutputMeasured) -> OutputsMeasured:
    return OutputsMeasured(at=AT, device="p", identity=DeviceIdentity("", "p"), loopback_channel=2, channel=channel)


def measured(**changes: object) -> CalibrationRecord:
    marks = [Fiducial(place_mm=(x, y), angles_mrad=(x, y), residual_mm=0.1) for x, y in np.eye(4, 2).tolist()]
    parts: dict[str, object] = {
        "mirror": MirrorMeasured(
            at=AT, device="m", identity=DeviceIdentity("", "m"), map=MAP, residual_rms_mm=0.1, fiducial=tuple(marks)
        ),
        "inputs": InputsMeasured(at=AT, device="r", identity=DeviceIdentity("", "r"), inter_channel_delay_s=7.5e-6),
        "outputs": outputs_measured(
            OutputMeasured(channel=2, latency_s=0.0, full_scale_v=4.9, polarity=1),
            OutputMeasured(channel=0, latency_s=1e-6, full_scale_v=5.1, polarity=-1),
            OutputMeasured(channel=1, latency_s=-1e-6, polarity=1),
        ),
        "actuators": ActuatorsMeasured(
            at=AT,
            device="p",
            identity=DeviceIdentity("", "p"),
            distance_mm=30.0,
            actuator=tuple(
                ActuatorMeasured(actuator=one, channel=one, polarity=1, level_db=0.5, verdict="good") for one in (0, 1)
            ),
        ),
        **changes,
    }
    head = {"format": "wavefocus-calibration", "format_version": 1, "made": AT, "software": "wavefocus 0.1.0"}
    return CalibrationRecord.model_validate({**head, "rig": "two coils", **parts})


def lab(tmp_path: Path, record: CalibrationRecord, rig: str = RIG) -> Path:
    write_calibration(tmp_path / "cal.toml", record)
    (tmp_path / "rig.toml").write_text(rig)
    return tmp_path / "rig.toml"


def test_given_a_record_then_its_file_reads_back_equal(tmp_path):
    write_calibration(tmp_path / "cal.toml", measured())
    assert load_calibration(tmp_path / "cal.toml") == measured()


@settings(max_examples=6)
@given(st.text(min_size=1, max_size=50))
def test_given_any_device_name_then_its_file_reads_back_equal(tmp_path_factory, name):
    folder = tmp_path_factory.mktemp("cal")
    identity = DeviceIdentity("", name, name)
    record = measured(inputs=InputsMeasured(at=AT, device=name, identity=identity, inter_channel_delay_s=-1.25e-7))
    write_calibration(folder / "cal.toml", record)
    assert load_calibration(folder / "cal.toml") == record


def test_given_a_file_without_identities_then_it_is_read_and_has_none(tmp_path):
    write_calibration(tmp_path / "cal.toml", measured(inputs=measured().inputs.model_copy(update={"identity": None})))
    assert "identity" not in tomllib.loads((tmp_path / "cal.toml").read_text())["inputs"]
    assert load_calibration(tmp_path / "cal.toml").inputs.identity is None


def test_identity_with_key_that_is_not_known_then_file_is_refused_by_that_key(tmp_path):
    write_calibration(tmp_path / "cal.toml", measured())
    text = (tmp_path / "cal.toml").read_text()
    (tmp_path / "cal.toml").write_text(text.replace('product = "r"', 'product = "r"\ncolour = "r"'))
    with pytest.raises(InputError, match=r"inputs\.identity\.colour"):
        load_calibration(tmp_path / "cal.toml")


def test_given_a_file_that_is_there_then_it_is_never_overwritten(tmp_path):
    (tmp_path / "cal.toml").write_text("mine")
    with pytest.raises(InputError, match=r"cal\.toml: is there already and is not overwritten"):
        write_calibration(tmp_path / "cal.toml", measured())
    assert (tmp_path / "cal.toml").read_text() == "mine"


def test_given_a_calibration_then_what_it_measured_wins_over_the_rig_file(tmp_path):
    rig = load_rig(
        lab(tmp_path, measured(), RIG + "[mirror]\ndistance_mm = 900\n[recorder]\ninter_channel_delay_s = 5e-6\n")
    )
    assert rig.mirror.matrix == MAP
    assert rig.recorder.inter_channel_delay_s == 7.5e-6
    assert rig.player.channel_full_scale_v == (5.1, 5.0, 4.9)
    assert rig.player.largest_v == 3.0
    assert rig.calibration.measured == measured()


def test_given_a_part_that_was_not_measured_then_the_rig_file_holds(tmp_path):
    record = measured(mirror=None, outputs=None, actuators=None)
    rig = load_rig(lab(tmp_path, record, RIG + "[mirror]\ndistance_mm = 900\n"))
    assert rig.mirror.distance_mm == 900
    assert rig.player.channel_full_scale_v is None
    assert rig.recorder.inter_channel_delay_s == 7.5e-6


def test_given_a_calibrated_rig_then_its_json_alone_says_all_of_it(tmp_path):
    rig = load_rig(lab(tmp_path, measured()))
    (tmp_path / "cal.toml").unlink()
    assert RigConfig.model_validate_json(rig.model_dump_json()) == rig


@pytest.mark.parametrize(
    ("table", "line", "told"),
    [
        ("mirror", "map = [[0.001, 0, 0], [0, 0.001, 0], [0, 0, 1]]", "contradicts the calibration file"),
        ("player", "channel_full_scale_v = [1.0, 1.0, 1.0]", "contradicts the calibration file"),
        ("player", "loopback_channel = 5", "must be 2, as in the calibration file, or that was measured with another"),
        ("player", "channels = [1, 0]", "must have actuator 0 on output 0, as in the calibration file, or that"),
    ],
)
def test_given_a_contradiction_then_it_is_refused_in_one_line(tmp_path, table, line, told):
    rig = RIG.replace("[player]\n", f"[player]\n{line}\n") if table == "player" else f"{RIG}[{table}]\n{line}"
    file = lab(tmp_path, measured(), rig)
    with pytest.raises(InputError) as refused:
        load_rig(file)
    assert str(refused.value).startswith(f"{file}: {table}.{line}: {told}")


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("format_version = 1", "format_version = 2", "format_version = 2: must be 1; a newer wavefocus wrote it"),
        ('"wavefocus-calibration"', '"wavefocus-bank"', 'format = "wavefocus-bank": must be "wavefocus-calibration"'),
        ("latency_s = 1e-06", "latency_us = 1.0", "latency_us = 1.0: unknown key; did you mean latency_s?"),
        ("polarity = -1", "polarity = 0", "outputs.channel[1].polarity = 0: must be 1 or -1"),
        ("channel = 1,", "channel = 0,", "outputs.channel[2].channel = 0: is there already"),
        ("7.5e-06", "nan", "inputs.inter_channel_delay_s = nan: must be a finite number"),
        ("made = 2026", "made = ", "not TOML"),
    ],
)
def test_given_a_spoilt_calibration_file_then_it_is_told_in_one_line(tmp_path, old, new, told):
    write_calibration(tmp_path / "good.toml", measured())
    text = (tmp_path / "good.toml").read_text()
    assert old in text
    (tmp_path / "cal.toml").write_text(text.replace(old, new, 1))
    (tmp_path / "rig.toml").write_text(RIG)
    with pytest.raises(InputError) as refused:
        load_rig(tmp_path / "rig.toml")
    assert told in str(refused.value)
    assert str(refused.value).startswith(str(tmp_path / "cal.toml"))


def sha256(rig: RigConfig) -> str:
    return plan_sha256(rig, default_run(), POSITIONS)


def test_given_a_calibration_then_what_it_measured_is_in_the_plans_hash(tmp_path):
    calibrated = load_rig(lab(tmp_path, measured()))
    (tmp_path / "rig.toml").write_text(RIG.replace('file = "cal.toml"', ""))
    assert sha256(calibrated) != sha256(load_rig(tmp_path / "rig.toml"))


def test_given_only_another_date_latency_or_level_then_the_plans_hash_stays(tmp_path):
    hashes = set()
    record = json.loads(measured().model_dump_json())
    for name, changes in (("a", {}), ("b", {"made": "2027-01-01T00:00:00Z"}), ("c", {"actuators": None})):
        (tmp_path / name).mkdir()
        changed = CalibrationRecord.model_validate({**record, **changes})
        hashes.add(sha256(load_rig(lab(tmp_path / name, changed))))
    assert len(hashes) == 1


REAL = {
    "mirror": {"driver": "generic", "port": "COM3"},
    "recorder": {"driver": "nidaqmx", "device": "Dev1"},
    "player": {"driver": "sounddevice", "device": "interface"},
}


@pytest.mark.parametrize(
    ("table", "changes", "same"),
    [
        ("mirror", {"port": "COM4", "baud": 9600, "identity": "G", "tolerance_mrad": 2.0}, True),
        ("mirror", {"driver": "asi-tiger"}, False),
        ("mirror", {"driver": "mirrorcle-mti", "full_scale_mrad": 300.0}, False),
        ("recorder", {"device": "Dev2", "address": "box:31763", "trigger": "PFI0"}, True),
        ("recorder", {"response_input": "ai2"}, False),
        ("recorder", {"terminal": "rse"}, False),
        ("player", {"device": "other", "host_api": "ASIO", "block_frames": 512, "limit_v": 1.0}, True),
        ("player", {"channel_full_scale_v": [4.0] * 21}, False),
        ("vibrometer", {"driver": "polytec-ofv5000", "port": "COM5", "sensitivity_m_s_per_v": 0.125}, True),
        ("vibrometer", {"sensitivity_m_s_per_v": 0.025}, False),
        ("emulation", {"seed": 5, "clock_ppm": 3.0, "dead_actuators": [1]}, True),
        ("recovery", {"give_up_after_s": 5.0}, True),
        ("usb", [{"role": "player", "vendor_id": 1, "product_id": 2}], True),
    ],
)
def test_given_a_real_rig_then_its_hash_changes_with_what_makes_rows_differ_in_kind(table, changes, same):
    before = RigConfig.model_validate(REAL)
    merged = {**REAL.get(table, {}), **changes} if isinstance(changes, dict) else changes
    after = RigConfig.model_validate({**REAL, table: merged})
    assert (sha256(before) == sha256(after)) is same


def test_a_virtual_rig_then_what_it_is_like_is_in_the_hash_and_its_faults_are_not():
    def hashed(**emulation: object) -> str:
        return sha256(RigConfig.model_validate({"emulation": emulation}))

    fault = {"role": "player", "kind": "lost", "at_call": 1}
    assert hashed(fault_plan=[fault], period_frames=64) == sha256(default_rig())
    assert hashed(clock_ppm=31.0) != sha256(default_rig())


def test_given_a_calibrated_virtual_rig_then_what_calibration_found_is_gone(tmp_path):
    emulation = "[emulation]\noutput_gain_spread_db = 1.0\nreversed_outputs = [1]\n"
    emulation += "mirror_map = [[1, 0, 0], [0, 1, 0], [0, 0, 900]]\n"
    (tmp_path / "rig.toml").write_text(RIG.replace('file = "cal.toml"', "") + emulation)
    before = virtual_settings(load_rig(tmp_path / "rig.toml"))
    assert before.output_gain is not None
    true_v = [5.0 * abs(gain) for gain in before.output_gain]
    outputs = outputs_measured(
        *(
            OutputMeasured(channel=channel, latency_s=0.0, full_scale_v=volts, polarity=1)
            for channel, volts in enumerate(true_v)
        )
    )
    write_calibration(tmp_path / "cal.toml", measured(outputs=outputs))
    (tmp_path / "rig.toml").write_text(RIG + emulation)
    after = virtual_settings(load_rig(tmp_path / "rig.toml"))
    assert after.output_gain == pytest.approx([1.0, -1.0, 1.0])
    assert after.mirror.matrix == before.mirror.matrix == ((1, 0, 0), (0, 1, 0), (0, 0, 900))
