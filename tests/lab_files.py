"""Files of a small campaign, written and changed."""

import hashlib
from contextlib import contextmanager
from dataclasses import replace

import h5py
import numpy as np
import pytest

from wavefocus.acquisition.setup import Setup
from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.config.emulation import RigFault, WireFault
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.ledger import PointRecord
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.bank.writer import BankWriter, create_bank
from wavefocus.storage.raw.header import RawHeader, sequential

ACTUATORS = [[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0]]
POSITIONS = [[0.0, 0.0], [4.0, 0.0], [8.0, 0.0], [8.0, 4.0], [4.0, 4.0], [0.0, 4.0]]

RIG = f"""
[rig]
name = "three coils"

[actuators]
position_mm = {ACTUATORS}
"""

RUN = """
rig = "rig.toml"

[grid]
positions_file = "positions.csv"

[sweep]
duration_s = 0.3

[capture]
averages = 2
decay_s = 0.1
taps = 1000

[quality]
second_look = "never"

[virtual]
seed = 3
noise_v = 1e-4
"""

ABSENT_RIG = """
[actuators]
position_mm = [[110, 0], [0, 60], [-110, 10]]
[mirror]
driver = "generic"
port = "{folder}/no-such-port"
[recorder]
driver = "nidaqmx"
device = "Dev1"
address = "localhost:1"
[player]
driver = "sounddevice"
device = "no such interface"
"""


def setup_of(rig, **changes):
    """A virtual rig wired as it is, with a mirror a metre above the plate."""
    settings = rig.settings
    setup = Setup(
        rig.mirror, rig.recorder, rig.player, rig.clock, MirrorMap.straight(1000.0), settings.channel_of_actuator,
        settings.channel_of_loopback, (10.0, 10.0), settings.sensitivity_m_s_per_v,
    )  # fmt: skip
    return replace(setup, **changes)


def rig_fault(role, operation, kind, **more):
    """A fault of a virtual instrument."""
    return RigFault(role=role, operation=operation, kind=kind, **more)


def wire_fault(role, kind, operation, **more):
    """A fault of an emulated instrument."""
    return WireFault(role=role, kind=kind, operation=operation, **more)


def write_positions(folder, positions_mm):
    """Write the position list of a run into its folder."""
    lines = "".join(f"{x_mm},{y_mm}\n" for x_mm, y_mm in positions_mm)
    (folder / "positions.csv").write_text("x_mm,y_mm\n" + lines, encoding="utf-8")


def point_scene(at_mm, signal, *tables):
    """The text of a scene of one source at a point, and more tables of it."""
    source = f'[[source]]\npath = {{ kind = "point", at_mm = {at_mm} }}\nsignal = {{ {signal} }}'
    return "\n".join([source, *tables, ""])


def stroke_scene(start_mm, end_mm, signal, *tables, speed_mm_s=100.0, step_mm=4.0):
    """The text of a scene of one source along a line, more keys of that source, and more tables of the scene."""
    path = f'path = {{ kind = "line", start_mm = {start_mm}, end_mm = {end_mm} }}'
    source = f"[[source]]\nspeed_mm_s = {speed_mm_s}\nstep_mm = {step_mm}\n{path}\nsignal = {{ {signal} }}"
    return "\n".join([source, *tables, ""])


def change_text(file, old, new):
    """Replace a text in a file, which has to hold it."""
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")


def write_rows(path, header, green, rows=None):
    """Create a bank and measure rows of Green's functions (positions, actuators, taps) into it: all, or some."""
    create_bank(path, header)
    figures = np.ones(header.actuators, np.float32)
    with BankWriter.open(path) as writer:
        for row in range(header.positions) if rows is None else rows:
            writer.commit(row, green[row].astype(np.float32), PointRecord(1, 1, figures, figures, figures, figures))


_banks = {}  # measured once: each commit waits for the disk


def write_bank(
    path, green, position_mm=None, *, rows=None, actuator_mm=None, rate_hz=10000.0, band_hz=(20.0, 500.0),
    check_rows=(), units=("m/s/V", "V"),
):  # fmt: skip
    """Measure rows (positions, actuators, taps) into a new bank: all of them, or those at some positions alone."""
    positions, actuators, taps = green.shape
    if position_mm is None:
        position_mm = np.stack([np.arange(positions) * 4.0, np.zeros(positions)], axis=1)
    place_mm = np.full((actuators, 2), np.nan) if actuator_mm is None else np.asarray(actuator_mm)
    rows = tuple(range(positions) if rows is None else rows)
    places = [np.asarray(position_mm).tolist(), place_mm.tolist()]
    about = [rate_hz, band_hz, check_rows, units, rows, green.shape, *places]
    key = hashlib.sha256(repr(about).encode() + np.ascontiguousarray(green).tobytes()).hexdigest()
    if key not in _banks:
        header = BankHeader(
            rate_hz, taps, band_hz, position_mm, place_mm, "{}", "{}", "ab" * 32, "test", *units, check_rows=check_rows
        )
        write_rows(path, header, green, rows)
        _banks[key] = path.read_bytes()
    path.write_bytes(_banks[key])
    return path


def green_of(position, attempt=1, actuators=2, taps=16):
    """Green's functions of an attempt at a position."""
    return np.random.default_rng([position, attempt]).normal(size=(actuators, taps)).astype(np.float32)


def record_of(position, attempt=1, actuators=2, status=1):
    """Status and figures of an attempt at a position."""
    figures = np.arange(actuators, dtype=np.float32) + position + attempt / 10
    return PointRecord(status, attempt, figures, -figures, figures / 100, figures * 2)


def with_check_rows(bank, out, *rows):
    """Write the same bank with rows that lie off the grid and only judge what is between it."""
    with open_bank(bank) as view:
        header = BankHeader(
            float(view.sample_rate_hz), view.taps, view.band_hz, view.position_mm, view.actuator_mm, view.rig_json,
            view.run_json, view.plan_sha256, "test", check_rows=rows,
        )  # fmt: skip
        write_rows(out, header, [view.green(row) for row in range(view.positions)])
    return out


def flip(path, offset, bit=4):
    """Flip one bit of a file's byte."""
    content = bytearray(path.read_bytes())
    content[offset] ^= bit
    path.write_bytes(content)


@contextmanager
def no_room_beyond(size):
    """Let no file grow beyond so many bytes, as on a full disk; where a system has no such limit, the test skips."""
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def raw_header(positions=3, records=2, samples=300):
    """Of raw recordings: sequential records at positions 2 mm apart, in whole counts of 1/1024 V."""
    # Drivers of others may give NumPy's numbers.
    return RawHeader(
        1000.0, samples, 50, (50.0, 400.0), sequential(records), np.arange(2.0 * positions).reshape(positions, 2),
        np.zeros((records, 2)), np.float64(0.125), volts_per_count=(1 / 1024, 1 / 1024), averages=1, sweep_s=0.2,
        decay_s=0.05, plan_sha256="ab" * 32,
    )  # fmt: skip


def write_foreign(path, gain=1.0):
    """A bank of another program, no more in it than there must be: 5 x 3 positions, three actuators, 60 taps, 2 kHz."""
    x_mm, y_mm = np.meshgrid(np.arange(5) * 4.0, np.arange(3) * 4.0)
    green = np.random.default_rng(4).standard_normal((15, 3, 60)) * np.exp(-np.arange(60) / 15)
    return write_arrays(path, green * gain, np.column_stack([x_mm.ravel(), y_mm.ravel()]))


def write_arrays(path, green, position_mm, rate_hz=2000.0, **attributes):
    """A bank of another program: Green's functions (positions, actuators, taps), their places, and more attributes."""
    with h5py.File(path, "w") as file:
        file["green"], file["position_mm"] = green, position_mm
        file.attrs.update(sample_rate_hz=rate_hz, **attributes)
    return path


def put(name, value):
    """A change of a file: another dataset or link under a name."""

    def change(file):
        if name in file:
            del file[name]
        file[name] = value

    return change


def within(name, value):
    """A change of a file: other values in a dataset."""

    def change(file):
        file[name][...] = value

    return change


def attribute(name, value, of="/"):
    """A change of a file: another value of an attribute."""

    def change(file):
        file[of].attrs[name] = value

    return change


def without(name):
    """A change of a file: an attribute or dataset less."""

    def change(file):
        if name in file.attrs:
            del file.attrs[name]
        else:
            del file[name]

    return change
