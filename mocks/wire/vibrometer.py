"""A Polytec OFV-5000 behind its RS-232 interface.

Where the replies come from: the PLACE laboratory package's driver, made after Polytec's "RS-232 Interface Commands:
OFV-5000 User Manual" (``GetDevInfo`` and ``Get`` of ``Controller``, ``Interface``, ``SensorHead`` and ``VeloDec``; echo
"can cause problems", so it is off; ``Set,VeloDec,n,Range,...`` without an answer; ``MaxFreq`` with a unit), three
further public programs (``GetDevInfo,Controller,0,Name`` as the first question, ``Get,SignalLevel,0,Value``; lower case
and CR LF), and the ranges in the choices of two more (``LP``, ``Off``).

Not confirmed by a source: ``Not Available`` for a decoder that is not installed; whether values come with a comma; the
maximum frequency of a range; how a range that the decoder does not have is answered (not at all here).
"""

from __future__ import annotations

import math

from wavefocus.drivers.dialogue import RefusedError, UnreadableError
from wavefocus.drivers.vibrometer.polytec import sensitivity_m_s_per_v
from wavefocus.mocks.wire.emulated_serial import SerialDevice

# Ranges of the VD-09 and VX-09 decoders as public programs offer them, each with its low-pass filter too.
RANGES = ("5mm/s/V", "10mm/s/V", "20mm/s/V", "25mm/s/V", "50mm/s/V", "100mm/s/V", "125mm/s/V", "200mm/s/V",
          "250mm/s/V", "500mm/s/V", "1m/s/V", "1.25m/s/V", "2.5m/s/V")  # fmt: skip
ALL_RANGES = (*RANGES, *(f"{range_text} LP" for range_text in RANGES), "Off")
VELOCITY_RANGE = ("velodec", "range")
NOT_AVAILABLE = "Not Available"


class PolytecDevice(SerialDevice):
    """A controller with one velocity decoder.

    range_text: The measurement range that is set.
    signal_delay: What the decoder says of its delay.
    max_frequency: What it says of its maximum frequency.
    signal_level: Strength of the reflected light, 0 to 775, or how the controller writes it.
    decoder: Number of the decoder; the others are not installed.
    echo: Whether commands are repeated before they are answered, until that is switched off.
    name: The controller's.
    """

    role = "vibrometer"

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
            (*velocity, "range"): ",".join(ALL_RANGES),
        }
        """What ``GetDevInfo`` answers where that is not the present value."""

    @property
    def sensitivity_m_s_per_v(self) -> float:
        """Of the range that is set; infinite where that is ``Off`` or not a range."""
        try:
            return sensitivity_m_s_per_v(next(text for key, text in self._values.items() if key[::2] == VELOCITY_RANGE))
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
        return f"{NOT_AVAILABLE}\n"

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
        return values.get(key, NOT_AVAILABLE) if verb.lower() in {"get", "getdevinfo"} else ""

    def _set(self, key: tuple[str, ...], value: str) -> None:
        if key == ("interface", "0", "echo") and value in {"On", "Off"}:
            self._echo = value == "On"
        elif key in self._values and key[::2] == VELOCITY_RANGE and value.replace(" m", "m") in ALL_RANGES:
            self._values[key] = value
