"""Grids too coarse for neighbours: waves judge each position, or a second measurement confirms it."""

import contextlib
from dataclasses import replace
from shutil import copyfile

import h5py
import numpy as np
import pytest

from tests.lab_files import write_positions
from tests.system.captures import Listener, answered, events_of
from tests.system.lines import Lines
from wavefocus.__main__ import run
from wavefocus.campaign.blueprint import blueprint_from_bank
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter

RIG = """
[rig]
name = "virtual"
[actuators]
position_mm = [[119.0, 0.0], [0.0, 69.0], [-119.0, 0.0], [0.0, -69.0]]
"""
SMALL_RIG = """
[rig]
name = "virtual"
[surface]
kind = "rectangle"
length_mm = 130.0
width_mm = 100.0
[actuators]
position_mm = [[64, 3], [35, 49], [2, 48], [-64, -5], [-37, -49], [4, -48]]
"""
RUN = """
rig = "rig.toml"
[grid]
{grid}
[sweep]
duration_s = 0.3
{sweep}
[capture]
averages = 2
decay_s = 0.1
taps = 1000
excitation = "{schedule}"
[quality]
{quality}
[virtual]
seed = 5
noise_v = {noise_v}
"""


def lab_of(folder, rig, **keys):
    """Write rig and run file into a new folder."""
    folder.mkdir()
    (folder / "rig.toml").write_text(rig, encoding="utf-8")
    values = {"sweep": "", "quality": "", "schedule": "staggered", "noise_v": 5e-5, **keys}
    (folder / "run.toml").write_text(RUN.format(**values), encoding="utf-8")
    return folder / "run.toml"


def planned_looks(run_file, capsys):
    facts = answered(capsys, "plan", run_file)
    return facts["second_looks"], facts["positions"]


FAULTY = (1, 4, 5, 9)


def captured(folder, schedule, records, *, look, level_db=0.0, noise_v=0.0001):
    run_file = lab_of(
        folder, RIG, grid="spacing_mm = 40.0\ncheck_positions = 0", sweep="amplitude_v = 3.0", schedule=schedule,
        quality='second_look = "twice"' if look else "", noise_v=noise_v,
    )  # fmt: skip
    with run_file.open("a", encoding="utf-8") as text:
        for position, record in records.items():
            text.write(
                f'[[virtual.fault_plan]]\nrole = "recorder"\noperation = "read"\nkind = "drift"\n'
                f'level_db = {level_db}\nposition = {position}\nrecord = {record}\ncount = 1\npurpose = "capture"\n'
            )
    assert run(["capture", str(run_file), "--bank", str(folder / "plate.h5")]) == 0
    with h5py.File(folder / "plate.h5", "r") as file:
        return file["green"][...].astype(np.float64), file["status"][...]


def gains(rows, clean):
    """Level of each row over that of another measurement; noise hardly counts."""
    return np.sum(rows * clean, axis=2) / np.sum(clean * clean, axis=2)


@pytest.mark.parametrize(
    ("schedule", "level_db"), [("sequential", -0.5), pytest.param("staggered", -20.0, marks=pytest.mark.nightly)]
)
def test_given_a_coarse_grid_then_a_second_look_replaces_rows_of_another_level(tmp_path, schedule, level_db):
    clean, _ = captured(tmp_path / "clean", schedule, {}, look=False, noise_v=0.0)
    strength = np.linalg.norm(clean, axis=2)
    loudest = {position: int(np.argmax(strength[position])) for position in FAULTY}
    records = loudest if schedule == "sequential" else dict.fromkeys(FAULTY, 0)
    once, status_once = captured(tmp_path / "once", schedule, records, look=False, level_db=level_db)
    twice, status = captured(tmp_path / "twice", schedule, records, look=True, level_db=level_db)
    # What this is for: neighbours see few of them.
    wrong = [abs(gains(once, clean)[position, actuator] - 1.0) > 0.04 for position, actuator in loudest.items()]
    assert any(wrong)
    assert (status_once == 1).all()
    assert (status == 1).all()
    assert gains(twice, clean)[strength > 0.2 * strength.max(axis=1, keepdims=True)] == pytest.approx(1.0, abs=0.02)


# With fewer positions than neighbours all 14 are marked, as planned, before the pass begins.
def test_a_kill_while_positions_are_marked_ends_as_an_undisturbed_bank(tmp_path, capsys):
    captured(tmp_path / "quiet", "staggered", {}, look=True)
    with h5py.File(tmp_path / "quiet" / "plate.h5", "r") as file:
        assert (file["quality/attempts"][...] == 4).all()
        positions = len(file["status"])
    assert planned_looks(tmp_path / "quiet" / "run.toml", capsys) == (positions, positions)
    bank = tmp_path / "killed.h5"
    with Lines("capture", tmp_path / "quiet" / "run.toml", "--bank", bank, "--json") as killed:
        for _ in range(19):
            killed.hear("position_started")
        killed.process.kill()
    with h5py.File(bank, "r", locking=False) as file:
        assert (file["status"][...] != 0).all()
    assert run(["resume", str(bank)]) == 0
    assert bank.read_bytes() == (tmp_path / "quiet" / "plate.h5").read_bytes()


LEVEL, SWAPPED, MOVED, CHECKED = 12, 20, 31, 42


@pytest.fixture(scope="module")
def coarse(tmp_path_factory):
    """A bank of a grid of 14 mm, more than a wavelength at the band's end, as a campaign without faults leaves it."""
    grid = "spacing_mm = 14.0\nmargin_mm = 10.0\ncheck_positions = 4"
    run_file = lab_of(tmp_path_factory.mktemp("coarse") / "lab", SMALL_RIG, grid=grid)
    bank = run_file.with_name("plate.h5")
    assert run(["capture", str(run_file), "--bank", str(bank)]) == 0
    return bank


@pytest.fixture(scope="module")
def spoiled(coarse, tmp_path_factory):
    """The same bank with wrong rows, of a session that was killed before it judged them."""
    blueprint = blueprint_from_bank(coarse)
    plan = blueprint.plan
    lab = tmp_path_factory.mktemp("coarse") / "aside"
    run_file = lab_of(lab, SMALL_RIG, grid='positions_file = "positions.csv"', quality='second_look = "never"')
    write_positions(lab, [plan.position_mm[MOVED] + [2.4, -3.2]])
    assert run(["capture", str(run_file), "--bank", str(lab / "plate.h5")]) == 0
    bank = lab / "spoiled.h5"
    copyfile(coarse, bank)
    with open_bank(lab / "plate.h5") as aside, BankWriter.open(bank, plan_sha256=plan.sha256) as writer:
        rows = {position: writer.green(position) for position in (LEVEL, SWAPPED, CHECKED, int(plan.order[-1]))}
        rows[LEVEL][3] *= 10 ** (7 / 20)
        # Rows 2 and 5 differ by 9 % there, which is no fault that anybody feels.
        rows[SWAPPED][[2, 4]] = rows[SWAPPED][[4, 2]]
        rows[CHECKED] *= 10 ** (-4 / 20)
        rows[MOVED] = aside.green(0)
        for position, row in rows.items():
            writer.commit(position, row, replace(writer.record(position), neighbour_round=0))
    return bank


def test_a_sound_coarse_grid_has_no_second_look_and_none_is_planned(coarse, capsys):
    with h5py.File(coarse, "r") as file:
        assert (file["status"][...] == 1).all()
        assert (file["quality/attempts"][...] == 1).all()
    assert planned_looks(coarse.with_name("run.toml"), capsys)[0] == 0


@pytest.fixture(scope="module")
def mended(spoiled):
    """The bank after an undisturbed session, the events of that, and the bank as it was after the second mark."""
    bank, marked = spoiled.with_name("mended.h5"), spoiled.with_name("marked.h5")
    copyfile(spoiled, bank)
    committed = '"event": "position_committed"'
    listener = Listener((committed, lambda: None), (committed, lambda: copyfile(bank, marked)))
    with contextlib.redirect_stdout(listener):
        assert run(["resume", str(bank), "--json"]) == 0
    return bank, events_of(listener.told), marked


def test_wrong_rows_on_a_coarse_grid_are_named_and_measured_once_more(mended, coarse):
    bank, told, _ = mended
    named = {line["position"]: line["defects"] for line in told if line.get("defects")}
    assert named == {position: ["neighbours"] for position in (LEVEL, SWAPPED, MOVED, CHECKED)}
    assert sorted(line["position"] for line in told if line["event"] == "position_started") == sorted(named)
    with h5py.File(bank, "r") as file, h5py.File(coarse, "r") as right:
        assert (file["status"][...] == 1).all()
        apart = np.linalg.norm(file["green"][...] - right["green"][...], axis=(1, 2))
        assert (apart < 0.01 * np.linalg.norm(right["green"][...], axis=(1, 2))).all()


def test_kills_while_a_coarse_grid_is_judged_end_as_an_undisturbed_bank(mended):
    undisturbed, told, bank = mended
    marks = [line["position"] for line in told if line["event"] == "position_committed"][:2]
    assert set(marks) < {LEVEL, SWAPPED, MOVED, CHECKED}
    with Lines("resume", bank, "--json") as killed:
        for _ in ("marked", "marked", "measured again"):
            killed.hear("position_committed")
        killed.process.kill()
    assert bank.read_bytes() != undisturbed.read_bytes()
    assert run(["resume", str(bank)]) == 0
    assert bank.read_bytes() == undisturbed.read_bytes()
