"""A mirror driver and its emulated instrument on a real wire."""

import math
import os
from contextlib import contextmanager
from dataclasses import dataclass, field, fields

from wavefocus.drivers.protocols import WallClock
from wavefocus.drivers.registry import MIRRORS, MirrorSettings
from wavefocus.drivers.serial_device import SerialMirror
from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire import WireFaultPlan
from wavefocus.mocks.wire.emulated_serial import EmulatedSerial, PtyWire, SerialDevice, TcpWire, garble
from wavefocus.mocks.wire.mirrors import mirror_device


@dataclass(frozen=True)
class Facts:
    """How to recognise a dialect's move on the line and its refusal in a message; keys that a rig file needs."""

    move: str
    refusal: str
    rig: str = ""
    names_itself: bool = True


DIALECTS = {
    "asi-tiger": Facts("M A=", ":N-5: the operation failed"),
    "generic": Facts("XY=", "ERR 5 not ready"),
    "mirrorcle-mti": Facts("MTI+GT", "MTI-ERR DeviceBusy", rig="full_scale_mrad = 260"),
    "optotune-mre2": Facts("xy=", "answers NO", names_itself=False),
}
"""Every dialect; a new one is a line here."""

# Pseudo-terminals are a matter of POSIX; elsewhere the same tests run over TCP alone.
LOCAL = "pty" if os.name == "posix" else "tcp"
LIMIT_MRAD = 250.0
PARK_MRAD = (-200.0, -200.0)
# Rounding in the coarsest dialect: 1e-4 of the tangent of 50 degrees.
ROUNDING_MRAD = 0.07


class ImpatientClock(WallClock):
    """Passes little time where a driver gives a device time: the emulated ones need none."""

    def sleep(self, seconds):
        super().sleep(min(seconds, 0.005))


class HurriedClock(ImpatientClock):
    """Runs eight times as fast: what never gets an answer gives up soon."""

    def now_s(self):
        return 8 * super().now_s()


@dataclass
class MirrorBench:
    """An emulated instrument, and mirrors that are opened on it."""

    dialect: str
    far: EmulatedSerial
    motion: MirrorMotion
    device: SerialDevice
    opened: list[SerialMirror] = field(default_factory=list)

    def mirror(self, *, port="", answer_s=0.5, patience_s=0.5, **changes):
        driver = MIRRORS.all()[self.dialect]
        settings = {
            "settle_s": 0.02, "limit_mrad": LIMIT_MRAD, "park_mrad": PARK_MRAD, "clock": ImpatientClock(),
            "full_scale_mrad": LIMIT_MRAD, "port": port or self.far.address, **changes,
        }  # fmt: skip
        keys = {key.name: settings.pop(key.name) for key in fields(driver) if key.name in settings}
        settings.pop("full_scale_mrad", None)  # of one dialect alone
        mirror = SerialMirror(driver(**keys), MirrorSettings(**settings), answer_s=answer_s, patience_s=patience_s)
        self.opened.append(mirror)
        return mirror

    def stands_at(self, x_mrad, y_mrad):
        x, y = self.motion.where_mrad()
        return not self.motion.busy() and max(abs(x - x_mrad), abs(y - y_mrad)) <= ROUNDING_MRAD

    def check_move(self, mirror, x_mrad=40.0, y_mrad=-25.0):
        """A move ends with the beam standing where it was sent."""
        mirror.move_to(x_mrad, y_mrad)
        mirror.wait_settled(10.0)
        assert self.stands_at(x_mrad, y_mrad)


def answering(kind, prefix, answer, times=math.inf):
    """A device that gives this answer to commands that begin so; ``{axis}`` is the command's fourth letter."""

    class Answering(kind):  # type: ignore[misc, valid-type]
        left = times

        def answer(self, command):
            if not command.startswith(prefix) or self.left < 1:
                return str(super().answer(command))
            self.left -= 1
            return answer.format(axis=command[3:4]) + "\r\n"

    return Answering


def wire(kind, folder):
    return PtyWire(folder / "port") if kind == "pty" else TcpWire()


@contextmanager
def mirror_bench(dialect, kind, folder, *faults, garbler=garble, device=None, settle_s=0.01, slew_mrad_s=math.inf):
    motion = MirrorMotion(PARK_MRAD, settle_s, slew_mrad_s, LIMIT_MRAD)
    one = device(motion) if device is not None else mirror_device(dialect, motion, LIMIT_MRAD)
    far = EmulatedSerial(one, wire(kind, folder), WireFaultPlan("mirror", faults), garbler)
    with far:
        bench = MirrorBench(dialect, far, motion, one)
        try:
            yield bench
        finally:
            for mirror in bench.opened:
                mirror.close()
