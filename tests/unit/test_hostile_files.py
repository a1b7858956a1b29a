"""Files that would block, never end or take minutes, next to a bank and as input: refused or passed over at once."""

import os
from contextlib import ExitStack

import numpy as np
import pytest
import soundfile

from wavefocus.__main__ import run
from wavefocus.campaign.control import heartbeat_path, orders_path, read_heartbeat, take_order
from wavefocus.campaign.sidecar_files import drift_path, last_events, log_path, read_drift
from wavefocus.config.loading import MAX_KEY_PARTS, parse_toml
from wavefocus.input_files import input_files
from wavefocus.options import ImportOptions
from wavefocus.rendering.verify.record import read_record
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange import wav
from wavefocus.storage.ledger.owner import owner_path

posix = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="named pipes are POSIX")


@pytest.mark.may_skip("named pipes are POSIX")
@posix
@pytest.mark.parametrize(
    ("name", "read", "nothing"),
    [
        (heartbeat_path, read_heartbeat, None),
        (orders_path, take_order, None),
        (drift_path, read_drift, []),
        (log_path, lambda bank: list(last_events(bank)), []),
    ],
)
def test_given_a_pipe_in_place_of_a_file_beside_a_bank_then_it_holds_nothing(tmp_path, name, read, nothing):
    bank = tmp_path / "plate.h5"
    os.mkfifo(name(bank))
    assert read(bank) == nothing


@pytest.mark.may_skip("named pipes are POSIX")
@posix
def test_given_pipes_as_inputs_then_they_are_refused(tmp_path):
    pipe = tmp_path / "pipe.toml"
    os.mkfifo(pipe)
    assert input_files(pipe) == [pipe]
    with pytest.raises(InputError):
        read_record(pipe)
    for command in (
        ["plan", str(pipe)], ["doctor", str(pipe)], ["render", str(pipe), "--bank", str(pipe), "--out", "x.h5"],
        ["status", str(pipe)], ["check", str(pipe)], ["import", str(pipe), "--bank", str(tmp_path / "new.h5")],
        ["trials", str(pipe), "--bank", str(pipe), "--rig", str(pipe), "--participant", "p", "--out", str(tmp_path)],
    ):  # fmt: skip
        assert run(command) == 2


@pytest.mark.may_skip("named pipes are POSIX")
@posix
def test_given_a_pipe_as_owner_file_then_status_does_not_wait_for_it(tmp_path):
    import h5py

    bank = tmp_path / "plate.h5"
    with h5py.File(bank, "w") as file:
        file["green"], file["position_mm"] = np.ones((1, 1, 4)), [[0.0, 0.0]]
        file.attrs["sample_rate_hz"] = 1000.0
    for path in (owner_path(bank), heartbeat_path(bank)):
        os.mkfifo(path)
    assert run(["status", str(bank)]) == 0


def test_given_a_deeply_nested_line_of_drift_then_the_others_are_read(tmp_path):
    bank = tmp_path / "plate.h5"
    drift_path(bank).write_text("[" * 100_000 + "\n" + '{"a":' * 100_000 + "\n")
    assert read_drift(bank) == []


LONG = MAX_KEY_PARTS + 1


@pytest.mark.parametrize(
    "text",
    [
        "a" + ".a" * 450_000 + " = 1\n",
        "[a" + ".a" * 450_000 + "]\n",
        "[[a" + ' . "a"' * 200_000 + "]]\n",
        "x = { 'a'" + ".'a'" * 200_000 + " = 1 }\n",
        "x = 1\ny" + ".y" * LONG + " = 1\n",
    ],
    ids=["key", "heading", "quoted", "inline", "just too long"],
)
def test_given_a_key_of_too_many_parts_then_it_is_refused_with_its_line(text):
    with pytest.raises(InputError, match=r"^deep\.toml: not TOML: line [12]: a key of more than 16 parts"):
        parse_toml(text, "deep.toml")


@pytest.mark.parametrize(
    "text", ["a.b.c.d = 1", 'text = "' + "one. " * 100 + '"', "x = [" + "1.5, " * 100 + "]", "x = 1 # " + ". " * 100]
)
def test_given_dots_that_make_no_long_key_then_it_is_read(text):
    assert parse_toml(text, "plain.toml")


def test_given_a_table_of_many_places_then_each_actuator_has_its_own_number(tmp_path):
    soundfile.write(tmp_path / "a.wav", np.full((8, 1), 0.5, np.float32), 8000, subtype="FLOAT")
    places = tmp_path / "places.csv"
    places.write_text("file,x_mm,y_mm,actuator\n" + "".join(f"a.wav,0,0,a{number}\n" for number in range(5000)))
    with ExitStack() as stack:
        measured = wav.read(tmp_path, ImportOptions(places=places), stack)
    assert measured.shape == (1, 5000, 8)
