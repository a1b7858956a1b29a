"""Outputs of an NI device: analog ones that are written together, and a digital line; written at once, without a clock.

An output keeps its level when its task ends, until it is written again, the device is reset or loses its power.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from wavefocus.drivers.daq.ni.ni_session import NiSession
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import Clock, DeviceIdentity, WallClock

RAMP_STEP_S = 1e-3
"""Time between two steps of a ramp; a write over USB takes about as long."""


class OutputTask:
    """A task of outputs that this program alone may write. Raises InstrumentError: another task has one of them."""

    def __init__(self, session: NiSession, names: Sequence[str], key: str) -> None:
        self._session = session
        self._names = tuple(names)
        with session.explaining("preparing its outputs"):
            known = self._known()
        for name in names:
            if name not in known:
                cause = f"{session.identity.product} has no output {name!r}"
                there = ", ".join(known) or "no output of this kind"
                raise InstrumentError(session.instrument, "preparing its outputs", cause, f"{key}: there is {there}")
        with session.explaining("preparing its outputs"):
            self._task = session.new_task()
            try:
                self._configure()
                self._task.start()
            except BaseException:
                with suppress(Exception):  # the first failure is the one to act on
                    self._task.close()
                raise

    def close(self) -> None:
        """Release the outputs; each keeps its level."""
        with self._session.explaining("closing"):
            self._task.close()

    def _physical(self) -> str:
        return ", ".join(f"{self._session.device}/{name}" for name in self._names)

    def _known(self) -> tuple[str, ...]:
        raise NotImplementedError

    def _configure(self) -> None:
        raise NotImplementedError


class AnalogOutputs(OutputTask):
    """Analog outputs that are written together.

    limit_v: Largest voltage to either side, > 0.
    level_v: Voltages that the outputs were put at last; they cannot be read back.
    """

    def __init__(
        self, session: NiSession, names: Sequence[str], key: str, limit_v: float, level_v: tuple[float, ...]
    ) -> None:
        self._limit_v = limit_v
        self.level_v = level_v
        super().__init__(session, names, key)

    def write(self, volts: Sequence[float], doing: str) -> None:
        """Put voltages at the outputs at once."""
        from nidaqmx.stream_writers import AnalogMultiChannelWriter

        with self._session.explaining(doing):
            writer = AnalogMultiChannelWriter(self._task.out_stream, auto_start=True)
            writer.verify_array_shape = False  # it would ask the device for the number of channels each time
            writer.write_one_sample(np.asarray(volts, dtype=np.float64))
        self.level_v = tuple(volts)

    def ramp_to(self, volts: Sequence[float], slew_v_per_s: float, clock: Clock, doing: str) -> None:
        """Move to voltages no faster than a slew rate (> 0); it returns when they are there."""
        due_s = clock.now_s()
        # The last one also where nothing changes, for the device may have lost its power.
        for step_v in ramp_steps(self.level_v, volts, slew_v_per_s) or [tuple(volts)]:
            if (wait_s := due_s - clock.now_s()) > 0:
                clock.sleep(wait_s)
            self.write(step_v, doing)
            due_s = max(due_s, clock.now_s()) + RAMP_STEP_S

    def _known(self) -> tuple[str, ...]:
        return _last_names(self._session.handle.ao_physical_chans.channel_names, self._session.device)

    def _configure(self) -> None:
        self._task.ao_channels.add_ao_voltage_chan(self._physical(), min_val=-self._limit_v, max_val=self._limit_v)


class DigitalLine(OutputTask):
    """A digital line: ``"port1/line0"``."""

    def write(self, level: bool, doing: str) -> None:
        """Put it high (True) or low, and read it back. Raises InstrumentError: it reads otherwise."""
        from nidaqmx.stream_readers import DigitalSingleChannelReader
        from nidaqmx.stream_writers import DigitalSingleChannelWriter

        with self._session.explaining(doing):
            DigitalSingleChannelWriter(self._task.out_stream, auto_start=True).write_one_sample_one_line(level)
            found = DigitalSingleChannelReader(self._task.in_stream).read_one_sample_one_line()
        if bool(found) != level:
            cause = f"{self._names[0]} was set {_word(level)} and reads {_word(not level)}"
            raise InstrumentError(self._session.instrument, doing, cause, "check what is wired to the line")

    def _known(self) -> tuple[str, ...]:
        return _last_names(self._session.handle.do_lines.channel_names, self._session.device)

    def _configure(self) -> None:
        self._task.do_channels.add_do_chan(self._physical())


@dataclass(frozen=True, slots=True)
class OutputSettings:
    """Outputs of one device.

    role: Table of the rig file that names them.
    key: Its keys that name the outputs.
    kind: Analog outputs, or one digital line.
    names: ``("ao0", "ao1")`` or ``("port1/line0",)``.
    rest: Volts, or 0 and 1, to leave them at.
    limit_v, slew_v_per_s: Largest voltage to either side, and its fastest change; of analog outputs.
    """

    role: Literal["mirror", "shutter"]
    key: str
    kind: Literal["analog", "digital"]
    device: str
    address: str | None
    names: tuple[str, ...]
    rest: tuple[float, ...]
    limit_v: float = 10.0
    slew_v_per_s: float = 1e6


ANSWER_S = 5.0


class NiOutputs:
    """Outputs of one device, here; see `OutputSettings`. Raises InstrumentError.

    level: What they are at, as far as that is known.
    known: Whether the device has answered before.
    """

    ends_within_s = 10.0

    def __init__(self, settings: OutputSettings, level: tuple[float, ...], known: bool) -> None:
        self._settings = settings
        self._session = session = NiSession(
            settings.device, settings.address, ANSWER_S, role=settings.role, known=known
        )
        self._outputs: AnalogOutputs | DigitalLine
        if settings.kind == "analog":
            self._outputs = AnalogOutputs(session, settings.names, settings.key, settings.limit_v, level)
        else:
            self._outputs = DigitalLine(session, settings.names, settings.key)

    def identify(self) -> DeviceIdentity:
        """Ask the device who it is."""
        with self._session.explaining("identifying"):
            return self._session.ask_identity()

    def write(self, level: tuple[float, ...], doing: str) -> None:
        """Put outputs at voltages, no faster than their slew rate, or a line at 0 or 1; return when they are there."""
        if isinstance(self._outputs, AnalogOutputs):
            self._outputs.ramp_to(level, self._settings.slew_v_per_s, WallClock(), doing)
        else:
            self._outputs.write(bool(level[0]), doing)

    def come_to_rest(self) -> None:
        """Write what the settings say for the end."""
        self.write(self._settings.rest, "coming to rest")

    def close(self) -> None:
        """Release the outputs; each keeps its level."""
        with suppress(InstrumentError):
            self._outputs.close()
        self._session.close()


def ramp_steps(start_v: Sequence[float], stop_v: Sequence[float], slew_v_per_s: float) -> list[tuple[float, ...]]:
    """Voltages of a straight ramp, `RAMP_STEP_S` apart, its last step at the end; none where nothing changes.

    slew_v_per_s: Fastest change of any output, > 0.
    """
    way_v = max(abs(stop - start) for start, stop in zip(start_v, stop_v, strict=True))
    count = math.ceil(way_v / (slew_v_per_s * RAMP_STEP_S) - 1e-9)
    return [
        tuple(start + (stop - start) * step / count for start, stop in zip(start_v, stop_v, strict=True))
        for step in range(1, count + 1)
    ]


def _last_names(names: Sequence[str], device: str) -> tuple[str, ...]:
    return tuple(name.removeprefix(f"{device}/") for name in names)


def _word(level: Any) -> str:
    return "high" if level else "low"
