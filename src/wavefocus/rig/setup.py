"""Instruments that are open, watched, bounded in time and put to rest at the end; the delay between their inputs."""

from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from functools import partial
from typing import Any

from wavefocus.acquisition.setup import (
    MAX_DELAY_DIFFERENCE_S,
    AllowedRange,
    Openers,
    Sensor,
    Setup,
    Watch,
    identities_of,
    try_all,
    wired,
)
from wavefocus.config.calibration import calibrated
from wavefocus.config.rig import BandSection, RigConfig, RoomSection
from wavefocus.config.run import RunConfig
from wavefocus.console import say, spinner
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.protocols import Recorder
from wavefocus.drivers.registry import VibrometerReading
from wavefocus.drivers.timeouts import BoundedMirror, BoundedPlayer, BoundedRecorder, in_time
from wavefocus.rig.calibration_validity import calibration_warnings
from wavefocus.rig.instruments import SAME_SENSITIVITY, openers_of
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import InputError


@contextmanager
def open_setup(
    rig: RigConfig,
    run: RunConfig | None,
    *,
    realtime: bool = False,
    outputs: int = 0,
    bank: BankWriter | None = None,
) -> Iterator[Setup]:
    """Open the instruments of a rig; on the way out they are muted, parked and released.

    run: Says what a virtual rig is like; None for a flawless one.
    realtime, outputs: See `wavefocus.rig.instruments.openers_of`.
    bank: The bank that is measured into, which decides on the delay between the inputs.

    Raises InstrumentError: an instrument cannot be opened, or could not be put to rest. Raises InputError: the recorder
    does not fit the bank.
    """
    virtual = None if run is None else run.virtual
    openers = openers_of(rig, virtual, realtime=realtime, outputs=outputs)
    rate_hz = None if run is None else run.capture.sample_rate_hz
    with spinner("opening the instruments"):
        opened = open_rig(openers)
    with setup_in_use(opened, rig, rate_hz, bank) as setup:
        if rig.calibration.measured is not None:
            say(f"{rig.calibration.file}: {calibrated(rig.calibration.measured)}, in place of the rig file's")
            for warning in calibration_warnings(rig, identities_of(setup)):
                say(f"warning: {warning}")
        yield setup


@contextmanager
def setup_in_use(
    setup: Setup, rig: RigConfig, sample_rate_hz: float | None, bank: BankWriter | None = None
) -> Iterator[Setup]:
    """Use instruments that are open; on the way out they are muted, parked and released.

    sample_rate_hz: Of the records to come; with it, the delay between the inputs is asked of the recorder.
    bank: See `open_setup`.

    Raises InstrumentError, InputError: see `open_setup`.
    """
    with shut_down(setup.close):
        yield setup if sample_rate_hz is None else _with_input_delay(setup, rig, sample_rate_hz, bank)


def open_rig(openers: Openers) -> Setup:
    """Open every instrument of a rig, one after the other; when one fails, those before it are shut down.

    Raises InstrumentError: an instrument cannot be opened, or its driver hangs meanwhile.
    """
    rig, hung_after_s = openers.rig, openers.rig.recovery.hung_after_s
    with ExitStack() as opened:
        vibrometer = in_time("vibrometer", "opening", openers.vibrometer, openers.limit_s)
        mirror = in_time("mirror", "opening", openers.mirror, openers.limit_s)
        opened.callback(mirror.close)
        opened.callback(mirror.park)
        recorder = in_time("recorder", "opening", openers.recorder, openers.limit_s)
        opened.callback(recorder.close)
        player = in_time("player", "opening", openers.player, openers.limit_s)
        opened.pop_all()  # from here on the caller shuts them down
    setup = wired(
        rig, BoundedMirror(mirror, hung_after_s), BoundedRecorder(recorder, hung_after_s),
        BoundedPlayer(player, hung_after_s), openers.clock, vibrometer,
    )  # fmt: skip
    watch, asked_v = watch_of(openers, recorder, vibrometer), rig.recorder.response_ranges_v
    # The response may step up to the rig file's ranges, or to all that the recorder says it has.
    ranges_v = recorder.input_ranges_v if asked_v is None else asked_v
    return replace(setup, watch=watch, response_ranges_v=ranges_v)


@contextmanager
def open_player(rig: RigConfig, *, realtime: bool = False) -> Iterator[BoundedPlayer]:
    """Open the interface alone, `realtime` as of `openers_of`; whatever happens, its outputs are muted and released.

    Raises InstrumentError: it cannot be opened, or could not be muted and released.
    """
    openers = openers_of(rig, realtime=realtime)
    player = BoundedPlayer(in_time("player", "opening", openers.player, openers.limit_s), rig.recovery.hung_after_s)
    with shut_down(lambda: try_all(player.mute, player.close)):
        yield player


@contextmanager
def shut_down(close: Callable[[], None]) -> Iterator[None]:
    """Mute, park and release instruments on the way out, whatever happens before.

    close: Does so, and raises ExceptionGroup of all that failed.

    Raises InstrumentError: one of them could not be put to rest, and nothing else had failed.
    """
    try:
        yield
    except BaseException:
        # The first failure is the one to act on; what else fails on the way out is reported and does not hide it.
        try:
            close()
        except* Exception as group:
            for one in group.exceptions:
                say(f"on the way out: {one}")
        raise
    try:
        close()
    except* InstrumentError as group:
        causes = "; ".join(str(one) for one in group.exceptions)
        raise InstrumentError("rig", "putting the instruments to rest", causes, "check them by hand") from group


def room_c(recorder: Any, section: RoomSection) -> float:
    """Room temperature in degrees Celsius, from a transmitter at an input of the recorder's box."""
    return section.celsius_at_0_v + section.celsius_per_v * float(recorder.read_input_v(section.input))


def range_band(sensitivity_m_s_per_v: float) -> AllowedRange:
    """The range that a session began with, and no other."""
    least, most = ((1 + off) * sensitivity_m_s_per_v for off in (-SAME_SENSITIVITY, SAME_SENSITIVITY))
    words = f"vibrometer range (set to {sensitivity_m_s_per_v:g} m/s per V at the start)"
    band = BandSection(leaves_below=least, returns_above=least, returns_below=most, leaves_above=most, settle_s=0.0)
    return AllowedRange(words, "m/s per V", band)


def in_time_or_failed(name: str, sensor: Sensor, limit_s: float) -> Sensor:
    """A sensor that answers in time or counts as one that does not answer."""
    return partial(in_time, f"sensor {name}", "reading", sensor, limit_s)


def watch_of(openers: Openers, recorder: Recorder, vibrometer: VibrometerReading) -> Watch:
    """What a rig's configuration says is to be watched, with the sensors for it."""
    rig, section, sensors = openers.rig, openers.rig.watch, dict(openers.sensors)
    bands: dict[str, AllowedRange] = {}
    for name, band, words, unit in (
        ("reference", section.reference, "reference level", "dB"),
        ("noise", section.noise, "vibrometer noise", "V"),
        ("light", section.light, "vibrometer signal level", "of full"),
        ("room", section.room, "room temperature", "degrees C"),
    ):
        if band is not None:
            bands[name] = AllowedRange(words, unit, band)
    if section.room is not None and not rig.is_virtual:
        sensors["room"] = partial(room_c, recorder, section.room)
    if "range" in sensors:
        bands["range"] = range_band(vibrometer.sensitivity_m_s_per_v)
    bounded: dict[str, Sensor] = {
        name: in_time_or_failed(name, sensors[name], rig.recovery.hung_after_s)
        for name in ("light", "room", "range")
        if name in bands
    }
    return Watch(bands, bounded, section.probe_every_s, section.give_up_after_s)


def _with_input_delay(setup: Setup, rig: RigConfig, sample_rate_hz: float, bank: BankWriter | None) -> Setup:
    """A set-up with the delay of its response input: the calibrated one, else the device's own, else as stated.

    sample_rate_hz: Of the records to come.
    bank: The bank that is measured into: all its rows are corrected by the delay that it was begun with.

    Raises InstrumentLostError. Raises InputError: the recorder's delay is not the one that the bank was begun with.
    """
    stated_s, device_s = rig.recorder.inter_channel_delay_s, _device_delay_s(setup.recorder, sample_rate_hz)
    begun_s = None if bank is None or _is_calibrated(rig) else bank.header.inter_channel_delay_s
    if begun_s is not None:
        used_s, source = begun_s, "the bank"
    elif device_s is None or _is_calibrated(rig) or bank is not None or _alike(device_s, stated_s):
        used_s, source = stated_s, "the calibration" if _is_calibrated(rig) else "the rig file"
    else:
        used_s, source = device_s, "the device"
    if device_s is not None and not _alike(device_s, used_s):
        if bank is not None and begun_s is not None:
            raise InputError(
                f"{bank.path}: was begun with a recorder that samples the response {_us(used_s)} after the reference; "
                f"this one does so after {_us(device_s)}: connect the recorder that it was begun with, or start a "
                "new bank"
            )
        say(
            f"warning: recorder: the device samples the response {_us(device_s)} after the reference; the "
            f"{_us(used_s)} of {source} are used: measure them again by wavefocus calibrate --only inputs, for a new "
            "bank"
        )
    elif not _alike(used_s, stated_s):
        say(f"recorder: the response is sampled {_us(used_s)} after the reference, by {source}; not {_us(stated_s)}")
    return replace(setup, inter_channel_delay_s=used_s)


def with_stated_delay(header: BankHeader, rig: RigConfig) -> BankHeader:
    """The header of a new bank with the delay that the recorder states; it is asked before the bank is made.

    A calibrated delay is the rig file's, and so is one that the device's agrees with.

    Raises InstrumentError: the recorder does not answer; no bank is made then.
    """
    if rig.is_virtual or _is_calibrated(rig):
        return header
    openers, hung_after_s = openers_of(rig), rig.recovery.hung_after_s
    recorder = BoundedRecorder(in_time("recorder", "opening", openers.recorder, openers.limit_s), hung_after_s)
    try:
        device_s, stated_s = recorder.sampling_delay_s(header.sample_rate_hz), rig.recorder.inter_channel_delay_s
    finally:
        recorder.close()
    alike = device_s is not None and _alike(device_s, stated_s)
    return replace(header, inter_channel_delay_s=stated_s if alike else device_s)


def _device_delay_s(recorder: Recorder, sample_rate_hz: float) -> float | None:
    """What the recorder states; None where it does not."""
    try:
        return recorder.sampling_delay_s(sample_rate_hz)
    except InstrumentLostError:
        raise
    except InstrumentError as failure:
        say(f"warning: {failure}")
        return None


def _is_calibrated(rig: RigConfig) -> bool:
    return rig.calibration.measured is not None and rig.calibration.measured.inputs is not None


def _alike(delay_s: float, other_s: float) -> bool:
    return abs(delay_s - other_s) <= MAX_DELAY_DIFFERENCE_S


def _us(seconds: float) -> str:
    return f"{1e6 * seconds:.2f} us"
