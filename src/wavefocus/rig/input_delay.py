"""How much later the response input is sampled than the reference: which value counts, and one for a whole bank."""

from __future__ import annotations

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
    recorder = setup.instruments.recorder
    delay_s = _delay_s(rig, recorder, sample_rate_hz) if bank is None else _bank_delay_s(rig, recorder, bank)
    return replace(setup, inter_channel_delay_s=delay_s)


def with_stated_delay(header: BankHeader, rig: RigConfig) -> BankHeader:
    """The header of a new bank with the delay that the recorder states; it is asked before the bank is made.

    A calibrated delay is the rig file's. Raises InstrumentError: the recorder does not answer; no bank is made then.
    """
    if rig.is_virtual or _is_calibrated(rig):
        return header
    return replace(header, inter_channel_delay_s=_ask_recorder(rig, header.sample_rate_hz))


def _ask_recorder(rig: RigConfig, sample_rate_hz: float) -> float | None:
    """The delay that a recorder states, or the rig file's where they are alike; None where it states none."""
    openers = openers_of(rig)
    recorder = BoundedRecorder(
        in_time("recorder", "opening", openers.recorder, openers.limit_s), rig.recovery.hung_after_s
    )
    try:
        device_s, stated_s = recorder.sampling_delay_s(sample_rate_hz), rig.recorder.inter_channel_delay_s
    finally:
        recorder.close()
    return stated_s if device_s is not None and _alike(device_s, stated_s) else device_s


def _delay_s(rig: RigConfig, recorder: Recorder, sample_rate_hz: float) -> float:
    stated_s, device_s = rig.recorder.inter_channel_delay_s, _device_delay_s(recorder, sample_rate_hz)
    if device_s is None or _alike(device_s, stated_s):
        return stated_s
    if _is_calibrated(rig):
        say(
            f"warning: {_device(device_s)}, calibrated were {_us(stated_s)}, which are used; "
            "calibrate --only inputs again"
        )
        return stated_s
    say(f"{_device(device_s)}, which is used in place of the {_us(stated_s)} of recorder.inter_channel_delay_s")
    return device_s


def _bank_delay_s(rig: RigConfig, recorder: Recorder, bank: BankWriter) -> float:
    """The delay that a bank was begun with, held against what the device states now."""
    header = bank.header
    if _is_calibrated(rig):
        return _delay_s(rig, recorder, header.sample_rate_hz)
    begun_s, stated_s = header.inter_channel_delay_s, rig.recorder.inter_channel_delay_s
    bank_s = stated_s if begun_s is None else begun_s
    device_s = _device_delay_s(recorder, header.sample_rate_hz)
    if device_s is not None and not _alike(device_s, bank_s):
        if begun_s is not None:
            raise InputError(
                f"{bank.path}: was begun with a recorder that samples the response {_us(bank_s)} after the reference; "
                f"this one does so after {_us(device_s)}: connect the recorder that it was begun with, or start a "
                "new bank"
            )
        say(
            f"warning: {_device(device_s)}; {bank.path} was begun with {_us(bank_s)}, which are used for its rest too, "
            "so that its rows are alike; a new bank takes the device's"
        )
    elif not _alike(bank_s, stated_s):
        say(f"{_device(bank_s)}, which is used in place of the {_us(stated_s)} of recorder.inter_channel_delay_s")
    return bank_s


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


def _device(delay_s: float) -> str:
    return f"recorder: the device samples the response {_us(delay_s)} after the reference"


def _us(seconds: float) -> str:
    return f"{1e6 * seconds:.2f} us"
