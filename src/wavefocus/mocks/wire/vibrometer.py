"""Polytec OFV-5000 and OFV-3001 controllers behind their RS-232 interfaces.

OFV-5000: the PLACE laboratory package's driver, made after Polytec's "RS-232 Interface Commands: OFV-5000 User Manual"
(``GetDevInfo`` and ``Get`` of ``Controller``, ``Interface``, ``SensorHead`` and ``VeloDec``; echo
"can cause problems", so it is off; ``Set,VeloDec,n,Range,...`` without an answer; ``MaxFreq`` with a unit), three
further public programs (``GetDevInfo,Controller,0,Name`` as the first question, ``Get,SignalLevel,0,Value``; lower case
and CR LF), and the ranges in the choices of two more (``LP``, ``Off``).

Not confirmed by a source: ``Not Available`` for a decoder that is not installed; whether values come with a comma; the
maximum frequency of a range; how a range that the decoder does not have is answered (not at all here).

OFV-3001: its user manual, appendix E.2.4 and E.2.6 (``VELO?``, ``VELO1`` to ``VELO9`` without an answer, ``OVR``,
``LEV``, invalid settings ignored, the form of each answer with ``ECHOON``). Not confirmed: ``ECHOOFF`` and that it ends
the echo; whether it answers without ``REN``; that a range of a decoder which is not installed is ignored.
"""

import math
from abc import abstractmethod

from wavefocus.drivers.dialogue import RefusedError, UnreadableError
from wavefocus.drivers.vibrometer.polytec import FULL_LEVEL, OFV3001_RANGES, sensitivity_m_s_per_v
from wavefocus.mocks.wire.emulated_serial import SerialDevice

# Ranges of the VD-09 and VX-09 decoders as public programs offer them, each with its low-pass filter too.
_RANGES = ("5mm/s/V", "10mm/s/V", "20mm/s/V", "25mm/s/V", "50mm/s/V", "100mm/s/V", "125mm/s/V", "200mm/s/V",
          "250mm/s/V", "500mm/s/V", "1m/s/V", "1.25m/s/V", "2.5m/s/V")  # fmt: skip
_ALL_RANGES = (*_RANGES, *(f"{range_text} LP" for range_text in _RANGES), "Off")
_VELOCITY_RANGE = ("velodec", "range")
_NOT_AVAILABLE = "Not Available"


class VibrometerDevice(SerialDevice):
    """A vibrometer's controller."""

    role = "vibrometer"

    @property
    @abstractmethod
    def sensitivity_m_s_per_v(self) -> float:
        """Of the range that is set; infinite where there is no output."""


class PolytecDevice(VibrometerDevice):
    """An OFV-5000 with one velocity decoder.

    range_text: The measurement range that is set.
    signal_delay: What the decoder says of its delay.
    max_frequency: What it says of its maximum frequency.
    signal_level: Strength of the reflected light, 0 to 775, or how the controller writes it.
    decoder: Number of the decoder; the others are not installed.
    echo: Whether commands are repeated before they are answered, until that is switched off.
    name: The controller's.
    """

    def __init__(
        self,
        range_text: str = "125mm/s/V",
        *,
        signal_delay: str = "8.16 us",
        max_frequency: str = "1.5MHz",
        signal_level: int | str = 600,
        decoder: int = 1,
        echo: bool = False,
        name: str = "OFV-5000",
    ) -> None:
        self._power_up_echo = self._echo = echo
        velocity = ("velodec", str(decoder))
        self._values: dict[tuple[str, ...], str] = {
            ("controller", "0", "name"): name,
            ("controller", "0", "version"): "2.1",
            ("interface", "0", "name"): "RS-232",
            ("interface", "0", "baudrate"): str(self.baud),
            ("sensorhead", "0", "name"): "OFV-505",
            ("signallevel", "0", "value"): str(signal_level),
            (*velocity, "name"): "VD-09",
            (*velocity, "range"): range_text,
            (*velocity, "signaldelay"): signal_delay,
            (*velocity, "maxfreq"): max_frequency,
        }
        self._choices: dict[tuple[str, ...], str] = {
            ("controller", "0", "name"): f"{name} Vibrometer Controller",
            ("interface", "0", "echo"): "On,Off",
            ("interface", "0", "baudrate"): "9600,19200,57600,115200",
            (*velocity, "range"): ",".join(_ALL_RANGES),
        }
        """What ``GetDevInfo`` answers where that is not the present value."""

    @property
    def sensitivity_m_s_per_v(self) -> float:
        """Of the range that is set; infinite where that is ``Off`` or not a range."""
        try:
            return sensitivity_m_s_per_v(
                next(text for key, text in self._values.items() if key[::2] == _VELOCITY_RANGE)
            )
        except (RefusedError, UnreadableError):
            return math.inf

    def operation(self, command: str) -> str:
        parts = command.lower().split(",")
        if not parts[0].startswith("get") or len(parts) != 4:
            return parts[0]
        if parts[1] == "controller":
            return "identify"
        return {"signaldelay": "delay", "value": "level"}.get(parts[3], parts[3])

    def answer(self, command: str) -> str:
        echoed = f"{command}\n" if self._echo else ""
        answer = self._obey(command.strip())
        return echoed + (f"{answer}\n" if answer else "")

    def refusal(self, command: str) -> str:
        return f"{_NOT_AVAILABLE}\n"

    def impostor(self, command: str) -> str:
        return "OFV-2500\n"

    def restart(self) -> None:
        self._echo = self._power_up_echo

    def _obey(self, command: str) -> str:
        verb, *rest = command.split(",")
        key = tuple(word.lower() for word in rest[:3])
        value = ",".join(rest[3:])
        if verb.lower() == "set":
            self._set(key, value)
            return ""
        values = self._values | {("interface", "0", "echo"): "On" if self._echo else "Off"}
        if verb.lower() == "getdevinfo":
            values |= self._choices
        return values.get(key, _NOT_AVAILABLE) if verb.lower() in {"get", "getdevinfo"} else ""

    def _set(self, key: tuple[str, ...], value: str) -> None:
        if key == ("interface", "0", "echo") and value in {"On", "Off"}:
            self._echo = value == "On"
        elif key in self._values and key[::2] == _VELOCITY_RANGE and value.replace(" m", "m") in _ALL_RANGES:
            self._values[key] = value


class Ofv3001Device(VibrometerDevice):
    """An OFV-3001.

    range_number: The measurement range that is set, 1 to 9.
    decoders: Velocity decoders that are installed.
    signal_level: Strength of the reflected light, 0 to 40.
    echo: Whether answers repeat the command, as after ``ECHOON``.
    needs_remote: Whether it answers nothing before ``REN``.
    """

    baud = 9600

    def __init__(
        self,
        range_number: int = 3,
        *,
        decoders: tuple[str, ...] = ("OVD-01", "OVD-02"),
        signal_level: int = 31,
        echo: bool = False,
        needs_remote: bool = False,
    ) -> None:
        self._range_number = range_number
        self._decoders = decoders
        self._level = min(signal_level, FULL_LEVEL)
        self._power_up = (echo, not needs_remote)
        self._echo, self._remote = self._power_up

    @property
    def sensitivity_m_s_per_v(self) -> float:
        return 1e-3 * OFV3001_RANGES[self._range_number][1]

    def operation(self, command: str) -> str:
        return {"VELO?": "range", "LEV": "level", "REN": "enable"}.get(command, command)

    def answer(self, command: str) -> str:
        self._remote = self._remote or command == "REN"
        if not self._remote:
            return ""
        if command in {"ECHOON", "ECHOOFF"}:
            self._echo = command == "ECHOON"
        values = {"VELO?": ("VELO", self._range_number), "LEV": ("LEV", self._level), "OVR": ("OVR", 0)}
        if command in values:
            word, value = values[command]
            return f"{word if self._echo else ''}{value}\n"
        self._set(command)
        return f"{command}\n" if self._echo else ""

    def refusal(self, command: str) -> str:
        return ""

    def impostor(self, command: str) -> str:
        return "OFV-2500\n"

    def restart(self) -> None:
        self._echo, self._remote = self._power_up

    def _set(self, command: str) -> None:
        digit = command.removeprefix("VELO")
        number = int(digit) if command.startswith("VELO") and digit.isdecimal() else 0
        if number in OFV3001_RANGES and OFV3001_RANGES[number][0] in self._decoders:
            self._range_number = number


VIBROMETER_DRIVERS = ("polytec-ofv5000", "polytec-ofv3001")


def vibrometer_device(driver: str, sensitivity_m_s_per_v: float, latency_s: float) -> VibrometerDevice:
    """A controller as a driver of the rig file speaks to it, set to a sensitivity. Raises ValueError.

    latency_s: What an OFV-5000 states as its decoder's delay.
    """
    range_mm = 1000 * sensitivity_m_s_per_v
    if driver == "polytec-ofv5000":
        return PolytecDevice(f"{range_mm:g}mm/s/V", signal_delay=f"{1e6 * latency_s:g} us")
    if driver != "polytec-ofv3001":
        raise ValueError(f"vibrometer.driver = {driver!r} cannot be emulated; {' and '.join(VIBROMETER_DRIVERS)} can")
    for number, (_, mm_s_per_v) in OFV3001_RANGES.items():
        if math.isclose(mm_s_per_v, range_mm, rel_tol=1e-6):
            return Ofv3001Device(number)
    allowed = ", ".join(f"{mm / 1000:g}" for mm in sorted({mm for _, mm in OFV3001_RANGES.values()}))
    raise ValueError(
        f"vibrometer.sensitivity_m_s_per_v = {sensitivity_m_s_per_v:g}: an OFV-3001 has only the ranges {allowed}"
    )
