"""A rig file whose instruments stand at the other ends of emulated wires, and the emulated instruments themselves."""

import os
import socket
from contextlib import contextmanager

from tests.system.lines import Lines, wait_until
from tests.wire.serial_bench import DIALECTS
from wavefocus.configuration import load_rig

ACTUATORS = [[110.0, 0.0], [0.0, 60.0], [-110.0, 10.0], [20.0, -60.0]]

RIG = """
[rig]
name = "emulated"

[actuators]
position_mm = {actuators}

[mirror]
driver = "{dialect}"
port = "{mirror}"
settle_s = 0.02
{keys}

[recorder]
driver = "nidaqmx"
device = "Dev1"
address = "{recorder}"
inter_channel_delay_s = 1.4e-5
response_range_v = 1.0
post_roll_s = 0.3

[player]
driver = "sounddevice"
host_api = "JACK Audio Connection Kit"
device = "wavefocus interface"

[emulation]
seed = 4
noise_v = 1e-4
period_frames = {period_frames}
"""


def rig_text(folder, recorder, *, dialect="asi-tiger", mirror="", period_frames=4096):
    """A rig file's text: its mirror behind a link in `folder`, unless another port is named."""
    return RIG.format(
        actuators=ACTUATORS,
        dialect=dialect,
        mirror=mirror or folder / "mirror",
        keys=DIALECTS[dialect].rig,
        recorder=recorder,
        period_frames=period_frames,
    )


ANALOG = """
[mirror]
driver = "analog"
device = "Dev1"
address = "{address}"
distance_mm = 1000.0
limit_mrad = 200.0
park_mrad = [-190.0, -190.0]
"""
SHUTTER = """
[shutter]
driver = "nidaqmx"
device = "Dev1"
address = "{address}"
"""


def analog_rig(folder, address, shutter=None, mirror="", **text):
    """A rig, read from a file in `folder`, whose mirror follows two outputs of the recorder's box at an address.

    shutter, mirror: Keys of a shutter on that box, if there is one, and more keys of the mirror, as lines.
    """
    before, _, rest = rig_text(folder, address, **text).partition("[mirror]")
    tables = ANALOG + mirror + ("" if shutter is None else SHUTTER + shutter)
    rest = rest.partition("\n[")[2]
    (folder / "rig.toml").write_text(f"{before}{tables.format(address=address)}\n[{rest}", encoding="utf-8")
    return load_rig(folder / "rig.toml")


class EmulatedInstruments(Lines):
    """A running ``wavefocus emulate``.

    rig_file: What it stands in for.
    """

    def __init__(self, rig_file):
        super().__init__("emulate", rig_file, "--json")
        first = self.told()
        assert first is not None, self.said
        wait_until(lambda: any("and here:" in line for line in self.said), "the emulated instruments")
        self.environment = {**os.environ, **first["environment"]}

    def say(self, line):
        """Type a line; what the emulated instruments answer."""
        before = len(self.said)
        self.send_text(line)
        wait_until(lambda: len(self.said) > before, f"an answer to {line}")
        return self.said[before]

    def close(self):
        """Say quit, and wait for the end."""
        if self.process.poll() is None:
            self.send_text("quit")
        return self.end()


@contextmanager
def emulated_instruments(rig_file):
    """Emulated devices for the length of a block."""
    with EmulatedInstruments(rig_file) as sides:
        try:
            yield sides
        finally:
            sides.close()


def free_port():
    """A TCP port that nobody listens at."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])
