"""A virtual shutter."""

from wavefocus.drivers.protocols import Shutter
from wavefocus.mocks.virtual.faults import VirtualDevice


class VirtualShutter(VirtualDevice, Shutter):
    """Blocks the virtual beam.

    is_open: Whether it lets the beam through.
    """

    def __init__(self) -> None:
        super().__init__("shutter", (), "closed by default")
        self.is_open = False

    def open_beam(self) -> None:
        self._check_open("opening")
        self.is_open = True

    def block_beam(self) -> None:
        self._check_open("closing")
        self.is_open = False
