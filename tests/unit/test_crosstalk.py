"""Crosstalk: what of the loopback leaks into the response input, on virtual rigs and in the estimator."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from wavefocus.acquisition.crosstalk_watch import CrosstalkWatch
from wavefocus.acquisition.doctor import crosstalk_alone
from wavefocus.acquisition.setup import Setup
from wavefocus.calibration.check import check_bank
from wavefocus.calibration.crosstalk import Crosstalk, crosstalk_of_record, crosstalk_of_rows
from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.campaign.blueprint import blueprint_of
from wavefocus.campaign.sidecar_files import last_events, read_crosstalk
from wavefocus.config.messages.campaign import CrosstalkMeasured
from wavefocus.drivers.protocols import RecordLabel, RecordRequest
from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.mocks.wire.emulated_rig import WireBench
from wavefocus.rendering.verify.leak import crosstalk_symptom, with_crosstalk
from wavefocus.rendering.verify.results import CERTAIN_SHARE, Symptom
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.ledger import PointRecord
from wavefocus.storage.bank.reading import Bank
from wavefocus.storage.bank.writer import BankWriter, create_bank
from wavefocus.storage.point_status import Status
from wavefocus.virtual import virtual_rig

RATE_HZ = 10_000.0
PER_VOLT = 0.125
RUN = {"capture": {"averages": 1}, "quality": {"remeasure_pass": 0}, "drift": {"every_positions": 10_000}}
QUIET = VirtualSettings(
    noise_v=0.0, reference_noise_v=0.0, clock_ppm=0.0, inter_channel_delay_s=0.0, dropout_probability=0.0,
    lost_signal_v=0.0,
)  # fmt: skip


def recorded(settings: VirtualSettings) -> np.ndarray:
    """Both inputs while the loopback alone plays noise, the beam parked."""
    rig = VirtualRig(settings).instruments
    signal_v = 0.5 * np.random.default_rng(1).standard_normal(4000).clip(-2, 2)
    rig.recorder.start(RecordRequest(6000, RATE_HZ, (5.0, 0.2), RecordLabel(0, 1, 0, "test")))
    rig.player.play({settings.channel_of_loopback: signal_v}, RATE_HZ)
    rig.player.wait(5.0)
    return rig.recorder.read(5.0).volts


def test_share_of_the_loopback_comes_late_at_the_response_input() -> None:
    reference_v, response_v = recorded(replace(QUIET, crosstalk=0.05, crosstalk_delay_s=0.0003))
    lagged = np.array([reference_v[: 5900 - lag] @ response_v[lag:5900] for lag in range(10)])
    assert int(np.argmax(lagged)) == 3
    assert lagged[3] / (reference_v @ reference_v) == pytest.approx(0.05, rel=1e-3)


def silent_record(share: float, delay_s: float, noise_v: float, seed: int = 0) -> Crosstalk:
    """A sweep on the loopback, noise and a leak on the response, measured."""
    draw = np.random.default_rng(seed)
    time_s = np.arange(6000) / RATE_HZ
    sweep = np.where(time_s < 0.5, np.sin(2 * np.pi * (40 + 360 * time_s) * time_s), 0.0)
    spectrum = np.fft.rfft(sweep) * np.exp(-2j * np.pi * np.fft.rfftfreq(6000, 1 / RATE_HZ) * delay_s)
    response = share * np.fft.irfft(spectrum, 6000) + noise_v * draw.standard_normal(6000)
    return crosstalk_of_record(sweep, response, RATE_HZ, (40.0, 400.0))


@pytest.mark.parametrize(("share", "delay_s"), [(1e-4, 0.0), (-1e-3, 2.3e-4), (1e-2, 4e-3)])
def test_leak_in_a_record_without_a_response_is_measured_with_its_delay(share: float, delay_s: float) -> None:
    found = silent_record(share, delay_s, 1.5e-4)
    assert found.is_named
    assert found.share == pytest.approx(share, abs=4 * found.error)
    assert found.delay_s == pytest.approx(delay_s, abs=3e-5)


def test_records_without_a_leak_name_none_and_loud_ones_resolve_none() -> None:
    assert not any(silent_record(0.0, 0.0, 1.5e-4, seed).is_named for seed in range(100))
    quiet, loud = silent_record(0.0, 0.0, 1.5e-4), silent_record(1e-4, 0.0, 1.0)
    assert quiet.is_resolved
    assert not loud.is_resolved
    assert not loud.is_named


PLATES = {"gel": {}, "glass": {"plate": "thin", "edge": "infinite"}}


@pytest.fixture(scope="module")
def banks(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, float], Bank]:
    """Banks of some 60 positions and 4 actuators, each measured once."""

    @cache
    def measured(plate: str, share: float) -> Bank:
        keys = {**PLATES[plate], "crosstalk": share}
        rig = virtual_rig(actuators=4, spacing_mm=20.0, run={**RUN, "virtual": keys})
        return rig.measure(tmp_path_factory.mktemp("bank") / "plate.h5")

    return measured


def found_in(bank: Bank, added: float = 0.0) -> Crosstalk | None:
    """What the rows of a bank show, once another pulse is in them."""
    green = np.stack([bank.green(position) for position in range(bank.positions)]).astype(np.float64)
    green[:, :, 0] += added * PER_VOLT
    return crosstalk_of_rows(green, bank.position_mm, bank.actuator_mm, RATE_HZ, (20.0, 500.0), PER_VOLT)


@pytest.mark.parametrize("plate", list(PLATES))
def test_leak_in_rows_is_named_on_every_plate(banks: Callable[[str, float], Bank], plate: str) -> None:
    found = found_in(banks(plate, 1e-4))
    assert found is not None
    assert found.is_named
    # On glass without an edge, whose waves have no front, the level reads up to some decibels high.
    assert found.share == pytest.approx(1e-4, rel=0.2 if plate == "gel" else 0.6)
    assert found.delay_s == pytest.approx(0.0, abs=2.5e-4)
    assert found.actuators == ()


@pytest.mark.parametrize("plate", list(PLATES))
def test_rows_without_a_leak_name_none(banks: Callable[[str, float], Bank], plate: str) -> None:
    found = found_in(banks(plate, 0.0))
    assert found is not None
    assert not found.is_named


def test_campaign_marks_all_positions_of_a_leak_as_poor_and_keeps_its_level(
    banks: Callable[[str, float], Bank],
) -> None:
    bank = banks("gel", 1e-4)
    assert set(bank.status.tolist()) == {int(Status.POOR_SIGNAL)}
    leak = read_crosstalk(bank.path)
    assert leak is not None
    assert leak.level_db == pytest.approx(-80.0, abs=1.5)
    assert len(leak.marked) >= bank.positions - 2  # speckle has made the others poor


def test_campaign_without_a_leak_stays_valid_and_says_that_it_looked(banks: Callable[[str, float], Bank]) -> None:
    bank = banks("gel", 0.0)
    assert np.count_nonzero(bank.status == Status.VALID) >= bank.positions - 2
    looked = [one.event for one in last_events(bank.path) if isinstance(one.event, CrosstalkMeasured)]
    assert [one.named for one in looked] == [False]
    assert read_crosstalk(bank.path) is None


def test_leak_that_begins_in_mid_campaign_marks_the_latest_positions_and_judges_the_next_while_it_lasts(
    banks: Callable[[str, float], Bank], tmp_path: Path
) -> None:
    clean, leaking = banks("gel", 0.0), banks("gel", 1e-4)
    half = clean.positions
    places = np.concatenate([clean.position_mm, clean.position_mm + 0.5])
    plan = blueprint_of(virtual_rig(actuators=4, position_mm=places, run=RUN).configuration).plan
    instruments = VirtualRig().instruments
    setup = Setup(instruments, MirrorMap.straight(1000.0), (0, 1, 2, 3), 4, (10.0, 10.0), PER_VOLT)
    unknown, path = np.full((4, 2), np.nan), tmp_path / "plate.h5"
    create_bank(path, BankHeader(RATE_HZ, clean.taps, (20.0, 500.0), places, unknown, "{}", "{}", "ab" * 32, "test"))
    figures = np.ones(4, np.float32)
    with BankWriter.open(path) as bank:
        watch = CrosstalkWatch(plan, setup, bank)
        seen = []
        for source, first in ((clean, 0), (leaking, half), (clean, 0)):
            for position in range(half):
                row = np.asarray(source.green(position), np.float32)
                bank.commit(first + position, row, PointRecord(1, 1, figures, figures, figures, figures))
                watch.committed(first + position)
            found, marked = watch.look()
            seen.append((found is not None and found.is_named, watch.found is not None, marked[-half:]))
    assert seen[0] == (False, False, ())
    assert seen[1] == (True, True, tuple(range(half, 2 * half)))
    assert seen[2][:2] == (False, False)


def test_leak_that_the_first_positions_are_too_few_to_show_marks_them_too_when_it_is_found(
    banks: Callable[[str, float], Bank], tmp_path: Path
) -> None:
    leaking, path = banks("gel", 1e-4), tmp_path / "plate.h5"
    places, few = leaking.position_mm, 5
    plan = blueprint_of(virtual_rig(actuators=4, position_mm=places, run=RUN).configuration).plan
    setup = Setup(VirtualRig().instruments, MirrorMap.straight(1000.0), (0, 1, 2, 3), 4, (10.0, 10.0), PER_VOLT)
    unknown, figures = np.full((4, 2), np.nan), np.ones(4, np.float32)
    create_bank(path, BankHeader(RATE_HZ, leaking.taps, (20.0, 500.0), places, unknown, "{}", "{}", "ab" * 32, "test"))
    with BankWriter.open(path) as bank:
        watch = CrosstalkWatch(plan, setup, bank)
        marks = []
        for positions in (range(few), range(few, leaking.positions)):
            for position in positions:
                row = np.asarray(leaking.green(position), np.float32)
                bank.commit(position, row, PointRecord(1, 1, figures, figures, figures, figures))
                watch.committed(position)
            marks.append(set(watch.look()[1]))
    assert marks == [set(), set(range(leaking.positions))]


def test_check_calls_a_bank_with_a_leak_wrong_and_one_without_it_right(banks: Callable[[str, float], Bank]) -> None:
    named = [one for one in check_bank(banks("gel", 1e-4).path) if one.severity == "error"]
    assert [one.message.split(":")[0] for one in named] == ["crosstalk"]
    assert [one for one in check_bank(banks("gel", 0.0).path) if one.severity == "error"] == []


def test_pulse_of_one_sample_in_another_programs_rows_is_named(banks: Callable[[str, float], Bank]) -> None:
    found = found_in(banks("gel", 0.0), 1e-3)
    assert found is not None
    assert found.is_named


def test_leak_in_the_rows_of_one_actuator_is_named_with_it_as_that_of_a_staggered_campaign() -> None:
    draw = np.random.default_rng(4)
    places = draw.uniform(-50.0, 50.0, (200, 2))
    corners = np.array([[-90.0, -50.0], [90.0, -50.0], [90.0, 50.0], [-90.0, 50.0]])
    rows = 1e-4 * draw.standard_normal((200, 4, 1000))
    rows[:, 1, 0] += 1e-3
    found = crosstalk_of_rows(rows, places, corners, RATE_HZ, (20.0, 500.0), 1.0)
    assert found is not None
    assert found.is_named
    assert found.actuators == (1,)


def test_rows_of_actuators_at_unknown_places_are_not_judged() -> None:
    places = np.zeros((100, 2))
    rows = np.ones((100, 4, 1000))
    assert crosstalk_of_rows(rows, places, np.full((4, 2), np.nan), RATE_HZ, (20.0, 500.0), 1.0) is None


@pytest.mark.parametrize(("noise", "certain"), [(1e-4, True), (1.0, False)])
def test_leak_is_a_certain_symptom_only_where_it_explains_enough_of_the_excess(noise: float, certain: bool) -> None:
    draw = np.random.default_rng(5)
    hertz, positions = np.linspace(40.0, 400.0, 60), 20
    marker_v = draw.standard_normal(2000)
    leak = 1e-3 * np.exp(-2j * np.pi * np.outer(hertz, np.arange(2000) / RATE_HZ + 2e-4)) @ marker_v
    predicted = draw.standard_normal((positions, 60)) + 0j
    scanned = predicted + leak + noise * draw.standard_normal((positions, 60))
    spectra = SimpleNamespace(
        frequency_hz=hertz,
        drive=draw.standard_normal((4, 60)) + 0j,
        predicted=predicted,
        scanned=scanned,
        noise=np.full(positions, np.nan),
    )
    fields = SimpleNamespace(spectra=spectra, sample_rate_hz=RATE_HZ)
    symptom = crosstalk_symptom(Crosstalk(1e-3, 2e-4, 1e-6), fields, marker_v)
    assert (symptom.code, symptom.certain, symptom.delay_s) == ("crosstalk", certain, 2e-4)
    assert symptom.value == pytest.approx(-60.0)
    assert (symptom.explained >= CERTAIN_SHARE) is certain
    guess = Symptom("unexplained", explained=0.0, certain=False)
    assert with_crosstalk((guess,), symptom) == ((symptom,) if certain else (guess, symptom))


class LoopbackAudio:
    """An audio interface whose loopback output plays noise for 0.4 s from frame 0 on, and nothing else."""

    rate_hz = 48_000

    def __init__(self, channels: int) -> None:
        self._frames = np.zeros((channels, 19_200), dtype=np.float32)
        self._frames[-1] = 0.2 * np.random.default_rng(6).standard_normal(19_200).clip(-2, 2)

    def frame_at(self, instant_ns: int) -> float:
        return (instant_ns - 1e9) * self.rate_hz / 1e9

    def read(self, first: int, stop: int) -> np.ndarray:
        found = np.zeros((len(self._frames), stop - first), dtype=np.float32)
        inside = np.arange(max(first, 0), min(stop, self._frames.shape[1]))
        found[:, inside - first] = self._frames[:, inside]
        return found


def test_emulated_wires_leak_as_the_virtual_rig_does() -> None:
    settings = replace(QUIET, crosstalk=1e-3, crosstalk_delay_s=3e-4, actuator_mm=((0.0, 50.0),))
    motion = MirrorMotion(settings.park_mrad, settings.settle_s, settings.slew_mrad_s, settings.limit_mrad)
    bench = WireBench(settings, LoopbackAudio(2), motion, full_scale_v=(5.0, 5.0))
    reference_v, response_v = bench.record(900_000_000, 6000, RATE_HZ, ("ai0", "ai1"), 7e-6)
    found = crosstalk_of_record(reference_v, response_v, RATE_HZ, (40.0, 400.0), inter_channel_delay_s=7e-6)
    assert found.share == pytest.approx(1e-3, rel=0.01)
    assert found.delay_s == pytest.approx(3e-4, abs=2e-6)


def test_leak_is_measured_with_the_loopback_alone_whatever_the_wiring() -> None:
    settings = VirtualSettings(crosstalk=2e-4, crosstalk_delay_s=1e-4, inter_channel_delay_s=2e-5)
    rig = VirtualRig(settings)
    setup = Setup(
        rig.instruments, MirrorMap.straight(1000.0), settings.channel_of_actuator, settings.channel_of_loopback,
        (10.0, 10.0), PER_VOLT, inter_channel_delay_s=2e-5,
    )  # fmt: skip
    found = crosstalk_alone(setup, (0.0, 0.0), 1.0, RATE_HZ)
    assert found.is_named
    assert found.share == pytest.approx(2e-4, abs=4 * found.error)
    assert found.delay_s == pytest.approx(1e-4, abs=5e-5)
