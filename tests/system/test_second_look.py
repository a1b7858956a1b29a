"""Grids too coarse for neighbours: waves judge each position, or a second measurement confirms it."""

import contextlib
from dataclasses import replace
from shutil import copyfile

import numpy as np
import pytest

from tests.lab_files import RUN, write_positions
from tests.system.captures import Listener, answered, events_of, held, resumed_after_a_kill, wavefocus
from tests.system.conftest import with_faults
from tests.system.lines import Lines
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


def lab_of(folder, rig, *, grid, sweep="", quality="", schedule="staggered", noise_v=5e-5):
    """Write rig and run file into a new folder."""
    folder.mkdir()
    (folder / "rig.toml").write_text(rig, encoding="utf-8")
    text = RUN.replace('positions_file = "positions.csv"', grid).replace('second_look = "never"', quality)
    text = text.replace("duration_s = 0.3", f"duration_s = 0.3\n{sweep}")
    text = text.replace("[capture]", f'[capture]\nexcitation = "{schedule}"')
    text = text.replace("seed = 3\nnoise_v = 1e-4", f"seed = 5\nnoise_v = {noise_v}")
    (folder / "run.toml").write_text(text, encoding="utf-8")
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
    fault = f'role = "recorder"\noperation = "read"\nkind = "drift"\nlevel_db = {level_db}\npurpose = "capture"\n'
    with_faults(folder, *(f"{fault}position = {position}\nrecord = {record}" for position, record in records.items()))
    assert wavefocus("capture", run_file, "--bank", folder / "plate.h5") == 0
    return np.array(held(folder / "plate.h5", "green")), np.array(held(folder / "plate.h5"))


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
    lab = tmp_path / "quiet"
    _, status = captured(lab, "staggered", {}, look=True)
    assert held(lab / "plate.h5", "quality/attempts") == [4] * len(status)
    assert planned_looks(lab / "run.toml", capsys) == (len(status), len(status))
    assert 0 not in resumed_after_a_kill(lab, lab / "killed.h5", *["position_started"] * 19)
    assert (lab / "killed.h5").read_bytes() == (lab / "plate.h5").read_bytes()


LEVEL, SWAPPED, MOVED, CHECKED = 12, 20, 31, 42


@pytest.fixture(scope="module")
def coarse(tmp_path_factory):
    """A bank of a grid of 14 mm, more than a wavelength at the band's end, as a campaign without faults leaves it."""
    grid = "spacing_mm = 14.0\nmargin_mm = 10.0\ncheck_positions = 4"
    run_file = lab_of(tmp_path_factory.mktemp("coarse") / "lab", SMALL_RIG, grid=grid)
    bank = run_file.with_name("plate.h5")
    assert wavefocus("capture", run_file, "--bank", bank) == 0
    return bank


@pytest.fixture(scope="module")
def spoiled(coarse, tmp_path_factory):
    """The same bank with wrong rows, of a session that was killed before it judged them."""
    blueprint = blueprint_from_bank(coarse)
    plan = blueprint.plan
    lab = tmp_path_factory.mktemp("coarse") / "aside"
    run_file = lab_of(lab, SMALL_RIG, grid='positions_file = "positions.csv"', quality='second_look = "never"')
    write_positions(lab, [plan.position_mm[MOVED] + [2.4, -3.2]])
    assert wavefocus("capture", run_file, "--bank", lab / "plate.h5") == 0
    bank = lab / "spoiled.h5"
    copyfile(coarse, bank)
    with open_bank(lab / "plate.h5") as aside, BankWriter.open(bank, plan_sha256=plan.sha256) as writer:
        rows = {position: writer.green(position) for position in (LEVEL, SWAPPED, CHECKED, plan.positions - 1)}
        rows[LEVEL][3] *= 10 ** (7 / 20)
        # Rows 2 and 5 differ by 9 % there, which is no fault that anybody feels.
        rows[SWAPPED][[2, 4]] = rows[SWAPPED][[4, 2]]
        rows[CHECKED] *= 10 ** (-4 / 20)
        rows[MOVED] = aside.green(0)
        for position, row in rows.items():
            writer.commit(position, row, replace(writer.record(position), neighbour_round=0))
    return bank


def test_a_sound_coarse_grid_has_no_second_look_and_none_is_planned(coarse, capsys):
    assert set(held(coarse)) == set(held(coarse, "quality/attempts")) == {1}
    assert planned_looks(coarse.with_name("run.toml"), capsys)[0] == 0


@pytest.fixture(scope="module")
def mended(spoiled):
    """The bank after an undisturbed session, the events of that, and the bank as it was after the second mark."""
    bank, marked = spoiled.with_name("mended.h5"), spoiled.with_name("marked.h5")
    copyfile(spoiled, bank)
    committed = '"event": "position_committed"'
    listener = Listener((committed, lambda: None), (committed, lambda: copyfile(bank, marked)))
    with contextlib.redirect_stdout(listener):
        assert wavefocus("resume", bank, "--json") == 0
    return bank, events_of(listener.told), marked


def test_wrong_rows_on_a_coarse_grid_are_named_and_measured_once_more(mended, coarse):
    bank, told, _ = mended
    named = {line["position"]: line["defects"] for line in told if line.get("defects")}
    assert named == {position: ["neighbours"] for position in (LEVEL, SWAPPED, MOVED, CHECKED)}
    assert sorted(line["position"] for line in told if line["event"] == "position_started") == sorted(named)
    assert set(held(bank)) == {1}
    green, right = (np.array(held(one, "green")) for one in (bank, coarse))
    assert (np.linalg.norm(green - right, axis=(1, 2)) < 0.01 * np.linalg.norm(right, axis=(1, 2))).all()


def test_kills_while_a_coarse_grid_is_judged_end_as_an_undisturbed_bank(mended):
    undisturbed, told, bank = mended
    marks = [line["position"] for line in told if line["event"] == "position_committed"][:2]
    assert set(marks) < {LEVEL, SWAPPED, MOVED, CHECKED}
    with Lines("resume", bank, "--json") as killed:
        for _ in ("marked", "marked", "measured again"):
            killed.hear("position_committed")
        killed.process.kill()
    assert bank.read_bytes() != undisturbed.read_bytes()
    assert wavefocus("resume", bank) == 0
    assert bank.read_bytes() == undisturbed.read_bytes()
