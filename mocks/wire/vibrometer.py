"""A Polytec OFV-5000 behind its RS-232 interface.

Where the replies come from: the PLACE laboratory package's driver, made after Polytec's "RS-232 Interface Commands:
OFV-5000 User Manual" (``Get,Controller,0,Name``, ``Get,VeloDec,n,Name``, ``Range``, ``SignalDelay``), and two further
public programs (``Get,SignalLevel,0,Value``, echo of commands, ``Set,Interface,0,Echo,Off``).

Not confirmed by a source: ``Not Available`` for a decoder that is not installed; whether values come with a comma.
"""

from __future__ import annotations

from wavefocus.mocks.wire.serial_far_side import SerialDevice


class PolytecDevice(SerialDevice):
    """A controller with one velocity decoder; it echoes commands until echo is switched off.

    range_text: The measurement range that is set.
    signal_delay: What the decoder says of its delay.
    signal_level: Strength of the reflected light, 0 to 775, or how the controller writes it.
    decoder: Number of the decoder; the others are not installed.
    echo: Whether commands are repeated before they are answered.
    name: The controller's.
    """

    role = "vibrometer"

    def __init__(
        self,
        range_text: str = "125mm/s/V",
        *,
        signal_delay: str = "8.16 us",
        signal_level: int | str = 600,
        decoder: int = 1,
        echo: bool = True,
        name: str = "OFV-5000",
    ) -> None:
        self._decoder = {"Name": "VD-09", "Range": range_text, "SignalDelay": signal_delay}
        self._decoder_number = decoder
        self._signal_level = signal_level
        self._power_up_echo = self._echo = echo
        self._name = name

    def operation(self, command: str) -> str:
        parts = command.split(",")
        if parts[0] != "Get" or len(parts) != 4:
            return parts[0].lower()
        if parts[1] == "Controller":
            return "identify"
        return {"Range": "range", "SignalDelay": "delay", "Value": "level"}.get(parts[3], parts[3].lower())

    def answer(self, command: str) -> str:
        echoed = f"{command}\n" if self._echo else ""
        answer = self._obey(command.split(","))
        return echoed + (f"{answer}\n" if answer else "")

    def refusal(self, command: str) -> str:
        return "Not Available\n"

    def impostor(self, command: str) -> str:
        return "OFV-2500\n"

    def restart(self) -> None:
        self._echo = self._power_up_echo

    def _obey(self, parts: list[str]) -> str:
        if parts[:3] == ["Set", "Interface", "0"] and parts[3:] in (["Echo", "Off"], ["Echo", "On"]):
            self._echo = parts[4] == "On"
            return ""
        if parts == ["Get", "Controller", "0", "Name"]:
            return self._name
        if parts == ["Get", "SignalLevel", "0", "Value"]:
            return str(self._signal_level)
        if parts[:2] == ["Get", "VeloDec"] and len(parts) == 4:
            installed = parts[2] == str(self._decoder_number)
            return self._decoder.get(parts[3], "Not Available") if installed else "Not Available"
        return "Not Available" if parts[0] == "Get" else ""
