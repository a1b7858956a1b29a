"""Point quality in a campaign: what is wrong is named, tried again in the right way, and never called valid."""

import h5py
import numpy as np
import pytest

from tests.lab_files import change_text
from tests.system.captures import answered, events_of, held, of_kind, wavefocus
from tests.system.conftest import with_faults
from tests.system.lines import Lines

READ = 'role = "recorder"\noperation = "read"\n'


FAULTS = (
    f'{READ}kind = "dropout"\nposition = 1\ncount = 3',
    f'{READ}kind = "clipped"\nlevel_db = -0.45\nposition = 2\nrecord = 1\ncount = 99',
    f'{READ}kind = "dark"\nposition = 3\ncount = 99\nspot_mm = [8.0, 4.0, 0.05]',
    f'{READ}kind = "hum"\nlevel_db = -30.0\nposition = 4\ncount = 1',
    f'{READ}kind = "dropout"\nposition = 5\nrecord = 1\nattempt = 1\ncount = 2',
)
BLIND, CLIPPED, DARK, HUM, BLINK = range(1, 6)


def _captured(lab, capsys):
    """A bank, what was told in events and what was told to people."""
    bank = lab / "plate.h5"
    assert wavefocus("capture", lab / "run.toml", "--bank", bank, "--json") == 0
    told = capsys.readouterr()
    return bank, events_of(told.out), told.err


def _of(events, kind, position):
    return [event for event in of_kind(events, kind) if event["position"] == position]


def test_faults_are_named_tried_again_in_the_right_way_and_what_stays_is_not_valid(lab, capsys):
    with_faults(lab, *FAULTS)
    bank, events, told = _captured(lab, capsys)
    assert held(bank) == [1, 1, 2, 1, 1, 1]
    assert held(bank, "quality/attempts")[:5] == [1, 4, 6, 2, 4]

    committed, *_ = _of(events, "position_committed", CLIPPED)
    assert committed["defects"] == ["clipping"]
    assert "amplitude" in str(committed["reason"])
    last = told.splitlines()[-1]
    assert "1 of 6 positions are not valid: 2;" in last
    assert f"wavefocus remeasure {bank}" in last

    (repeated,), (committed,) = (_of(events, f"position_{what}", DARK) for what in ("repeated", "committed"))
    assert np.hypot(*repeated["moved_mm"]) == pytest.approx(0.1)
    assert committed["moved_mm"] == repeated["moved_mm"]
    assert "0.1 mm aside" in told
    assert [event["moved_mm"] != [0.0, 0.0] for event in _of(events, "position_repeated", BLINK)] == [False, True]
    assert held(bank, "quality/moved_mm") == pytest.approx([0.0, 0.0, 0.0, 0.1, 0.0, 0.1])
    assert answered(capsys, "status", bank)["moved_positions"] == f"{DARK},{BLINK}"
    assert {DARK, BLINK} <= {one["position"] for one in answered(capsys, "check", bank)["findings"]}

    # What stayed poor is measured again at the end, and only once.
    assert [event["positions"] for event in of_kind(events, "pass_started")] == [[BLIND, CLIPPED, HUM]]
    order = [event["position"] for event in of_kind(events, "position_committed")]
    assert (sorted(order[:6]), order[6:]) == ([0, 1, 2, 3, 4, 5], [BLIND, HUM])
    assert [event["position"] for event in of_kind(events, "position_kept")] == [CLIPPED]
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


def test_given_a_response_over_the_range_then_the_next_larger_one_makes_it_valid(lab, capsys):
    reference, _, _ = _captured(lab, capsys)
    with h5py.File(reference, "r") as file:
        peak_v = file["quality/peak_v"][:].max(axis=1)
        green = file["green"][:]
    low_v = float(np.sort(peak_v)[-2:].mean())  # the loudest position alone is over it
    reference.unlink()
    with (lab / "rig.toml").open("a", encoding="utf-8") as rig:
        rig.write(f"\n[recorder]\nresponse_range_v = {low_v}\nresponse_ranges_v = [{low_v}, {2 * low_v}, 10.0]\n")
    bank, events, _ = _captured(lab, capsys)
    loudest = int(np.argmax(peak_v))
    repeated = of_kind(events, "position_repeated")
    assert [(event["position"], event["defects"][0]) for event in repeated] == [(loudest, "over-range")]
    assert repeated[0]["response_range_v"] == pytest.approx(2 * low_v)
    committed = {event["position"]: event for event in of_kind(events, "position_committed")}
    assert committed[loudest]["response_range_v"] == pytest.approx(2 * low_v)
    assert committed[(loudest + 1) % 6]["response_range_v"] is None
    assert held(bank) == [1] * 6
    with h5py.File(bank, "r") as file:
        error = np.linalg.norm(file["green"][loudest] - green[loudest]) / np.linalg.norm(green[loudest])
    assert error < 2e-2  # the noise of both


def test_given_no_passes_in_the_run_file_then_none_comes(lab, capsys):
    change_text(lab / "run.toml", "[quality]", "[quality]\nremeasure_pass = 0")
    with_faults(lab, f'{READ}kind = "dropout"\nposition = 1\ncount = 3')
    bank, events, _ = _captured(lab, capsys)
    assert not of_kind(events, "pass_started")
    assert held(bank) == [1, 4, 1, 1, 1, 1]
