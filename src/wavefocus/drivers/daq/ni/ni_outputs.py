"""Outputs of an NI device: analog ones that are written together, and a digital line; written at once, without a clock.

An output keeps its level when its task ends, until it is written again, the device is reset or loses its power.
"""

import math
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Literal

import numpy as np

from wavefocus.drivers.daq.ni.ni_session import NiSession
from wavefocus.drivers.errors import InstrumentError
from wavefocus.drivers.protocols import DeviceIdentity, WallClock

RAMP_STEP_S = 1e-3
"""Time between two steps of a ramp; a write over USB takes about as long."""


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
    """Outputs of one device, here; see `OutputSettings`. No other task may have one of them. Raises InstrumentError.

    level: What they are at, as far as that is known; analog outputs cannot be read back.
    known: Whether the device has answered before.
    """

    ends_within_s = 10.0

    def __init__(self, settings: OutputSettings, level: tuple[float, ...], known: bool) -> None:
        self._settings, self._level = settings, level
        self._session = session = NiSession(
            settings.device, settings.address, ANSWER_S, role=settings.role, known=known
        )
        doing = "preparing its outputs"
        self._require_outputs(doing)
        with session.explaining(doing):
            self._task = session.new_task()
            try:
                physical = ", ".join(f"{settings.device}/{name}" for name in settings.names)
                if settings.kind == "analog":
                    limit_v = settings.limit_v
                    self._task.ao_channels.add_ao_voltage_chan(physical, min_val=-limit_v, max_val=limit_v)
                else:
                    self._task.do_channels.add_do_chan(physical)
                self._task.start()
            except BaseException:
                with suppress(Exception):  # the first failure is the one to act on
                    self._task.close()
                raise

    def identify(self) -> DeviceIdentity:
        """Ask the device who it is."""
        with self._session.explaining("identifying"):
            return self._session.ask_identity()

    def write(self, level: tuple[float, ...], doing: str) -> None:
        """Put outputs at voltages, no faster than their slew rate, or a line at 0 or 1; return when they are there."""
        if self._settings.kind == "analog":
            self._ramp(level, doing)
        else:
            self._set_line(bool(level[0]), doing)

    def come_to_rest(self) -> None:
        """Write what the settings say for the end."""
        self.write(self._settings.rest, "coming to rest")

    def close(self) -> None:
        """Release the outputs; each keeps its level."""
        with suppress(InstrumentError), self._session.explaining("closing"):
            self._task.close()
        self._session.close()

    def _require_outputs(self, doing: str) -> None:
        """Refuse names that the device has not."""
        device, session = self._settings.device, self._session
        with session.explaining(doing):
            there = session.handle.ao_physical_chans if self._settings.kind == "analog" else session.handle.do_lines
            known = [name.removeprefix(f"{device}/") for name in there.channel_names]
        for name in self._settings.names:
            if name not in known:
                cause = f"{session.identity.product} has no output {name!r}"
                remedy = f"{self._settings.key}: there is {', '.join(known) or 'no output of this kind'}"
                raise InstrumentError(session.instrument, doing, cause, remedy)

    def _ramp(self, volts: tuple[float, ...], doing: str) -> None:
        from nidaqmx.stream_writers import AnalogMultiChannelWriter

        clock = WallClock()
        due_s = clock.now_s()
        # The last one also where nothing changes, for the device may have lost its power.
        for step_v in _ramp_steps(self._level, volts, self._settings.slew_v_per_s) or [volts]:
            clock.sleep(due_s - clock.now_s())
            with self._session.explaining(doing):
                writer = AnalogMultiChannelWriter(self._task.out_stream, auto_start=True)
                writer.verify_array_shape = False  # it would ask the device for the number of channels each time
                writer.write_one_sample(np.asarray(step_v, dtype=np.float64))
            self._level = step_v
            due_s = max(due_s, clock.now_s()) + RAMP_STEP_S

    def _set_line(self, level: bool, doing: str) -> None:
        """Put a line high or low, and read it back. Raises InstrumentError: it reads otherwise."""
        from nidaqmx.stream_readers import DigitalSingleChannelReader
        from nidaqmx.stream_writers import DigitalSingleChannelWriter

        with self._session.explaining(doing):
            DigitalSingleChannelWriter(self._task.out_stream, auto_start=True).write_one_sample_one_line(level)
            found = DigitalSingleChannelReader(self._task.in_stream).read_one_sample_one_line()
        if bool(found) != level:
            was, reads = ("high", "low") if level else ("low", "high")
            cause = f"{self._settings.names[0]} was set {was} and reads {reads}"
            raise InstrumentError(self._session.instrument, doing, cause, "check what is wired to the line")


def _ramp_steps(start_v: Sequence[float], stop_v: Sequence[float], slew_v_per_s: float) -> list[tuple[float, ...]]:
    """Voltages of a straight ramp, `RAMP_STEP_S` apart, its last step at the end; none where nothing changes.

    slew_v_per_s: Fastest change of any output, > 0.
    """
    way_v = max(abs(stop - start) for start, stop in zip(start_v, stop_v, strict=True))
    count = math.ceil(way_v / (slew_v_per_s * RAMP_STEP_S) - 1e-9)
    return [
        tuple(start + (stop - start) * step / count for start, stop in zip(start_v, stop_v, strict=True))
        for step in range(1, count + 1)
    ]
