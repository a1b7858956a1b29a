"""The doctor: every instrument is examined, whatever the others do; and which delay of the inputs counts."""

import threading
from contextlib import ExitStack
from dataclasses import replace

import numpy as np
import pytest

from tests.lab_files import rig_fault
from tests.unit.test_config_calibration import AT, measured
from wavefocus import InputError, open_bank
from wavefocus.acquisition.doctor import RigFindings, examine
from wavefocus.acquisition.setup import Openers, wired
from wavefocus.config.calibration import InputsMeasured
from wavefocus.config.outline import Outline
from wavefocus.config.rig import RigConfig
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.registry import VibrometerReading
from wavefocus.drivers.timeouts import CallThread
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.rig.setup import setup_in_use
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.writer import BankWriter, create_bank

ACTUATORS = ((110.0, 0.0), (0.0, 60.0), (-110.0, 10.0))


def examined(bench, rig=None, *, play=True, **openers):
    """Findings about a bench; `rig` has tables of its rig file, `openers` other openers."""
    rig = {"actuators": {"position_mm": ACTUATORS}, **(rig or {})}
    sound = Openers(
        rig=RigConfig.model_validate(rig),
        clock=bench.clock,
        mirror=lambda: bench.mirror,
        recorder=lambda: bench.recorder,
        player=lambda: bench.player,
        vibrometer=lambda: reading(None),
    )
    findings = []
    examine(replace(sound, **openers), findings.append, play=play)
    return findings


def reading(signal_level):
    return VibrometerReading(0.125, "", 0.0, signal_level, "decoder")


def verdicts(findings):
    return {(one.instrument, one.check): one.verdict for one in findings}


def failed(findings):
    return {(one.instrument, one.check) for one in findings if one.verdict == "fail"}


def absent(name):
    def refuse():
        raise InstrumentError(name, "opening", "it is not there", "plug it in")

    return refuse


SOUND = VirtualSettings(dropout_probability=0.0, actuator_mm=ACTUATORS)


def test_given_a_sound_rig_then_all_is_well_looked_at_and_released():
    rig = VirtualRig(SOUND)
    findings = examined(rig)
    assert {one.verdict for one in findings} == {"ok"}
    assert not any(one.remedy for one in findings)
    told = verdicts(findings)
    for key in (
        ("mirror", "corners"), ("recorder", "record"), ("recorder", "response noise"), ("player", "outputs"),
        ("player", "loopback level"), ("player", "latency"), ("player", "clock ratio"), ("vibrometer", "response"),
    ):  # fmt: skip
        assert key in told
    for role in (rig.mirror, rig.recorder, rig.player):
        with pytest.raises(InstrumentError, match="it is closed"):
            role.identify()


class Stating:
    """An instrument with some methods of a maker's that states more."""

    def __init__(self, instrument, **methods):
        self.__dict__ |= {"_instrument": instrument, **methods}

    def __getattr__(self, name):
        return getattr(self._instrument, name)


@pytest.mark.parametrize(("device_s", "verdict"), [(14e-6, "warn"), (5.2e-6, "ok"), (None, None)])
def test_given_a_stated_delay_then_it_is_compared_with_the_devices_own(device_s, verdict):
    rig = VirtualRig(SOUND)
    recorder = Stating(rig.recorder, sampling_delay_s=lambda _rate_hz: device_s)
    findings = examined(rig, recorder=lambda: recorder, play=False)
    assert verdicts(findings).get(("recorder", "input delay")) == verdict
    if verdict == "warn":
        (finding,) = [one for one in findings if one.check == "input delay"]
        assert finding.act.on == "recorder.inter_channel_delay_s"
        assert f"{device_s:.4g}" in finding.remedy


def test_given_nothing_may_be_played_then_nothing_is_and_the_rest_is_looked_at():
    told = verdicts(examined(VirtualRig(SOUND), vibrometer=lambda: reading(0.05), play=False))
    assert told["player", "loopback"] == told["vibrometer", "response"] == "skipped"
    assert told["mirror", "corners"] == told["recorder", "record"] == "ok"
    assert told["vibrometer", "signal level"] == "warn"  # little light


@pytest.mark.parametrize("missing", ["vibrometer", "mirror", "recorder", "player"])
def test_given_one_that_is_not_there_then_the_others_are_still_examined(missing):
    findings = examined(VirtualRig(SOUND), **{missing: absent(missing)})
    told = verdicts(findings)
    (finding,) = [one for one in findings if one.verdict == "fail"]
    assert (finding.instrument, finding.what, finding.remedy) == (missing, "opening: it is not there", "plug it in")
    others = {("vibrometer", "identity"), ("mirror", "corners"), ("recorder", "identity"), ("player", "identity")}
    if missing not in ("recorder", "player"):
        others.add(("player", "loopback level"))
    assert {told[key] for key in others if key[0] != missing} == {"ok"}


@pytest.mark.parametrize(
    ("role", "operation", "kind", "call", "failing"),
    [
        ("mirror", "move_to", "lost", 3, {("mirror", "corners")}),
        ("recorder", "read", "lost", 1, {("recorder", "record")}),
        ("recorder", "identify", "lost", 1, {("recorder", "identity"), ("recorder", "record")}),
        ("player", "play", "lost", 1, {("player", "loopback")}),
        ("recorder", "read", "missing_reference", 2, {("player", "loopback level")}),
        ("player", "identify", "lost", 1, {("player", "identity"), ("player", "loopback")}),
    ],
)
def test_an_instrument_that_fails_then_it_is_named_and_the_others_are_not_blamed(role, operation, kind, call, failing):
    findings = examined(VirtualRig(replace(SOUND, fault_plan=(rig_fault(role, operation, kind, at_call=call),))))
    at_rest = {key for key in failed(findings) if key[1] == "putting it to rest"}
    assert failed(findings) - at_rest == failing
    assert {name for name, _ in failed(findings)} == {role if kind == "lost" else "player"}
    assert all(one.remedy for one in findings if one.verdict in ("warn", "fail"))


def test_given_a_passing_fault_then_the_second_try_counts_and_the_first_is_told():
    fault = rig_fault("recorder", "read", "short_read", at_call=1)
    findings = examined(VirtualRig(replace(SOUND, fault_plan=(fault,))))
    told = [one for one in findings if one.verdict != "ok"]
    assert [(one.instrument, one.check, one.verdict) for one in told] == [("recorder", "record", "warn")]
    assert told[0].what.startswith("only at the second try")


CLOCK, LATENCY, LEVEL = (("player", check) for check in ("clock ratio", "latency", "loopback level"))
PURITY, OUTPUTS, CORNERS = ("player", "loopback purity"), ("player", "outputs"), ("mirror", "corners")
RESPONSE, ACTUATOR = ("vibrometer", "response"), ("vibrometer", "actuator")
CROSSTALK, QUIET = ("recorder", "crosstalk"), ("recorder", "reference noise")
NARROW = {"mirror": {"limit_mrad": 50.0, "park_mrad": [0, 0]}}
FEW = {"player": {"channels": [1, 2, 3], "loopback_channel": 29}}


def loopback_gain(gain):
    return {"output_gain": (1.0, 1.0, 1.0, gain)}


@pytest.mark.parametrize(
    ("settings", "rig", "told"),
    [
        ({"clock_ppm": 300.0, "latency_s": (0.09, 0.09)}, {}, {CLOCK: "warn", LATENCY: "warn"}),
        ({"latency_s": (0.3, 0.3)}, {}, {LEVEL: "fail"}),
        ({"reference_noise_v": 0.05}, {}, {PURITY: "warn"}),
        (loopback_gain(10 ** (-0.54 / 20)), {}, {LEVEL: "fail"}),
        (loopback_gain(-1.0), {}, {LEVEL: "warn"}),
        (loopback_gain(0.0), {}, {LEVEL: "fail"}),
        ({"noise_v": 0.5}, {}, {RESPONSE: "fail", CROSSTALK: "warn"}),
        ({"noise_v": 1e-2}, {}, {RESPONSE: "warn"}),
        ({"crosstalk": 1e-4, "actuator_strength": (0.0, 1.0, 1.0)}, {}, {CROSSTALK: "fail", ACTUATOR: "fail"}),
        ({"crosstalk": -1e-3, "crosstalk_delay_s": 5e-4}, {}, {CROSSTALK: "fail"}),
        ({"actuator_strength": (0.0,) * 3}, {}, {RESPONSE: "fail"}),
        ({"sensitivity_m_s_per_v": 1e-4}, {}, {RESPONSE: "fail"}),
        ({}, NARROW | FEW, {CORNERS: "fail", OUTPUTS: "fail"}),
        ({}, {"mirror": {"park_mrad": [0, 0]}}, {("recorder", "pickup"): "skipped"}),  # it parks on the surface
        ({"noise_v": 0.0, "reference_noise_v": 0.0}, {}, {QUIET: "warn"}),
    ],
)
def test_given_something_not_good_enough_then_it_is_told_with_what_to_do(settings, rig, told):
    findings = examined(VirtualRig(replace(SOUND, **settings)), rig)
    assert verdicts(findings) | told == verdicts(findings)
    assert all(one.remedy for one in findings if one.verdict in ("warn", "fail"))


def test_a_polygon_with_the_origin_in_a_notch_is_examined_at_a_place_on_it():
    corners_mm = ((-100, -60), (100, -60), (100, 60), (60, 60), (60, -20), (-60, -20), (-60, 60), (-100, 60))
    actuator_mm = ((80, 40), (-80, 40), (0, -40))
    rig = VirtualRig(replace(SOUND, outline=Outline.polygon(corners_mm), actuator_mm=actuator_mm))
    tables = {"surface": {"kind": "polygon", "corners_mm": corners_mm}, "actuators": {"position_mm": actuator_mm}}
    told = verdicts(examined(rig, tables))
    assert told["mirror", "corners"] == told["vibrometer", "response"] == "ok"


def test_outputs_that_are_picked_up_then_worst_is_named_apart_from_leak_of_loopback():
    picked_up = replace(SOUND, lost_signal_v=1e-3, crosstalk=5e-4, pickup=((0, 1e-3), (2, -4e-3)))
    findings = {(one.instrument, one.check): one for one in examined(VirtualRig(picked_up))}
    assert findings["recorder", "pickup"].verdict == "fail"
    assert "output 2: -4" in findings["recorder", "pickup"].what
    assert verdicts(examined(VirtualRig(replace(SOUND, lost_signal_v=1e-3))))["recorder", "pickup"] == "ok"


def test_records_of_every_output_count_in_the_time_that_pickup_may_take(monkeypatch):
    limits_s, call = [], CallThread.call
    monkeypatch.setattr(CallThread, "call", lambda thread, ask, s: call(thread, ask, limits_s.append(s) or s))
    examined(VirtualRig(SOUND), {"recorder": {"post_roll_s": 2.0}})
    assert 60.0 + (1 + len(ACTUATORS)) * 2.5 < max(limits_s) < 100.0


@pytest.mark.parametrize(
    ("off_mrad", "verdict", "told"),
    [(0.02, "ok", "read back within 0.020 mrad"), (3.0, "fail", "within 3.000"), (None, "ok", "not read back")],
)
def test_given_a_mirror_that_reads_back_then_it_must_stand_where_it_was_sent(off_mrad, verdict, told):
    mirror, sent_mrad = VirtualRig(SOUND).mirror, [(0.0, 0.0)]

    def move_to(*at_mrad):
        sent_mrad.append(at_mrad)
        mirror.move_to(*at_mrad)

    def where_mrad():
        return None if off_mrad is None else (sent_mrad[-1][0], sent_mrad[-1][1] - off_mrad)

    stating = Stating(mirror, move_to=move_to, where_mrad=where_mrad)
    findings = examined(VirtualRig(SOUND), mirror=lambda: stating, play=False)
    (finding,) = [one for one in findings if one.check == "corners"]
    assert finding.verdict == verdict
    assert told in finding.what


def test_a_driver_that_hangs_or_has_a_defect_is_a_finding_and_is_not_asked_again():
    let_go = threading.Event()
    findings = []
    collected = RigFindings(findings.append)
    assert collected.ask("player", "opening", let_go.wait, 0.05) is None
    assert collected.ask("player", "identity", lambda: "a name", 60.0) is None
    assert collected.ask("mirror", "identity", lambda: "a name", 60.0) == "a name"
    assert collected.ask("recorder", "record", lambda: np.zeros(1)[3], 60.0) is None
    let_go.set()
    assert [(one.instrument, one.verdict) for one in findings] == [
        ("player", "fail"), ("player", "skipped"), ("recorder", "fail"),
    ]  # fmt: skip
    assert "did not come back within 0.05 s" in findings[0].what
    assert findings[2].what.startswith("IndexError: ")
    assert "report" in findings[2].remedy


RATE_HZ = 10_000.0


def opened(device_s, calibrated_s=None):
    """A rig whose file states 5 us, or a calibration another delay, and whose recorder states `device_s`."""
    section = {"actuators": {"position_mm": [[0, 0], [10, 0]]}}
    if calibrated_s is not None:
        inputs = InputsMeasured(at=AT, device="r", identity=None, inter_channel_delay_s=calibrated_s)
        record = measured().model_copy(update={"inputs": inputs}).model_dump()
        section["calibration"] = {"file": "cal.toml", "measured": record}
        section["recorder"] = {"inter_channel_delay_s": calibrated_s}
    rig, bench = RigConfig.model_validate(section), VirtualRig(SOUND)
    recorder = Stating(bench.recorder, sampling_delay_s=lambda _rate_hz: device_s)
    vibrometer = VibrometerReading(0.1, "", None, None, "typed in")
    return wired(rig, bench.mirror, recorder, bench.player, bench.clock, vibrometer), rig


NO_BANK = -1.0


@pytest.mark.parametrize(
    ("begun_s", "device_s", "calibrated_s", "used_s", "is_said"),
    [
        # A calibrated delay counts, else the device's own.
        (NO_BANK, 14e-6, None, 14e-6, True),
        (NO_BANK, 5.2e-6, None, 5e-6, False),
        (NO_BANK, None, None, 5e-6, False),
        (NO_BANK, 14e-6, 13e-6, 13e-6, True),
        (NO_BANK, 0.0, None, 0.0, True),
        # Begun where the recorder stated nothing: what the rig file stated is used to the end.
        (None, None, None, 5e-6, False),
        (None, 5.2e-6, None, 5e-6, False),
        (None, 14e-6, None, 5e-6, True),
        # Begun where it did.
        (14e-6, 14.2e-6, None, 14e-6, True),
        (14e-6, None, None, 14e-6, True),
        (5e-6, 5e-6, None, 5e-6, False),
        # Another recorder, whose rows would be corrected by the wrong delay.
        (14e-6, 5e-6, None, None, False),
        (5e-6, 14e-6, None, None, False),
        # A calibration is part of the plan, which is compared elsewhere.
        (None, 14e-6, 13e-6, 13e-6, True),
    ],
)
def test_which_delay_of_the_inputs_counts_and_a_bank_keeps_its_own_or_is_refused(
    begun_s, device_s, calibrated_s, used_s, is_said, tmp_path, capsys
):
    with ExitStack() as stack:
        writer = None
        if begun_s != NO_BANK:
            path, places = tmp_path / "plate.h5", (np.zeros((2, 2)), np.zeros((2, 2)))
            band_hz = (20.0, 500.0)
            header = BankHeader(RATE_HZ, 8, band_hz, *places, "{}", "{}", "0" * 64, "", inter_channel_delay_s=begun_s)
            create_bank(path, header)
            with open_bank(path, contents=True) as bank:
                assert bank.inter_channel_delay_s == begun_s
            writer = stack.enter_context(BankWriter.open(path))
        if used_s is None:
            with pytest.raises(InputError, match=r"plate\.h5: was begun with a recorder"):
                setup_in_use(*opened(device_s, calibrated_s), RATE_HZ, writer).__enter__()
            return
        with setup_in_use(*opened(device_s, calibrated_s), RATE_HZ, writer) as setup:
            assert setup.inter_channel_delay_s == used_s
    assert bool(capsys.readouterr().err) == is_said
