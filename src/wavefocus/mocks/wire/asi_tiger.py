r"""An ASI Tiger controller on its serial line.

Where the replies come from (long names of the sources stand in the driver's module):

=================================  ============================================================================
reply                              source
=================================  ============================================================================
``BU``, ``BU X``, ``2BU X``        ASI's page ``commands/build``; modules and raw addresses: Micro-Manager,
                                   ``ASIHub.cpp`` (``GetBuildInfo``) and ``ASIPeripheralBase.h``
``VB F=0``, ``VB F=1``             Micro-Manager, ``ASITigerComm.cpp``; answers of ``F=1``: ASI's page ``commands/pm``
``UM A?``, ``SL A?``, ``SU A?``    Micro-Manager, ``ASIScanner.cpp``; form of the answer: Tiger manual, "Query of
                                   Parameters"
``PM A?``, ``PM A=0``              ASI's page ``commands/pm`` (MEMS cards), ``ASIScanner.cpp`` (``OnOutputMode``)
``M``, ``W``, ``/``                Tiger manual, "Command: MOVE", "WHERE", "STATUS"
``MOVE``, ``WHERE``, ``STATUS``    long names: the same pages of the manual
``V``, ``CD``, address 0           Micro-Manager, ``ASITigerComm.cpp`` (``0 V`` -> ``:A v3.30``, ``0 CD``, ``0 BU``)
``VB X=n``                         ASI's page ``commands/vb``: bits 8 (replies end with CR) and 16 (target printed)
``:N-1`` ... ``:N-7``              Tiger manual, "Error Codes"
banner after power-up              Tiger manual, "Tiger Banner"
=================================  ============================================================================

Not confirmed by a source: names of the cards' builds, the spaces at the ends of some answers, how a move prints its
target, and whether the answer to ``VB X=n`` itself ends in the old way or the new one.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Literal

from wavefocus.mocks.virtual.mirror import MirrorMotion
from wavefocus.mocks.wire.emulated_serial import MirrorDevice, number

_Board = Literal["mems", "dac_4ch", "signal_dac", "stage"]
_ASI_AXIS = re.compile(r"([A-Z])(?:=(\S+))?")
# "MicroMirror Drive Card User Guide": largest angle of its mirror in x and in y.
_MEMS_DEGREES = 4.6
_STAGE_AXES = ("X", "Y")
_STAGE_CARD = "1"
# Bits of VB X.
_CR_ONLY, _PRINT_TARGET = 8, 16
_COMM_ADDRESS, _BUILD_NAME = "0", "TIGER_COMM"
_SHORT_NAMES = {"BUILD": "BU", "MOVE": "M", "WHERE": "W", "STATUS": "/", "SETLOW": "SL", "SETUP": "SU", "UNITS": "UM",
               "VERSION": "V", "CDATE": "CD"}  # fmt: skip
_MODULES: dict[_Board, tuple[str, ...]] = {
    "mems": ("RING BUFFER 250", "MM_TARGET"),
    "dac_4ch": ("DAC_4CH", "RING BUFFER 250"),
    "signal_dac": ("DAC_4CH", "SIGNAL_DAC", "RING BUFFER 250"),
    "stage": (),
}


@dataclass(frozen=True, slots=True)
class Card:
    """A card in the rack: its build's name, raw address, letters and type of its axes, and firmware modules."""

    name: str
    address: str
    axes: tuple[str, ...]
    kind: str
    modules: tuple[str, ...]


class AsiTigerDevice(MirrorDevice):
    """A TG-1000 with an XY stage and, as a rule, one scanner card.

    axes: Letters of the scanner's two axes.
    board: ``"mems"``: a micro-mirror card; ``"dac_4ch"``, ``"signal_dac"``: cards with analog outputs, for galvos;
        ``"stage"``: no scanner card at all.
    units_per_degree: What ``UM`` answers.
    limit_degrees: What ``SU`` and, negative, ``SL`` answer.
    beam_per_mirror: Optical degrees per degree of the controller.
    external_input: Whether a MEMS card follows its analog inputs (``PM`` 1) after power-up, so that no serial move
        moves the mirror.
    tiger_syntax: Whether answers are in the Tiger's own syntax (``VB F=1``) when the line is opened.
    verbosity: What ``VB X`` was saved as: the sum of its bits after every power-up.
    address: Raw address of the scanner card: ``"2"``, or a character from 0x81 to 0xF5.
    """

    name = "asi-tiger"
    command_end = "\r"

    def __init__(
        self,
        motion: MirrorMotion,
        axes: tuple[str, str] = ("A", "B"),
        *,
        board: _Board = "mems",
        units_per_degree: float = 1000.0,
        limit_degrees: float = _MEMS_DEGREES,
        beam_per_mirror: float = 2.0,
        external_input: bool = False,
        tiger_syntax: bool = False,
        verbosity: int = 0,
        address: str = "2",
    ) -> None:
        super().__init__(motion)
        self._axes = axes if board != "stage" else ()
        self._units_per_degree = units_per_degree
        self._units_per_mrad = units_per_degree * math.degrees(1e-3) / beam_per_mirror
        self._limit_degrees = limit_degrees
        self._external_at_power_up = external_input
        # On MEMS cards the input mode, on the others the range of the outputs.
        self._modes = dict.fromkeys(self._axes, int(external_input) if board == "mems" else 1)
        self._board = board
        self._tiger_syntax = tiger_syntax
        self._saved_verbosity = self._verbosity = verbosity
        self._cards = [Card("STD_XY", _STAGE_CARD, _STAGE_AXES, "x", ())]
        if board != "stage":
            self._cards.append(Card(board.upper(), address, axes, "u", _MODULES[board]))
        self.stage_units = dict.fromkeys(_STAGE_AXES, 0.0)
        """Where the XY stage stands, in tenths of a micrometre."""

    @property
    def modes(self) -> dict[str, int]:
        """What ``PM`` is set to, axis by axis of the scanner."""
        return dict(self._modes)

    @classmethod
    def turning(cls, motion: MirrorMotion, full_scale_mrad: float | None) -> AsiTigerDevice:
        if full_scale_mrad is None:
            return cls(motion)
        # Beyond what micro-mirrors turn by, it is a galvo.
        return cls(motion, board="dac_4ch", limit_degrees=math.degrees(full_scale_mrad / 2000))

    def operation(self, command: str) -> str:
        address, verb, _ = self._parsed(command)
        if address is not None:
            return f"card {verb.lower()}"  # only the controller says who it is
        return {"BU": "identify", "M": "move", "/": "busy", "W": "where", "UM": "units"}.get(verb, verb.lower())

    def answer(self, command: str) -> str:
        end = "\r" if self._verbosity & _CR_ONLY else "\r\n"
        return self._obey(*self._parsed(command)).removesuffix("\r\n") + end

    def _parsed(self, command: str) -> tuple[str | None, str, str]:
        """Address of the card (None without one, empty where no card has it), short name, and the rest."""
        text, address = command.strip(" "), None
        if text[:1].isdigit() or text[:1] > "~":
            known = [_COMM_ADDRESS, *(card.address for card in self._cards)]
            address, text = (text[0] if text[0] in known else ""), text[1:].strip(" ")
        verb, _, rest = text.upper().partition(" ")
        return address, _SHORT_NAMES.get(verb, verb), rest

    def _obey(self, address: str | None, verb: str, rest: str) -> str:
        if address == "":
            return ":N-7\r\n"
        card = next((card for card in self._cards if card.address == address), None)
        if verb == "BU":
            return self._build(card, rest.strip() == "X")
        if verb == "VB":
            return self._choose_syntax(rest)
        if verb in {"V", "CD"}:
            return ":A v3.30 \r\n" if verb == "V" else "Mar 01 2019:15:42:05\r\n"
        if card is not None:
            return ":N-7\r\n"  # no other command to a card is needed here
        if verb == "/":
            return "B\r\n" if self._motion.busy() else "N\r\n"
        if verb == "PM" and "=" in rest:
            return self._set_modes(rest)
        if verb in {"UM", "PM", "SL", "SU"}:
            return self._settings(verb, rest)
        if verb == "M":
            return self._move(rest)
        return self._where(rest) if verb == "W" else ":N-1\r\n"

    def refusal(self, command: str) -> str:
        return ":N-5\r\n"

    def impostor(self, command: str) -> str:
        return self._overview("OTHER_COMM")

    def restart(self) -> None:
        self._verbosity = self._saved_verbosity
        self._modes = dict.fromkeys(self._axes, int(self._external_at_power_up) if self._board == "mems" else 1)
        self._motion.start(0.0, 0.0)

    def banner(self) -> str:
        """What it sends by itself once it has started."""
        names = {"x": "XYMotor", "u": "Scanner"}
        cards = [
            f"At {ord(card.address):02X}: {','.join(f'{axis}:{names[card.kind]}' for axis in card.axes)}"
            f" v3.30 {card.name} Mar 01 2019:15:42:05"
            for card in self._cards
        ]
        return "\r".join([f"At 30: Comm v3.30 {_BUILD_NAME} Mar 01 2019:15:42:05", *cards]) + "\r\n"

    def _build(self, card: Card | None, in_full: bool) -> str:
        if not in_full:
            return f"{card.name if card else _BUILD_NAME}\r\n"
        return self._overview(_BUILD_NAME) if card is None else self._rows(card.name, [card], card.modules)

    def _overview(self, name: str) -> str:
        return self._rows(name, self._cards, ())

    @staticmethod
    def _rows(name: str, cards: list[Card], modules: tuple[str, ...]) -> str:
        axes = [(axis, card) for card in cards for axis in card.axes]
        rows = (
            name,
            "Motor Axes: " + " ".join(axis for axis, _ in axes),
            "Axis Types: " + " ".join(card.kind for _, card in axes),
            "Axis Addr: " + " ".join(card.address for _, card in axes),
            "Hex Addr: " + " ".join(f"{ord(card.address):02X}" for _, card in axes),
            "Axis Props:   " + "   ".join("0" for _ in axes),
            *modules,
        )
        return "\r".join(rows) + "\r\n"

    def _choose_syntax(self, rest: str) -> str:
        """``VB``: F the syntax of answers, X bits of verbosity."""
        for part in rest.split():
            key, _, text = part.partition("=")
            if key == "F" and text in {"0", "1"}:
                self._tiger_syntax = text == "1"
            elif key == "X" and text.isdecimal():
                self._verbosity = int(text)
        return ":A \r\n"

    def _listed(self, values: dict[str, str], plain: str) -> str:
        """Values of axes in the syntax that is chosen."""
        named = " ".join(f"{axis}={value}" for axis, value in values.items())
        return f"{named} :A\r\n" if self._tiger_syntax else f"{plain.format(named=named)}\r\n"

    def _settings(self, verb: str, rest: str) -> str:
        asked = [axis.rstrip("?") for axis in rest.split()]
        if not asked:
            return ":N-3\r\n"
        if any(axis not in (*self._axes, *_STAGE_AXES) for axis in asked):
            return ":N-2\r\n"
        values = {}
        for axis in (*_STAGE_AXES, *self._axes):
            if axis not in asked:
                continue
            stage = axis in _STAGE_AXES
            if verb == "PM":
                if stage:
                    return ":N-2\r\n"
                values[axis] = str(self._modes[axis])
            elif verb == "UM":
                values[axis] = f"{10_000.0 if stage else self._units_per_degree:.3f}"
            else:
                end = 50.0 if stage else self._limit_degrees
                values[axis] = f"{end if verb == 'SU' else -end:.3f}"
        return self._listed(values, ":A {named}")

    def _set_modes(self, rest: str) -> str:
        for part in rest.split():
            found = _ASI_AXIS.fullmatch(part)
            mode = number(found.group(2)) if found else None
            if found is None or found.group(1) not in self._modes:
                return ":N-2\r\n"
            if mode is None:
                return ":N-3\r\n"
            self._modes[found.group(1)] = int(mode)
        return ":A \r\n"

    def _units(self) -> dict[str, float]:
        """Where every axis stands, in its own units, in the order of the hardware."""
        angles = dict(zip(self._axes, self._motion.where_mrad(), strict=False))
        return self.stage_units | {axis: angle * self._units_per_mrad for axis, angle in angles.items()}

    def _move(self, rest: str) -> str:
        parts = rest.split()
        if not parts:
            return ":N-3\r\n"
        targets: list[str] = []
        stage: dict[str, float] = {}
        target = list(self._motion.where_mrad())
        for part in parts:
            found = _ASI_AXIS.fullmatch(part)
            if found is None or found.group(1) not in (*self._axes, *_STAGE_AXES):
                return ":N-2\r\n"
            axis, units = found.group(1), number(found.group(2))
            if units is None:
                return ":N-3\r\n"
            targets.append(f"{units:.1f}")
            if axis in _STAGE_AXES:
                stage[axis] = units
            # Rounding of UM and SL to the digits of an answer.
            elif abs(units) > (self._limit_degrees + 1e-3) * self._units_per_degree:
                return ":N-4\r\n"
            else:
                target[self._axes.index(axis)] = units / self._units_per_mrad
        if not self._motion.reaches(*target):
            return ":N-4\r\n"
        self.stage_units.update(stage)
        if self._axes and not (self._board == "mems" and any(self._modes.values())):
            self._motion.start(*target)
        return f":A {' '.join(targets)} \r\n" if self._verbosity & _PRINT_TARGET else ":A \r\n"

    def _where(self, rest: str) -> str:
        asked = rest.split()
        if not asked or any(axis not in (*self._axes, *_STAGE_AXES) for axis in asked):
            return ":N-2\r\n" if asked else ":N-3\r\n"
        # In the order of the hardware, whatever the order of the question.
        values = {axis: f"{units:.1f}" for axis, units in self._units().items() if axis in asked}
        return self._listed(values, f":A {' '.join(values.values())} ")
