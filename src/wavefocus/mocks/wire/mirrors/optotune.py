"""An Optotune MR-E-2 controller on its serial line.

Where the replies come from (the sources stand in the driver's module):

=================================  ============================================================================
reply                              source
=================================  ============================================================================
``Start`` -> ``OK``                optoMDC of the vendor's Python SDK, the conversation in ``MRE2Board``
frame 7E 00 06 02 00 00 00 00 7E   the same: no answer; it ends the pro mode, in simple mode it is part of a line
``GoPro`` -> ``OK``                the same: from then on text is not answered
unknown command -> ``NO``          the same
``acknowledge`` -> ``OK``          public programs for this controller
``status`` -> ``00000000``         MR-E-3 manual, STATUS: 32 bits in hexadecimal, bit 4: not stable
``xy=x;y`` -> ``OK``, ``OU``       MR-E-3 manual: what is beyond the range is clamped, and the mirror moves there
=================================  ============================================================================

Not confirmed by a source: which of ``OU`` and ``OL`` answers a target beyond the circle but within each axis.
"""

import math
import re

from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.mirrors import MIRROR_DEVICES, MirrorDevice, number

LEAVE_PRO_MODE = "\x7e\x00\x06\x02\x00\x00\x00\x00\x7e"
NOT_STABLE = 1 << 4
FULL_SCALE = math.tan(math.radians(50.0))


@MIRROR_DEVICES.register
class OptotuneDevice(MirrorDevice):
    """An MR-E-2.

    pro_mode: Whether another program has left it in its pro mode.
    """

    name = "optotune-mre2"
    baud = 256000

    def __init__(self, motion: MirrorMotion, *, pro_mode: bool = False) -> None:
        super().__init__(motion)
        self._pro_mode = pro_mode

    def operation(self, command: str) -> str:
        verb = command.lower()
        return {"start": "identify", "acknowledge": "enable", "status": "busy"}.get(
            verb, "move" if "xy" in verb else verb
        )

    def answer(self, command: str) -> str:
        if self._pro_mode:
            self._pro_mode = LEAVE_PRO_MODE not in command
            return ""
        verb = command.strip().lower()
        if verb == "gopro":
            self._pro_mode = True
        if verb in {"start", "acknowledge", "gopro"}:
            return "OK\r\n"
        if verb == "status":
            return f"{NOT_STABLE if self._motion.busy() else 0:08X}\r\n"
        found = re.fullmatch(r"xy= ?([^;]+); ?([^;]+)", verb)
        x, y = (number(found.group(1)), number(found.group(2))) if found else (None, None)
        return "NO\r\n" if x is None or y is None else self._point(x, y)

    def refusal(self, command: str) -> str:
        return "NO\r\n"

    def impostor(self, command: str) -> str:
        return "Ready\r\n"

    def restart(self) -> None:
        super().restart()
        self._pro_mode = False

    def _point(self, x: float, y: float) -> str:
        beyond = max(1.0, math.hypot(x, y))
        angles_mrad = (1000 * math.atan(share / beyond * FULL_SCALE) for share in (x, y))
        limit_mrad = self._motion.limit_mrad
        self._motion.start(*(max(-limit_mrad, min(limit_mrad, angle_mrad)) for angle_mrad in angles_mrad))
        if beyond <= 1.0:
            return "OK\r\n"
        return "OL\r\n" if min(x, y) < -1.0 else "OU\r\n"
