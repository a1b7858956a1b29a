"""The sensors of a rig's watched conditions: what a room or a vibrometer says between two records."""

from __future__ import annotations

import math
from typing import Protocol

from acquisition.engine.call_thread import HungError, Lane
from acquisition.quality.watch import Band, Sensor, Watch
from config.rig import RigConfig
from config.rig_recorder import VibrometerSection
from config.rig_watch import BandSection, RoomSection
from drivers.errors import InstrumentError
from wavefocus.rig.instruments import OpenedRig


class ReadsInput(Protocol):
    """A recorder whose other inputs can be read between two records."""

    def read_input_v(self, name: str) -> float:
        """Volts at an input, the mean of a moment. Raises InstrumentError."""
        ...


class RoomSensor:
    """Room temperature from a transmitter at an input of the recorder's box.

    Parameters
    ----------
    recorder : ReadsInput
        Whose input it is.
    section : RoomSection
        Which input, and its scale.
    """

    def __init__(self, recorder: ReadsInput, section: RoomSection) -> None:
        self._recorder = recorder
        self._section = section

    def read(self) -> float:
        """Degrees Celsius."""
        volts = self._recorder.read_input_v(self._section.input)
        return self._section.celsius_at_0_v + self._section.celsius_per_v * volts


class LightSensor:
    """The signal level that a Polytec controller tells, 0 to 1.

    Parameters
    ----------
    section : VibrometerSection
        Where the controller is.
    """

    def __init__(self, section: VibrometerSection) -> None:
        self._section = section

    def read(self) -> float:
        """Share of full signal level."""
        from drivers.vibrometer.polytec import read_sensitivity

        section = self._section
        reading = read_sensitivity(
            section.port or "", baud=section.baud, identity=section.identity, decoder=section.decoder or 0
        )
        if reading.signal_level is None:
            raise InstrumentError(
                reading.identity, "asking the signal level", "it does not tell", "leave watch.light out of the rig file"
            )
        return reading.signal_level


class BoundedSensor:
    """A sensor that answers in time or counts as one that does not answer.

    Parameters
    ----------
    name : str
        For messages.
    sensor : Sensor
        The sensor.
    limit_s : float
        Longest wait.
    """

    def __init__(self, name: str, sensor: Sensor, limit_s: float) -> None:
        self._name = name
        self._sensor = sensor
        self._limit_s = limit_s
        self._lane = Lane(f"sensor {name}")

    def read(self) -> float:
        """The value now."""
        try:
            return self._lane.call(self._sensor.read, self._limit_s)
        except HungError:
            cause = f"the call did not come back within {self._limit_s:.3g} s"
            raise InstrumentError(f"sensor {self._name}", "reading", cause, "look after its cable and power") from None


def band_of(section: BandSection, words: str, unit: str) -> Band:
    """The band that the engine watches; a limit that is left out is infinite."""
    return Band(
        words,
        unit,
        leaves_below=-math.inf if section.leaves_below is None else section.leaves_below,
        leaves_above=math.inf if section.leaves_above is None else section.leaves_above,
        returns_above=-math.inf if section.returns_above is None else section.returns_above,
        returns_below=math.inf if section.returns_below is None else section.returns_below,
        settle_s=section.settle_s,
    )


def watch_of(rig: RigConfig, opened: OpenedRig) -> Watch:
    """What a rig's configuration says is to be watched, with the sensors for it.

    Parameters
    ----------
    rig : RigConfig
        The rig.
    opened : OpenedRig
        Its instruments, as their drivers made them.
    """
    section = rig.watch
    bands: dict[str, Band] = {}
    sensors: dict[str, Sensor] = {}
    for name, of_name, words, unit in (
        ("reference", section.reference, "reference level", "dB"),
        ("noise", section.noise, "vibrometer noise", "V"),
        ("light", section.light, "vibrometer signal level", "of full"),
        ("room", section.room, "room temperature", "degrees C"),
    ):
        if of_name is not None:
            bands[name] = band_of(of_name, words, unit)
    for name in bands.keys() & {"light", "room"}:
        if rig.is_virtual:
            sensors[name] = opened.virtual_sensors[name]
        elif name == "light":
            sensors[name] = LightSensor(rig.vibrometer)
        elif section.room is not None:
            sensors[name] = RoomSensor(opened.instruments.recorder, section.room)  # type: ignore[arg-type]
    bounded = {name: BoundedSensor(name, one, rig.recovery.hung_after_s) for name, one in sensors.items()}
    return Watch(bands, bounded, section.probe_every_s, section.give_up_after_s)
