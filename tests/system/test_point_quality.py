"""Point quality in a campaign: what is wrong is named, tried again in the right way, and never called valid."""

import h5py
import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import answered, captured, held, wavefocus
from tests.system.conftest import add_to_rig, with_faults
from tests.system.lines import Lines
from wavefocus.campaign.blueprint import blueprint_from_bank
from wavefocus.rendering.verify.extra_measurements import drift_of, measure_sentinel
from wavefocus.rig.setup import open_setup
from wavefocus.storage.bank.reading import open_bank

READ = 'role = "recorder"\noperation = "read"\n'


FAULTS = (
    f'{READ}kind = "dropout"\nposition = 1\ncount = 3',
    f'{READ}kind = "clipped"\nlevel_db = -0.45\nposition = 2\nrecord = 1\ncount = 99',
    f'{READ}kind = "dark"\nposition = 3\ncount = 99\nspot_mm = [8.0, 4.0, 0.05]',
    f'{READ}kind = "hum"\nlevel_db = -30.0\nposition = 4\ncount = 1',
    f'{READ}kind = "dropout"\nposition = 5\nrecord = 1\nattempt = 1\ncount = 2',
)
BLIND, CLIPPED, DARK, HUM, BLINK = range(1, 6)


def _of(told, kind, position):
    return [event for event in told.of(kind) if event["position"] == position]


def test_faults_are_named_tried_again_in_the_right_way_and_what_stays_is_not_valid(lab, capsys):
    with_faults(lab, *FAULTS)
    bank, told = lab / "plate.h5", captured(capsys, lab)
    assert held(bank) == [1, 1, 2, 1, 1, 1]
    assert held(bank, "quality/attempts")[:5] == [1, 4, 6, 2, 4]

    committed, *_ = _of(told, "position_committed", CLIPPED)
    assert committed["defects"] == ["clipping"]
    assert "amplitude" in str(committed["reason"])
    assert "1 of 6 positions are not valid: 2;" in told.last
    assert f"wavefocus remeasure {bank}" in told.last

    (repeated,), (committed,) = (_of(told, f"position_{what}", DARK) for what in ("repeated", "committed"))
    assert np.hypot(*repeated["moved_mm"]) == pytest.approx(0.1)
    assert committed["moved_mm"] == repeated["moved_mm"]
    assert "0.1 mm aside" in told.err
    assert [event["moved_mm"] != [0.0, 0.0] for event in _of(told, "position_repeated", BLINK)] == [False, True]
    assert held(bank, "quality/moved_mm") == pytest.approx([0.0, 0.0, 0.0, 0.1, 0.0, 0.1])
    assert answered(capsys, "status", bank)["moved_positions"] == f"{DARK},{BLINK}"
    assert {DARK, BLINK} <= {one["position"] for one in answered(capsys, "check", bank)["findings"]}

    # What stayed poor is measured again at the end, and only once.
    assert [event["positions"] for event in told.of("pass_started")] == [[BLIND, CLIPPED, HUM]]
    order = [event["position"] for event in told.of("position_committed")]
    assert (sorted(order[:6]), order[6:]) == ([0, 1, 2, 3, 4, 5], [BLIND, HUM])
    assert [event["position"] for event in told.of("position_kept")] == [CLIPPED]
    before = bank.read_bytes()
    assert wavefocus("capture", lab / "run.toml", "--bank", bank) == 0
    assert bank.read_bytes() == before

    for position, attempt in ((BLIND, 2), (HUM, 4)):  # in a round, and in the pass at the end
        bank.unlink()
        with Lines("capture", lab / "run.toml", "--bank", bank, "--json") as killed:
            while (begun := killed.hear("position_started"))["position"] != position or begun["attempt"] != attempt:
                pass
            killed.process.kill()
        assert wavefocus("resume", bank) == 0
        assert bank.read_bytes() == before


def test_given_a_dark_spot_at_the_sentinel_then_it_is_looked_at_aside_and_is_steady(lab, capsys):
    change_text(lab / "run.toml", "[quality]", "[quality]\nspeckle_step_mm = 0.1234")
    with_faults(lab, f'{READ}kind = "dark"\nposition = 0\ncount = 99\nspot_mm = [0.0, 0.0, 0.05]')
    told = captured(capsys, lab)
    assert held(lab / "plate.h5", "quality/moved_mm")[:2] == pytest.approx([0.123, 0.0])  # in whole micrometres
    assert {one["verdict"] for one in told.of("drift")} == {"steady"}
    made = blueprint_from_bank(lab / "plate.h5")
    with open_bank(lab / "plate.h5") as bank, open_setup(made.configuration.rig, made.configuration.run) as setup:
        sentinel = measure_sentinel(made.plan, setup, bank)  # as `wavefocus verify` does
        assert drift_of(sentinel, bank, made.plan.drift).level_db == pytest.approx(0.0, abs=0.1)


def test_given_a_sentinel_that_needs_a_larger_range_then_it_is_looked_at_with_it(lab, bank, capsys):
    low_v = 0.4 * max(held(bank, "quality/peak_v")[0])
    bank.unlink()
    add_to_rig(lab, f"\n[recorder]\nresponse_range_v = {low_v}\nresponse_ranges_v = [{low_v}, 10.0]\n")
    assert {one["verdict"] for one in captured(capsys, lab).of("drift")} == {"steady"}


def test_given_a_response_over_the_range_then_the_next_larger_one_makes_it_valid(lab, capsys):
    bank = lab / "plate.h5"
    captured(capsys, lab)
    with h5py.File(bank, "r") as file:
        peak_v = file["quality/peak_v"][:].max(axis=1)
        green = file["green"][:]
    low_v = float(np.sort(peak_v)[-2:].mean())  # the loudest position alone is over it
    bank.unlink()
    add_to_rig(lab, f"\n[recorder]\nresponse_range_v = {low_v}\nresponse_ranges_v = [{low_v}, {2 * low_v}, 10.0]\n")
    told = captured(capsys, lab)
    loudest = int(np.argmax(peak_v))
    repeated = told.of("position_repeated")
    assert [(event["position"], event["defects"][0]) for event in repeated] == [(loudest, "over-range")]
    assert repeated[0]["response_range_v"] == pytest.approx(2 * low_v)
    committed = {event["position"]: event for event in told.of("position_committed")}
    assert committed[loudest]["response_range_v"] == pytest.approx(2 * low_v)
    assert committed[(loudest + 1) % 6]["response_range_v"] is None
    assert held(bank) == [1] * 6
    with h5py.File(bank, "r") as file:
        error = np.linalg.norm(file["green"][loudest] - green[loudest]) / np.linalg.norm(green[loudest])
    assert error < 2e-2  # the noise of both


def test_given_no_passes_in_the_run_file_then_none_comes(lab, capsys):
    change_text(lab / "run.toml", "[quality]", "[quality]\nremeasure_pass = 0")
    with_faults(lab, f'{READ}kind = "dropout"\nposition = 1\ncount = 3')
    assert not captured(capsys, lab).of("pass_started")
    assert held(lab / "plate.h5") == [1, 4, 1, 1, 1, 1]
