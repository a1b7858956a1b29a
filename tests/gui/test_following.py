"""The tail of a log and the reading model, without any window."""

import math
import threading
import time
from datetime import UTC, datetime, timedelta
from pathlib import Path

import numpy as np
import pytest

from wavefocus.campaign.status import CampaignStatus, Heartbeat
from wavefocus.commands.status import _pace_sentences
from wavefocus.config.messages.campaign import (
    Event,
    Fault,
    Logged,
    PositionCommitted,
    PositionRepeated,
    PositionStarted,
    Progress,
    ReconnectTried,
    SessionEnded,
    SessionStarted,
    State,
    StateChanged,
)
from wavefocus.gui.campaign.follower import Follower, LogTail
from wavefocus.gui.campaign.model import (
    KEPT_LINES,
    CampaignModel,
    EventLine,
    Extra,
    ShownState,
    Weight,
    per_position,
    read_record,
)
from wavefocus.gui.campaign.panels import Controls, pace_text
from wavefocus.gui.surface import raster_of
from wavefocus.storage.ledger.owner import Owner

AT = datetime(2026, 1, 1, tzinfo=UTC)


def test_a_growing_log_then_only_whole_new_lines_are_read_and_torn_ones_passed_over(tmp_path):
    log = tmp_path / "plate.events.jsonl"
    tail = LogTail(log)
    assert tail.read() == ([], False)
    log.write_bytes(b'{"event": "a"}\n{"ev')
    assert tail.read() == ([{"event": "a"}], False)
    assert tail.read() == ([], False)
    with log.open("ab") as file:
        file.write(b'ent": "b"}\n{"torn\n[1]\n{"event": "c"}\n')
    assert tail.read() == ([{"event": "b"}, {"event": "c"}], False)


def test_given_a_log_that_was_replaced_then_it_is_read_anew(tmp_path):
    log = tmp_path / "plate.events.jsonl"
    log.write_text('{"event": "a"}\n{"event": "b"}\n', encoding="utf-8")
    tail = LogTail(log)
    tail.read()
    other = tmp_path / "other"
    other.write_text('{"event": "c"}\n' * 5, encoding="utf-8")
    other.replace(log)
    records, anew = tail.read()
    assert anew
    assert len(records) == 5
    log.write_text("", encoding="utf-8")
    assert tail.read() == ([], True)


def _said(campaign: CampaignModel, *events: Event) -> None:
    campaign.add_records([Logged(AT, event) for event in events], anew=False)


def _asked(campaign: CampaignModel, *, owned: bool, silent: bool = False) -> None:
    owner = Owner("here", 7) if owned else None
    at = datetime.now(UTC) - timedelta(seconds=60 if silent else 0)
    campaign.show_owner(owner, Heartbeat(at, 7, "here", State.RUNNING), time.monotonic() + 1.0)


def test_given_events_and_an_owner_then_the_state_says_who_measures_and_who_is_gone():
    campaign = CampaignModel()
    assert campaign.state().word is Extra.NO_BANK
    assert campaign.state(starting=True).word is Extra.STARTING
    _asked(campaign, owned=True)
    assert campaign.state().word is Extra.PREPARING
    _said(campaign, StateChanged(0.0, State.RUNNING, "6 positions to do"))
    assert campaign.state() == ShownState(State.RUNNING, "6 positions to do")
    _asked(campaign, owned=True, silent=True)
    assert campaign.state().word is Extra.SILENT
    _asked(campaign, owned=False)
    assert campaign.state().word is Extra.GONE
    _said(campaign, StateChanged(1.0, State.FINISHED, "every position is committed"))
    assert campaign.state().word is not State.RUNNING


AGAIN = {"Start", "Remeasure selected (1)", "Remeasure poor (2)"}


@pytest.mark.parametrize(
    ("word", "left", "buttons"),
    [
        (State.RUNNING, 3, {"Pause", "Stop after this position"}),
        (State.PAUSED, 3, {"Continue", "Stop after this position"}),
        (State.STOPPING, 3, set()),
        (State.STOPPED, 3, {"Resume", *AGAIN}),
        (State.FINISHED, 0, AGAIN),
        (Extra.GONE, 3, {"Resume", *AGAIN}),
        (Extra.STARTING, 3, set()),
        (Extra.SILENT, 3, {"Stop after this position"}),
    ],
)
def test_given_a_state_then_only_buttons_that_make_sense_can_be_pressed(qtbot, word, left, buttons):
    controls = Controls(dict.fromkeys(("start", "resume", "pause", "stop", "selected", "poor"), lambda: None))
    qtbot.addWidget(controls)
    controls.show_possible(ShownState(word), has_run=True, has_bank=True, left=left, selected=1, poor=2)
    assert {action.text() for action in controls.actions_by_name.values() if action.isEnabled()} == buttons


LOST = Fault(1.0, "virtual player", "playing", "no answer", "look", 25, 1, retried=True)


def test_given_a_fault_then_it_is_shown_until_that_instrument_works_again():
    campaign = CampaignModel()
    _said(campaign, SessionStarted(0.0, "plate.h5", 6, 3, 0, 6, 60.0, ("virtual mirror, 250 mrad", "virtual player")))
    _said(campaign, PositionStarted(0.5, 25, 1, 0.0, 0.0), LOST)
    assert campaign.lines[-1].weight is Weight.FAULT
    assert "no answer" in campaign.instrument_faults["virtual player"]
    _said(campaign, ReconnectTried(2.0, "player", "virtual player", 1, False, "gone", 1.0, 9.0))
    assert "gone" in campaign.instrument_faults["virtual player"]
    _said(campaign, ReconnectTried(3.0, "player", "virtual player", 2, True, "connected", None, None))
    assert campaign.instrument_faults == {}
    _said(campaign, LOST, PositionStarted(4.0, 25, 2, 0.0, 0.0), PositionCommitted(5.0, 25, 1, 2, 60.0, -60.0, 0, 0))
    assert campaign.instrument_faults == {}


def test_given_a_player_that_is_lost_for_good_then_it_is_shown_as_lost_after_the_end():
    campaign = CampaignModel()
    _said(campaign, PositionStarted(0.5, 24, 1, 0.0, 0.0), PositionStarted(0.9, 25, 1, 0.0, 0.0), LOST)
    _said(campaign, PositionCommitted(1.1, 24, 1, 1, 60.0, -60.0, 0.0, 0.0))  # was being written meanwhile
    _said(campaign, StateChanged(1.2, State.FAILED, "no answer"), SessionEnded(1.3, State.FAILED, 25, 30, {}))
    assert campaign.instrument_faults["virtual player"].startswith("playing: no answer")


def test_given_a_week_of_events_then_no_more_than_so_many_lines_are_kept():
    campaign = CampaignModel()
    for _ in range(30):
        _said(campaign, *[PositionRepeated(0.0, 1, 1, "a burst")] * 1000)
    assert KEPT_LINES <= len(campaign.lines) <= 1.1 * KEPT_LINES


@pytest.mark.parametrize(
    "record",
    [
        {"event": "new_kind", "position": "x"},
        {"event": ["of no kind"]},
        {"event": "state_changed", "state": "dancing", "reason": "later", "time_s": 0.0},
        {"event": "position_committed", "position": None, "status": "x"},
        {},
    ],
)
def test_a_record_of_a_later_version_then_it_is_a_plain_line_and_changes_nothing(record):
    campaign = CampaignModel()
    line = read_record({"at": AT.isoformat(), **record})
    assert isinstance(line, EventLine)
    assert (line.weight, line.at_s) == (Weight.DETAIL, AT.timestamp())
    assert all(str(value) in line.text for key, value in record.items() if key != "time_s")
    campaign.add_records([line], anew=False)
    assert campaign.lines == [line]
    assert campaign.state().word is Extra.NO_BANK


def test_each_position_has_its_own_figures_per_actuator_and_unmeasured_ones_none():
    quality = {
        "snr_db": np.array([[1, 2, 3], [4, 5, np.nan], [0, 0, 0]], np.float32),
        "attempts": np.ones(3, np.float32),
    }
    found = per_position(quality, np.array([True, True, False]))
    np.testing.assert_array_equal(found["snr_db"], np.array([2.0, 4.5, np.nan], np.float32))
    np.testing.assert_array_equal(found["attempts"], np.array([1, 1, np.nan], np.float32))
    assert np.isnan(found["coherence"]).all()


def test_any_grid_then_every_position_has_pixels_but_checks_and_a_click_finds_it():
    square = np.stack(np.meshgrid(np.arange(7.0), np.arange(5.0)), axis=-1).reshape(-1, 2) * 4.0
    shifted = square + np.where(square[:, 1:] % 8 == 0, 0.0, 2.0) * [1, 0]
    for position_mm in (square, shifted, np.array([[3.0, 4.0]])):
        raster = raster_of(position_mm)
        assert set(np.unique(raster.index)) == set(range(len(position_mm) + 1))
        assert [raster.nearest(*point) for point in position_mm.tolist()] == list(range(len(position_mm)))
        assert raster.nearest(1e4, 0.0) == -1
    checked, bare = raster_of(np.vstack([square, [[1.0, 1.0], [9.5, 6.5]]]), [35, 36]), raster_of(square)
    pixels = [int((checked.index == row).sum()) for row in range(37)]
    assert pixels == [*(int((bare.index == row).sum()) for row in range(35)), 0, 0]
    assert checked.nearest(9.5, 6.5) == 36


def test_given_a_disk_that_hangs_then_the_follower_ends_without_waiting_for_it(tmp_path):
    hangs, continues = threading.Event(), threading.Event()

    def hanging(_bank: Path) -> None:
        hangs.set()
        continues.wait(60)

    follower = Follower(tmp_path / "plate.h5", hanging)
    assert hangs.wait(30)
    follower.end()
    assert not continues.is_set()
    campaign = CampaignModel()
    follower.change(campaign, 9)
    assert campaign.revision == CampaignModel().revision
    continues.set()


def paced(per_hour: float, left_s: float) -> CampaignStatus:
    return CampaignStatus().after(Logged(datetime.now(UTC), Progress(0.0, 3, 10, 1.0, left_s, left_s, per_hour)))


@pytest.mark.parametrize("state", [*State, *Extra])
def test_a_state_then_a_remaining_time_is_shown_only_while_positions_are_measured(state):
    text = pace_text(paced(120.0, 4.0), going_on=ShownState(state).going_on)
    assert ("left" in text) is (state is State.RUNNING)
    assert text.startswith("120 positions an hour")
    assert pace_text(paced(math.nan, math.nan), going_on=True) == ""


def test_given_the_last_position_then_the_rate_stands_without_an_empty_part():
    progress = Progress(
        time_s=1.0, done=9, total=9, elapsed_s=1.0, remaining_s=0.0, wall_remaining_s=0.0, positions_per_hour=57_400.0
    )
    (line,) = _pace_sentences(CampaignStatus(State.RUNNING, progress=progress, progress_at=datetime.now(UTC)), 0)
    assert line.startswith("57400 positions an hour (last position ")
