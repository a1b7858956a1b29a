"""A rig whose mirror follows two outputs of the recorder's emulated box."""

from tests.wire.emulated import rig_text
from wavefocus.configuration import load_rig

MIRROR = """
[mirror]
driver = "analog"
device = "Dev1"
address = "{address}"
distance_mm = 1000.0
limit_mrad = 200.0
park_mrad = [-190.0, -190.0]
"""


def analog_rig(folder, address, **text):
    """The rig, with a server at an address, from a file in a folder."""
    rig_file = folder / "rig.toml"
    whole = rig_text(folder, address, **text)
    before, _, rest = whole.partition("[mirror]")
    after = rest.partition("\n[")[2]
    rig_file.write_text(f"{before}{MIRROR.format(address=address)}\n[{after}", encoding="utf-8")
    return load_rig(rig_file)
