"""A campaign that nobody watches: instruments lost, paused, suspended, hung, and ended in every way there is."""

import contextlib
import io
import json
import os
import select
import subprocess
import sys
import time

import pytest

from tests.lab_files import change_text
from tests.system.captures import Listener, capture, captured, empty_bank, events_of, held, refused, said_by, wavefocus
from tests.system.conftest import add_to_rig, with_faults, write_lab
from tests.system.lines import Lines, of_posix, python, wait_until
from tests.unit.test_bank_writer import HOLD
from wavefocus.campaign.control import read_heartbeat
from wavefocus.campaign.sidecar_files import last_events
from wavefocus.config.messages.campaign import PositionCommitted, StateChanged

WATCHED = """
[recovery]
hung_after_s = 1.0

[watch]
probe_every_s = 10.0
give_up_after_s = 300.0

[watch.noise]
leaves_above = 0.01
settle_s = 20.0

[watch.reference]
leaves_below = -3.0
leaves_above = 3.0
settle_s = 20.0

[watch.room]
leaves_below = 18.0
returns_above = 19.0
settle_s = 20.0
"""


@pytest.fixture(scope="module")
def quiet(tmp_path_factory):
    """The bank of an undisturbed capture of a lab under watch, as bytes."""
    lab = write_lab(tmp_path_factory.mktemp("watched"))
    add_to_rig(lab, WATCHED)
    bank = empty_bank(lab, "quiet.h5")
    assert capture(lab, bank) == 0
    return bank.read_bytes()


@pytest.fixture
def watched(lab):
    """The lab under watch, with an empty bank."""
    add_to_rig(lab, WATCHED)
    empty_bank(lab, "plate.h5")
    return lab


def test_an_instrument_that_stays_away_then_exit_3_and_the_others_are_at_rest(lab, measured, capsys):
    bank = empty_bank(lab, "plate.h5")
    mend = with_faults(
        lab,
        'role = "player"\noperation = "play"\nkind = "lost"\nposition = 1\nrecord = 0',
        'role = "mirror"\noperation = "park"\nkind = "timeout"\nat_call = 1',
    )
    told = captured(capsys, lab, code=3)
    for words in ("player", "not back within 10 min 00 s", "check its cable and its power"):
        assert words in told.last
    assert told.last.endswith(f"go on with: wavefocus resume {bank} --rig {lab / 'rig.toml'}")
    assert "on the way out: virtual player: muting" in told.err
    assert "on the way out: virtual mirror: parking" in told.err
    assert "Traceback" not in told.err
    beat = read_heartbeat(bank)
    assert (beat.state, beat.done, beat.total, beat.pid) == ("failed", 1, 6, os.getpid())
    assert "virtual player" in beat.reason
    assert "virtual player: playing" in beat.fault
    assert told.of("session_ended")[0]["state"] == "failed"
    people = said_by(capsys, "status", bank).out
    assert "failed: virtual player" in people
    assert "no process owns the bank" in people
    mend()
    assert capture(lab, bank) == 0
    assert bank.read_bytes() == measured.read_bytes()


def test_status_while_instrument_is_waited_for_then_it_says_so_since_when_and_which(lab):
    with_faults(lab, 'role = "player"\noperation = "wait"\nkind = "unplugged"\nposition = 2\nrecord = 0\ntries = 2')
    bank, answers = lab / "plate.h5", [io.StringIO(), io.StringIO()]

    def ask():
        for answer, more in zip(answers, (["--json"], []), strict=True):
            with contextlib.redirect_stdout(answer):
                assert wavefocus("status", bank, *more) == 0

    listener = Listener(('"event": "reconnect_tried"', ask))
    with contextlib.redirect_stdout(listener):
        assert capture(lab, bank) == 0
    facts, people = json.loads(answers[0].getvalue()), answers[1].getvalue()
    assert facts["state"] == "recovering"
    recovering = next(one for one in events_of(listener.told, "state_changed") if one["state"] == "recovering")
    assert facts["state_since"][:19] == str(recovering["at"])[:19]
    expected = {"instrument": "virtual player", "tries": 1, "next_try_s": 1.0, "gives_up_s": 600.0}
    assert facts["recovering"] | expected == facts["recovering"]
    assert "is recovering since" in people
    assert "virtual player" in people


# Ctrl-C and a stop while an instrument is waited for are in tests/unit/test_interrupted_sessions.py.
def _order(bank, word):
    """Give an order by a process of its own, and return it when the capture in this one has heard it."""
    before = read_heartbeat(bank)
    given = Lines(word, bank, "--json")

    def heard():
        beat = read_heartbeat(bank)
        return beat is not None and beat.order not in ("", None if before is None else before.order)

    wait_until(heard, f"the order {word} is heard")
    return given


def test_orders_of_other_processes_pause_resume_and_stop_and_the_bank_is_identical(lab, measured):
    bank = empty_bank(lab, "plate.h5")
    orders = []
    listener = Listener(
        ('"event": "position_started"', lambda: orders.append(_order(bank, "pause"))),
        ('"state": "paused"', lambda: orders.append(_order(bank, "resume"))),
        ('"event": "position_started"', lambda: orders.append(_order(bank, "stop"))),
    )
    with contextlib.redirect_stdout(listener):
        assert capture(lab, bank) == 130
    states = [one["state"] for one in events_of(listener.told, "state_changed")]
    assert states == ["running", "pausing", "paused", "running", "stopping", "stopped"]
    # The position under way is finished, no other is begun.
    for end, positions in (('"state": "paused"', 1), ('"state": "stopped"', 2)):
        before = listener.told[: listener.told.index(end)].rpartition("\n")[0]
        assert len(events_of(before, "position_started")) == len(events_of(before, "position_committed")) == positions
    # Whoever was at the plate may have touched it.
    assert [one["verdict"] for one in events_of(listener.told, "drift")] == ["steady"]
    assert not (lab / "plate.h5.orders").exists()
    for order, answer in zip(orders, ("heard", "heard", "carried_out"), strict=True):
        with order:
            assert order.rest()[-1][answer] is True
            assert order.end() == 0
    assert any("stopped" in line for line in orders[-1].said)
    assert wavefocus("resume", bank) == 0
    assert bank.read_bytes() == measured.read_bytes()


@contextlib.contextmanager
def _held(bank):
    """A process that owns a bank and says nothing."""
    command = [sys.executable, "-c", HOLD, str(bank)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as owner:
        assert owner.stdout.readline().strip() == b"open"
        yield owner
        owner.communicate(timeout=20)


def test_a_silent_process_has_its_order_withdrawn_and_status_says_how_long(lab, capsys):
    bank = empty_bank(lab, "plate.h5")
    with _held(bank) as owner:
        beat = {"at": "2026-01-01T00:00:00+00:00", "pid": owner.pid, "host": "here", "state": "running", "reason": "r"}
        (lab / "plate.h5.heartbeat").write_text(json.dumps(beat), encoding="utf-8")
        told = said_by(capsys, "pause", bank, code=1).err
        assert f"process {owner.pid}" in told
        assert "does not answer" in told
        assert not (lab / "plate.h5.orders").exists()
        assert str(owner.pid) in refused(capsys, "resume", bank, code=75)
        assert "owns the bank but has been silent for" in said_by(capsys, "status", bank).out
        facts = json.loads(said_by(capsys, "status", bank, "--json").out)
    assert facts["silent"] is True
    assert facts["last_sign_of_life"]["state"] == "running"
    assert facts["last_sign_of_life"]["age_s"] > 86_400


HANGS = (
    'role = "recorder"\noperation = "identify"\nat_call = 1',
    'role = "recorder"\noperation = "read"\nposition = 2\nrecord = 1',
    'role = "mirror"\noperation = "move_to"\nat_call = 6',
)


def test_driver_calls_that_hang_are_connected_afresh_and_nothing_is_lost(watched, quiet, capsys):
    with_faults(watched, *(f'{fault}\nkind = "hang"' for fault in HANGS))
    told = captured(capsys, watched)
    assert ["did not come back within" in str(one["cause"]) for one in told.of("fault")] == [True] * len(HANGS)
    assert [one["connected"] for one in told.of("reconnect_tried")] == [True] * len(HANGS)
    assert (watched / "plate.h5").read_bytes() == quiet


def test_a_driver_that_never_returns_ends_with_exit_3_and_the_others_at_rest(lab):
    add_to_rig(lab, "\n[recovery]\nhung_after_s = 0.2\ngive_up_after_s = 1.0\n")
    # It hangs with the driver's own lock held: muting, reconnecting and closing hang as well.
    with_faults(
        lab,
        'role = "player"\noperation = "play"\nkind = "hang"\nposition = 1\nrecord = 0',
        'role = "mirror"\noperation = "park"\nkind = "timeout"\nat_call = 1',
    )
    bank = lab / "plate.h5"
    ended = python("-m", "wavefocus", "capture", lab / "run.toml", "--bank", bank)
    assert ended.returncode == 3, ended.stderr
    last = ended.stderr.splitlines()[-1]
    assert "virtual player: playing: the call did not come back within" in last
    assert "not back within" in last
    assert last.endswith(f"go on with: wavefocus resume {bank} --rig {lab / 'rig.toml'}")
    assert "on the way out: virtual mirror: parking" in ended.stderr  # so it was parked, though it said no
    assert "Traceback" not in ended.stderr
    assert held(bank) == [1, 0, 0, 0, 0, 0]


@of_posix
def test_terminal_that_is_closed_then_position_is_finished_and_log_says_why(lab):
    import pty

    bank = lab / "plate.h5"
    change_text(lab / "run.toml", "averages = 2", "averages = 8")
    command = [sys.executable, "-m", "wavefocus", "capture", str(lab / "run.toml"), "--bank", str(bank)]
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(command[0], command)
    until_s = time.monotonic() + 60.0
    told = b""
    try:
        while not any(isinstance(one.event, PositionCommitted) for one in last_events(bank)):
            assert time.monotonic() < until_s, told
            if select.select([terminal], [], [], 0.1)[0]:
                told += os.read(terminal, 65536)
    finally:
        os.close(terminal)
    _, how = os.waitpid(pid, 0)
    assert os.waitstatus_to_exitcode(how) == 130
    reasons = [one.event.reason for one in last_events(bank) if isinstance(one.event, StateChanged)]
    assert "stopped because its terminal was closed" in reasons[0]
    assert 0 < held(bank).count(1) < 6


@pytest.mark.parametrize(
    ("fault", "words"),
    [('kind = "dark"', "V is above 0.01 V"), ('kind = "faint_reference"\nlevel_db = -9.0', "reference level -9")],
    ids=["dark", "faint reference"],
)
def test_a_condition_out_of_its_band_is_waited_for_and_the_bank_is_the_same(watched, quiet, fault, words, capsys):
    # From the third position's first record on: its three records, the last good position's, and two probes.
    with_faults(watched, f'role = "recorder"\noperation = "read"\nat_call = 8\ncount = 6\n{fault}')
    told = captured(capsys, watched)
    assert told.states == ["running", "suspended", "running", "finished"]
    assert words in str(told.of("state_changed")[1]["reason"])
    # Two probes that are no good; from the first good one on it must settle for two more.
    assert [one["back"] for one in told.of("conditions_seen")] == [False, False, True, True, True]
    assert (watched / "plate.h5").read_bytes() == quiet


def test_given_a_condition_that_stays_away_then_exit_3_says_so_and_resume_goes_on(watched, quiet, capsys):
    bank = watched / "plate.h5"
    mend = with_faults(watched, 'role = "recorder"\noperation = "read"\nat_call = 8\ncount = 9999\nkind = "dark"')
    told = captured(capsys, watched, code=3)
    assert "suspended for 5 min" in told.last
    assert "vibrometer noise" in told.last
    assert told.states[-2:] == ["suspended", "failed"]
    assert held(bank) == [1, 1, 0, 0, 0, 0]  # nothing measured in the dark was called anything
    mend()
    assert capture(watched, bank) == 0
    assert bank.read_bytes() == quiet


def test_given_a_dark_spot_then_it_is_the_positions_fault_and_nothing_is_suspended(watched, capsys):
    dark = 'role = "recorder"\noperation = "read"\nkind = "dark"\nposition = 2\npurpose = "capture"\ncount = 99'
    # The position before is good aside of another dark spot, and is probed there.
    with_faults(watched, dark, dark.replace('= 2\npurpose = "capture"', "= 1\nspot_mm = [4.0, 0.0, 0.05]"))
    assert "suspended" not in captured(capsys, watched).states
    status = held(watched / "plate.h5")
    assert status[2] & 1 == 0
    assert status[:2] + status[3:] == [1] * 5
