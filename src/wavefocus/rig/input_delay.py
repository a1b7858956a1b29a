"""How much later the response input is sampled than the reference: which value counts, and one for a whole bank."""

from dataclasses import replace

from wavefocus.acquisition.setup import MAX_DELAY_DIFFERENCE_S, Setup
from wavefocus.config.rig import RigConfig
from wavefocus.console import say
from wavefocus.drivers.errors import InstrumentError, InstrumentLostError
from wavefocus.drivers.protocols import Recorder
from wavefocus.drivers.timeouts import BoundedRecorder, in_time
from wavefocus.rig.instruments import openers_of
from wavefocus.storage.bank.layout import BankHeader
from wavefocus.storage.bank.writer import BankWriter
from wavefocus.storage.errors import InputError


def with_input_delay(setup: Setup, rig: RigConfig, sample_rate_hz: float, bank: BankWriter | None = None) -> Setup:
    """A set-up with the delay of its response input: the calibrated one, else the device's own, else as stated.

    sample_rate_hz: Of the records to come.
    bank: The bank that is measured into: all its rows are corrected by the delay that it was begun with.

    Raises InstrumentLostError. Raises InputError: the recorder's delay is not the one that the bank was begun with.
    """
    stated_s, device_s = rig.recorder.inter_channel_delay_s, _device_delay_s(setup.instruments.recorder, sample_rate_hz)
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
