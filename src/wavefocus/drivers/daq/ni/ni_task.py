"""One finite two-channel task, kept from record to record: its converter's step, refusals before it is asked."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.drivers.daq.ni import IN_USE, NOT_DONE, STOPPED_BEFORE_DONE, TERMINALS, NiSession
from wavefocus.drivers.errors import InstrumentError


@dataclass(frozen=True, slots=True)
class _CountScale:
    """Counts of one input.

    step_v: Volts per count, > 0.
    lowest, highest: Counts at the ends of the range: a sample there is over range.
    """

    step_v: float
    lowest: int
    highest: int

    def quantise(self, volts: NDArray[np.float64], out: NDArray[np.float32]) -> bool:
        """Write volts as whole counts; returns whether an end of the range was reached.

        volts, float64 (samples,): As the driver scales them; overwritten.
        out, float32 (samples,): The same as whole counts within the range.
        """
        counts = np.divide(volts, self.step_v, out=volts)
        np.rint(counts, out=counts)
        over_range = bool(counts.max() >= self.highest or counts.min() <= self.lowest)
        if over_range:
            np.clip(counts, self.lowest, self.highest, out=counts)
        np.multiply(counts, self.step_v, out=out, casting="same_kind")
        return over_range


def count_scale(range_v: float, bits: int, coefficients: Sequence[float] | None) -> _CountScale:
    """The scale of an input from its properties in NI-DAQmx.

    The volts that NI-DAQmx delivers are codes put through a polynomial, the device's calibration. With its linear
    coefficient as the step they come out as whole counts again, up to a constant fraction of a step; the nominal
    step, by some per cent another one, would make noise of it.

    range_v: Range in volts, to either side of 0.
    coefficients: Calibration: volts = c0 + c1 code + c2 code^2 + ...; without it the step is the nominal one.
    """
    codes = 2 ** (bits - 1)
    nominal_v = range_v / codes
    if coefficients is None or len(coefficients) < 2 or not coefficients[1] > 0:
        return _CountScale(nominal_v, -codes, codes - 1)
    # Codes of fewer bits may sit at the upper end of a wider word.
    shift = max(0, round(math.log2(nominal_v / coefficients[1])))
    step_v = coefficients[1] * 2**shift
    # Calibrated steps differ from the nominal by up to 5 % (USB-621x user manual, table 4-1); far more is not a step.
    if abs(step_v / nominal_v - 1) > 0.15:
        return _CountScale(nominal_v, -codes, codes - 1)
    ends = [np.polynomial.polynomial.polyval(code * 2**shift, coefficients) for code in (-codes, codes - 1)]
    inside = math.floor(range_v / step_v + 1e-6)
    lowest, highest = -inside, inside
    # The codes' ends lie so near the range's ends, or their coefficients mean something else.
    if all(abs(abs(end) / range_v - 1) < 0.2 for end in ends):
        lowest, highest = max(lowest, round(ends[0] / step_v)), min(highest, round(ends[1] / step_v))
    return _CountScale(step_v, lowest, highest)


# NI-DAQmx refuses a finite task of one sample.
_MIN_SAMPLES = 2


@dataclass(frozen=True, slots=True)
class InputWiring:
    """Which inputs are read, and how.

    inputs: Inputs of (reference, response): ``("ai0", "ai1")``.
    terminal: Terminal configuration, a key of `TERMINALS`.
    trigger: Digital input whose rising edge starts a record.
    """

    inputs: tuple[str, str]
    terminal: str
    trigger: str | None


@dataclass(frozen=True, slots=True)
class TaskTiming:
    """What a task is built for: rate in Hz, samples per channel, ranges in volts."""

    rate_hz: float
    samples: int
    range_v: tuple[float, float]


class RecordTask:
    """A committed task: it starts with one call, and can be started again when it has been stopped.

    Raises InstrumentError.

    exact: Whether a rate or a range that the driver changes is refused.
    """

    def __init__(
        self, session: NiSession, wiring: InputWiring, timing: TaskTiming, operation: str, *, exact: bool = True
    ) -> None:
        self.timing = timing
        self._session = session
        self._wiring = wiring
        self._acquired = max(_MIN_SAMPLES, timing.samples)
        self._task = session.new_task(session.task_name)
        try:
            channels = _configure(self._task, session, wiring, timing, self._acquired)
            if exact:
                self._check(channels, operation)
            self._commit()
            self.converters = (self._scale(channels[0], timing.range_v[0]), self._scale(channels[1], timing.range_v[1]))
        except BaseException as failure:
            self.close_after(failure)
            raise

    def start(self) -> None:
        """Start a record."""
        self._task.start()

    def wait(self, timeout_s: float) -> bool:
        """Whether the record has ended within a time; returns as soon as it has."""
        from nidaqmx.errors import DaqError

        try:
            self._task.wait_until_done(timeout_s)
        except DaqError as error:
            if error.error_code != NOT_DONE:
                raise
            return False
        return True

    def read(self) -> tuple[NDArray[np.float64], int]:
        """Volts of the record that has ended, shape (2, samples), and how many of them are there.

        Raises DaqReadError.
        """
        from nidaqmx.stream_readers import AnalogMultiChannelReader

        volts = np.zeros((2, self._acquired))
        reader = AnalogMultiChannelReader(self._task.in_stream)
        reader.verify_array_shape = False  # it would ask the device for the number of channels each time
        # A finished record is in the computer's memory: reading it needs no time, but some drivers take 0 for "do not
        # wait".
        count = reader.read_many_sample(volts, self._acquired, 2.0)
        return volts[:, : self.timing.samples], min(count, self.timing.samples)

    def stop(self) -> None:
        """End a record, finished or not; the task stays committed."""
        from nidaqmx.errors import DaqWarning

        try:
            self._task.stop()
        except DaqWarning as warning:
            if warning.error_code != STOPPED_BEFORE_DONE:
                raise  # that one is what stopping is for

    def close(self) -> None:
        """Give the device back."""
        self._task.close()

    def _check(self, channels: list[Any], operation: str) -> None:
        """Refuse what the driver would quietly change: it takes the next rate and the next larger range."""
        rate_hz, instrument = self._task.timing.samp_clk_rate, self._session.instrument
        # The estimator finds clock ratios within 500 ppm; what the device's own divider takes of that is refused
        # beforehand.
        if abs(rate_hz / self.timing.rate_hz - 1) > 2e-4:
            cause = f"it has no sample rate of {self.timing.rate_hz:g} Hz"
            remedy = f"choose the nearest one that it has, {rate_hz:.10g} Hz"
            raise InstrumentError(instrument, operation, cause, remedy)
        for channel, name, range_v in zip(channels, self._wiring.inputs, self.timing.range_v, strict=True):
            got_v = channel.ai_rng_high
            if abs(got_v / range_v - 1) > 1e-6:
                cause = f"{name} has no range of {range_v:g} V as a {self._wiring.terminal} input"
                remedy = f"choose {got_v:g} V, or another terminal configuration"
                raise InstrumentError(instrument, operation, cause, remedy)

    def _commit(self) -> None:
        """Reserve the device, and make everything ready."""
        from nidaqmx.constants import TaskMode
        from nidaqmx.errors import DaqError

        owned, self._session.owned = self._session.owned, True  # unless it says no, for it may not answer
        try:
            self._task.control(TaskMode.TASK_COMMIT)
        except DaqError as error:
            if error.error_code == IN_USE:
                self._session.owned = owned
            raise

    def _scale(self, channel: Any, range_v: float) -> _CountScale:
        coefficients = self._session.reported(lambda: [float(value) for value in channel.ai_dev_scaling_coeff])
        return count_scale(range_v, round(channel.ai_resolution), coefficients)

    def close_after(self, failure: BaseException) -> None:
        """Give the device back after a failure, which is raised; a second failure becomes its note."""
        try:
            self._task.close()
        except Exception as second:
            failure.add_note(f"and the task could not be cleared: {second}")


def _configure(task: Any, session: NiSession, wiring: InputWiring, timing: TaskTiming, samples: int) -> list[Any]:
    """Give a task its two channels, its sample clock and its trigger; returns the channels."""
    from nidaqmx.constants import AcquisitionType, Edge, TerminalConfiguration

    terminal = TerminalConfiguration[TERMINALS[wiring.terminal]]
    channels = [
        task.ai_channels.add_ai_voltage_chan(
            f"{session.device}/{name}", terminal_config=terminal, min_val=-range_v, max_val=range_v
        )
        for name, range_v in zip(wiring.inputs, timing.range_v, strict=True)
    ]
    task.timing.cfg_samp_clk_timing(timing.rate_hz, sample_mode=AcquisitionType.FINITE, samps_per_chan=samples)
    if wiring.trigger:
        source = f"/{session.device}/{wiring.trigger}"
        task.triggers.start_trigger.cfg_dig_edge_start_trig(source, trigger_edge=Edge.RISING)
    return channels


def conversion_delay_s(session: NiSession, wiring: InputWiring, timing: TaskTiming) -> float | None:
    """How much later the second input of a task is converted than the first; None where the device does not say.

    The task is configured and never reserved, so nothing that runs is disturbed. Raises DaqError.
    """
    task = session.new_task()
    try:
        _configure(task, session, wiring, timing, timing.samples)
        rate_hz = session.reported(lambda: float(task.timing.ai_conv_rate))
    finally:
        task.close()
    return 1 / rate_hz if rate_hz else None


def check_wiring(session: NiSession, wiring: InputWiring) -> None:
    """Refuse inputs, terminal configurations and triggers that the device has not. Raises InstrumentError."""

    def refuse(cause: str, remedy: str) -> InstrumentError:
        return InstrumentError(session.instrument, "opening", cause, f"{remedy} of [recorder]")

    product, limits = session.identity.product, session.limits
    keys = ("reference_input", "response_input")
    for key, name in zip(keys, wiring.inputs, strict=True):
        if name not in limits.inputs:
            raise refuse(f"{product} has no input {name!r}", f"put one of {_or(limits.inputs)} into {key}")
    for name in wiring.inputs:
        with session.explaining("opening"):
            terminals = session.terminals_of(name)
        if terminals is not None and wiring.terminal not in terminals:
            raise refuse(
                f"{name} of {product} cannot be a {wiring.terminal} input", f"put {_or(terminals)} into terminal"
            )
    if wiring.trigger and limits.triggers is not None and wiring.trigger not in limits.triggers:
        raise refuse(
            f"{product} has no digital input {wiring.trigger!r}",
            f"put {_or(limits.triggers)} into trigger" if limits.triggers else "leave out trigger",
        )


def _or(names: Iterable[str]) -> str:
    *most, last = names
    return f"{', '.join(most)} or {last}" if most else last
