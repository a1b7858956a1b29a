"""Shutters and interlocks that block the laser beam (a driver is a module here), and the mirror behind one.

Its shutter is open while the beam stands where it was sent, closed at rest and after every failure.
"""

from collections.abc import Callable, Iterator
from contextlib import contextmanager

from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Clock, DeviceIdentity, Mirror, Shutter
from wavefocus.drivers.timeouts import in_time

_SHUTTER_CALL_S = 8.0
"""Longest call to a shutter, less than a call to the mirror may take: the mirror is parked all the same."""


class ShutteredMirror(Mirror):
    """Points the laser and blocks it.

    A shutter that does not answer is an error of the mirror's calls: nothing is measured without it. The mirror is
    parked and released all the same.

    opens_s: Time that the shutter takes to open, in s, >= 0.

    Raises InstrumentError: the shutter cannot be closed now.
    """

    def __init__(self, mirror: Mirror, shutter: Shutter, opens_s: float, clock: Clock) -> None:
        self._mirror, self._shutter, self._opens_s, self._clock = mirror, shutter, opens_s, clock
        self._is_open = True  # as far as is known
        self._closed = False
        self.block()

    @property
    def identity(self) -> DeviceIdentity:
        return self._mirror.identity

    def identify(self) -> str:
        return f"{self._mirror.identify()}; {self._shutter.identify()}"

    def move_to(self, x_mrad: float, y_mrad: float) -> None:
        with self._blocked_on_failure():
            self._mirror.move_to(x_mrad, y_mrad)

    def wait_settled(self, timeout_s: float) -> None:
        with self._blocked_on_failure():
            self._mirror.wait_settled(timeout_s)
            # Also where it is open as far as is known: its process closes it while this program is stopped.
            was_open, self._is_open = self._is_open, True
            in_time("shutter", "opening", self._shutter.open_beam, _SHUTTER_CALL_S)
            if not was_open:
                self._clock.sleep(self._opens_s)

    def block(self) -> None:
        """Close the shutter, unless it is known to be closed."""
        if self._is_open:
            in_time("shutter", "closing", self._shutter.block_beam, _SHUTTER_CALL_S)
            self._is_open = False

    def park(self) -> None:
        self._each(self.block, self._mirror.park)

    def where_mrad(self) -> tuple[float, float] | None:
        return self._mirror.where_mrad()

    def reconnect(self) -> None:
        """Connect mirror and shutter afresh, and close the shutter."""
        self._is_open = True
        in_time("shutter", "reconnecting", self._shutter.reconnect, _SHUTTER_CALL_S)
        self.block()
        self._mirror.reconnect()

    def close(self) -> None:
        if self._closed:
            return
        self._closed = self._is_open = True
        try:
            self._each(self.block, self._mirror.close)
        finally:
            self._shutter.close()
            self._is_open = False

    @contextmanager
    def _blocked_on_failure(self) -> Iterator[None]:
        try:
            yield
        except BaseException as failure:
            try:
                self.block()
            except InstrumentError as also:
                failure.add_note(str(also))
            raise

    @staticmethod
    def _each(*steps: Callable[[], None]) -> None:
        """Do every step, whatever the others do; raises the first failure, the others as its notes."""
        failures: list[InstrumentError] = []
        for step in steps:
            try:
                step()
            except InstrumentError as failure:
                failures.append(failure)
        if failures:
            first, *others = failures
            for other in others:
                first.add_note(str(other))
            raise first
