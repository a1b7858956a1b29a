"""Files of a small campaign, written and changed."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

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


def write_positions(folder: Path, positions_mm: Iterable[Sequence[float]]) -> None:
    """Write the position list of a run into its folder."""
    lines = "".join(f"{x_mm},{y_mm}\n" for x_mm, y_mm in positions_mm)
    (folder / "positions.csv").write_text("x_mm,y_mm\n" + lines, encoding="utf-8")


def change_text(file: Path, old: str, new: str) -> None:
    """Replace a text in a file, which has to hold it."""
    text = file.read_text(encoding="utf-8")
    assert old in text
    file.write_text(text.replace(old, new), encoding="utf-8")
