"""Crosstalk: what of the loopback leaks into the response input, on virtual rigs and in the estimator."""

from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest

from tests.lab_files import setup_of
from wavefocus.acquisition.engine.session import Session, StopRequest
from wavefocus.acquisition.engine.station import Station
from wavefocus.acquisition.leak import LeakWatch
from wavefocus.calibration.check import check_bank
from wavefocus.calibration.crosstalk import NONE_DB, Crosstalk, crosstalk_of_record
from wavefocus.calibration.evidence import CERTAIN_SHARE
from wavefocus.campaign.blueprint import blueprint_of
from wavefocus.campaign.sidecar_files import last_events
from wavefocus.config.messages.campaign import CrosstalkMeasured
from wavefocus.estimation import estimate
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.rendering.verify.results import Symptom
from wavefocus.rendering.verify.symptoms import crosstalk_symptom, with_crosstalk
from wavefocus.storage.bank.ledger import PointRecord, Status
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter, create_bank
from wavefocus.storage.raw.writer import open_raw
from wavefocus.virtual import virtual_rig

RATE_HZ = 10_000.0
PER_VOLT = 0.125
POSITION_MM = [(0.0, 0.0), (40.0, 0.0), (0.0, 40.0)]
RUN = {"capture": {"averages": 1}, "quality": {"remeasure_pass": 0}, "drift": {"every_positions": 10_000}}


def silent_record(share, delay_s, noise_v, seed=0):
    """A sweep on the loopback, noise and a leak on the response, measured."""
    draw = np.random.default_rng(seed)
    time_s = np.arange(6000) / RATE_HZ
    sweep = np.where(time_s < 0.5, np.sin(2 * np.pi * (40 + 360 * time_s) * time_s), 0.0)
    spectrum = np.fft.rfft(sweep) * np.exp(-2j * np.pi * np.fft.rfftfreq(6000, 1 / RATE_HZ) * delay_s)
    response = share * np.fft.irfft(spectrum, 6000) + noise_v * draw.standard_normal(6000)
    return crosstalk_of_record(sweep, response, RATE_HZ, (40.0, 400.0))


@pytest.mark.parametrize(("share", "delay_s"), [(1e-4, 0.0), (-1e-3, 2.3e-4), (1e-2, 4e-3), (-1e-3, 0.0193)])
def test_leak_in_a_record_without_a_response_is_measured_with_its_delay(share, delay_s):
    found = silent_record(share, delay_s, 1.5e-4)
    assert found.reaches(1e-4)
    assert found.share == pytest.approx(share, abs=4 * found.error)
    assert found.delay_s == pytest.approx(delay_s, abs=3e-5)


def test_records_without_a_leak_name_none_and_loud_ones_resolve_none():
    assert not any(silent_record(0.0, 0.0, 1.5e-4, seed).is_seen for seed in range(100))
    quiet, loud = silent_record(0.0, 0.0, 1.5e-4), silent_record(1e-4, 0.0, 1.0)
    assert quiet.resolves(1e-4)
    assert not loud.resolves(1e-4)
    assert not loud.is_seen


def measured(path, share, delay_s=0.0, **run):
    """A campaign of some positions on the soft plate, with a leak."""
    keys = {"crosstalk": share, "crosstalk_delay_s": delay_s, "seed": 3}
    rig = virtual_rig(actuators=3, position_mm=POSITION_MM, run={**RUN, **run, "virtual": keys})
    return rig.measure(path)


def looks(bank):
    """All looks at the leak, oldest first."""
    found = [one.event for one in last_events(bank.path) if isinstance(one.event, CrosstalkMeasured)]
    return found[::-1]


@pytest.fixture(scope="module")
def clean(tmp_path_factory):
    return measured(tmp_path_factory.mktemp("bank") / "plate.h5", 0.0)


def one_percent(bank):
    """Share of the loopback that makes 1 % of a bank's median row."""
    return 0.01 * float(np.median(bank.rms)) * np.sqrt(bank.taps) / (PER_VOLT * np.sqrt(2 * 480 / RATE_HZ))


@pytest.mark.parametrize(("times", "delay_s"), [(-1.0, 0.0), pytest.param(3.0, 0.004, marks=pytest.mark.long)])
def test_a_leak_from_one_percent_of_the_median_row_is_named_and_marks_all(clean, tmp_path, times, delay_s):
    share = times * one_percent(clean)
    bank = measured(tmp_path / "plate.h5", share, delay_s)
    last = looks(bank)[-1]
    assert last.named
    assert last.level_db == pytest.approx(20 * np.log10(abs(share)), abs=1.0)
    assert last.share * share > 0
    assert last.delay_s == pytest.approx(delay_s, abs=1 / RATE_HZ)
    assert not np.any(bank.status == Status.VALID)
    assert bank.quality["leak_db"] == pytest.approx(last.level_db, abs=0.1)


def test_a_campaign_without_a_leak_names_none_and_says_that_it_looked(clean):
    assert [one.named for one in looks(clean)] == [False, False]
    assert set(clean.quality["leak_db"][clean.status > 0].tolist()) == {NONE_DB}


class LeakingSetup:
    """A bank, and looks at leaks of any share into it."""

    def __init__(self, path, worker):
        rig, self.path, self.worker = virtual_rig(actuators=4, spacing_mm=60.0, run=RUN), path, worker
        blueprint = blueprint_of(rig.configuration)
        create_bank(path, blueprint.bank_header())
        self.bank, self.plan, self.done = BankWriter.open(path), blueprint.plan, 0
        self.events = []

    def watch(self, share, unvouched=()):
        settings = VirtualSettings(crosstalk=share, actuator_mm=tuple(map(tuple, self.plan.actuator_mm.tolist())))
        setup = setup_of(VirtualRig(settings))
        session = Session(setup.clock, self.events.append, StopRequest())
        return LeakWatch(Station(self.plan, setup, session), self.bank, unvouched)

    def commit(self, watch, count):
        """Commit rows as loud as 100 times 1e-4 of the loopback."""
        rows, figures = np.zeros((4, self.plan.taps), np.float32), np.ones(4, np.float32)
        rows[:, 5] = 1e-2 * PER_VOLT * np.sqrt(2 * 480 / RATE_HZ)
        for position in range(self.done, self.done + count):
            record = PointRecord(1, 1, figures, figures, figures, figures, leak_db=watch.level_db)
            self.bank.commit(position, rows, record)
            watch.committed(position)
        self.done += count


@pytest.fixture
def bench(tmp_path):
    with ThreadPoolExecutor(1) as worker:
        made = LeakingSetup(tmp_path / "plate.h5", worker)
        yield made
        made.bank.close()


def test_leak_that_begins_between_two_looks_marks_what_came_since_the_clean_one(bench):
    before, after, over = bench.watch(0.0), bench.watch(1e-3), bench.watch(0.0, unvouched=(3, 4))
    before.look(bench.worker)
    bench.commit(before, 3)
    assert before.look(bench.worker) == ()
    bench.commit(after, 2)
    assert after.look(bench.worker) == (3, 4)
    assert after.found is not None
    assert over.look(bench.worker) == ()
    assert over.found is None
    assert bench.bank.status[:5].tolist() == [1, 1, 1, 4, 4]
    assert bench.bank.record(4).leak_db == pytest.approx(-60.0, abs=0.5)
    assert [one.marked for one in bench.events] == [(), (), (3, 4), ()]
    assert "10 % of the median row" in bench.events[2].reason


@pytest.mark.parametrize(("share", "marked"), [(1e-3, (0, 1)), (3.3e-5, ())], ids=["10 %", "a third of a percent"])
def test_leak_at_the_beginning_is_judged_once_there_are_rows(bench, share, marked):
    watch = bench.watch(share)
    assert watch.look(bench.worker) == ()
    assert watch.found is None
    bench.commit(watch, 2)
    assert watch.look(bench.worker) == marked
    assert [one.named for one in bench.events] == [False, bool(marked)]
    assert bench.events[-1].level_db == pytest.approx(20 * np.log10(share), abs=2.0)
    assert bench.bank.status[:2].tolist() == ([4, 4] if marked else [1, 1])


@pytest.mark.long
def test_kept_recordings_have_the_level_and_estimate_keeps_it(clean, tmp_path):
    bank = measured(tmp_path / "plate.h5", 5 * one_percent(clean), capture={"averages": 1, "keep_raw": True})
    again = tmp_path / "again.h5"
    with open_raw(tmp_path / "plate.raw.h5") as raw:
        assert np.allclose(raw.leak_db, bank.quality["leak_db"], atol=0.01)
    estimate(tmp_path / "plate.raw.h5", again, workers=1)
    with open_bank(again) as estimated:
        assert not np.any(estimated.status == Status.VALID)
        assert np.allclose(estimated.quality["leak_db"], bank.quality["leak_db"], atol=0.01)


def test_check_calls_valid_rows_with_a_leak_wrong_and_others_right(bench):
    watch = bench.watch(0.0)
    watch.look(bench.worker)
    bench.commit(watch, 4)
    bench.bank.amend(1, leak_db=-40.0)
    bench.bank.close()
    named = [one for one in check_bank(bench.path) if one.message.startswith("crosstalk")]
    assert [(one.position, one.severity) for one in named] == [(1, "error")]
    assert "positions 1 were" in named[0].message


@pytest.mark.parametrize(("noise", "certain"), [(1e-4, True), (1.0, False)])
def test_leak_is_a_certain_symptom_only_where_it_explains_enough_of_the_excess(noise, certain):
    draw = np.random.default_rng(5)
    hertz, positions = np.linspace(40.0, 400.0, 60), 20
    marker_v = draw.standard_normal(2000)
    leak = 1e-3 * np.exp(-2j * np.pi * np.outer(hertz, np.arange(2000) / RATE_HZ + 2e-4)) @ marker_v
    predicted = draw.standard_normal((positions, 60)) + 0j
    scanned = predicted + leak + noise * draw.standard_normal((positions, 60))
    drive, unknown = draw.standard_normal((4, 60)) + 0j, np.full(positions, np.nan)
    spectra = SimpleNamespace(frequency_hz=hertz, drive=drive, predicted=predicted, scanned=scanned, noise=unknown)
    fields = SimpleNamespace(spectra=spectra, sample_rate_hz=RATE_HZ)
    symptom = crosstalk_symptom(Crosstalk(1e-3, 2e-4, 1e-6), fields, marker_v)
    assert (symptom.code, symptom.certain, symptom.delay_s) == ("crosstalk", certain, 2e-4)
    assert symptom.value == pytest.approx(-60.0)
    assert (symptom.explained >= CERTAIN_SHARE) is certain
    guess = Symptom("unexplained", explained=0.0, certain=False)
    assert with_crosstalk((guess,), symptom) == ((symptom,) if certain else (guess, symptom))
