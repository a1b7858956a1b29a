"""Keeping recordings: what is committed stays, whatever the disk does, and what is wrong is refused by a sentence."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from tests.lab_files import raw_header
from wavefocus.acquisition.attempt import require_same
from wavefocus.storage.errors import InputError
from wavefocus.storage.raw.writer import RawWriter, create_raw, open_raw

SHAPE = (2, 300)
STEP_V = 1 / 1024


def volts(position, attempt=1):
    """Reference and response of an attempt, in whole counts."""
    draw = np.random.default_rng([position, attempt])
    reference, response = (draw.integers(-3000, 3000, SHAPE).astype(np.float32) * np.float32(STEP_V) for _ in range(2))
    return reference, response


def holds(path, position, attempt):
    """Whether the file gives the recordings of an attempt."""
    with open_raw(path) as raw:
        found = raw.read(position)
    reference, response = volts(position, attempt)
    return (
        found is not None
        and np.array_equal(found.reference_v, reference)
        and np.array_equal(found.response_v, response)
    )


def made(tmp_path, positions=3):
    path = tmp_path / "a.raw.h5"
    create_raw(path, raw_header(positions))
    return path


def test_given_recordings_of_another_scale_then_they_are_not_put_into_one_file(tmp_path):
    words = r"a\.raw\.h5 was recorded with response_per_volt 0\.125, the rig now has 0\.05"
    with RawWriter.open(made(tmp_path)) as writer:
        require_same(writer, writer.header)
        with pytest.raises(InputError, match=words):
            require_same(writer, replace(writer.header, response_per_volt=0.05))


def test_commits_are_read_by_plain_h5py_and_replaced_and_do_not_grow_the_file(tmp_path):
    path = made(tmp_path)
    with pytest.raises(InputError, match="exists already"):
        create_raw(path, raw_header())
    size = path.stat().st_size
    with RawWriter.open(path, plan_sha256="ab" * 32) as writer:
        writer.commit(1, *volts(1))
        assert writer.recorded.tolist() == [False, True, False]
    assert holds(path, 1, 1)
    with open_raw(path) as raw:
        assert raw.read(0) is None
        assert raw.header.schedule.is_sequential
        assert (raw.header.averages, raw.header.sweep_s, raw.header.decay_s) == (1, 0.2, 0.05)
    with h5py.File(path) as file:  # as the contract says
        assert file.attrs["format"] == "wavefocus-raw"
        assert file["response"].dtype == np.int16
        assert np.array_equal(file["response"][1] * np.float32(file["response"].attrs["volts_per_count"]), volts(1)[1])
        assert file["schedule/actuator"][:].tolist() == [[0], [1]]
    with RawWriter.open(path) as writer:
        for position, attempt in ((0, 1), (2, 1), (0, 2)):
            writer.commit(position, *volts(position, attempt))
    assert holds(path, 0, 2)
    assert path.stat().st_size == size <= raw_header().file_bytes


def test_given_recordings_that_do_not_fit_then_they_are_refused_and_nothing_is_kept(tmp_path):
    reference, response = volts(0)
    with RawWriter.open(made(tmp_path)) as writer:
        for position, wrong, complaint in (
            (3, response, "position 3 is not in raw file"), (0, response[:1], "shape"),
            (0, response + np.float32(100), "not finite or beyond"),
            (0, response * np.float32(np.nan), "not finite or beyond"),
        ):  # fmt: skip
            with pytest.raises(InputError, match=complaint):
                writer.commit(position, reference, wrong)
        assert not writer.recorded.any()
