"""Calibrating inputs and outputs: levels, delays and gains of both interfaces."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

from acquisition.calibrate.operator import BOTH, SUM, Operator, output
from acquisition.calibrate.probe import Figures, NotMeasuredError, Probe, check_loopback
from calibration.clock.timing import ReferenceMissingError
from calibration.rig.comparison import ResponseMissingError

# One cable into two inputs: what differs by more is another signal, or a broken input.
MOST_GAIN_ERROR = 0.05
MOST_DELAY_S = 1e-3


def measure_inputs(probe: Probe, operator: Operator) -> Figures:
    """Listen to one signal on both inputs; the response channel is later by as much as it is sampled earlier.

    operator: Plugs the loopback into both inputs.

    Returns figures whose `late_s` is the inter-channel delay: how much later the response is sampled.
    Raises NotMeasuredError: the signal is not on both inputs, or not alike. InstrumentError: of the instrument that
    failed for good.
    """
    while True:
        operator.connect(BOTH)
        try:
            found = probe.compare(None)
        except ResponseMissingError as missing:
            if operator.again(f"no signal from the loopback at the response input ({missing})"):
                continue
            raise NotMeasuredError("the inter-channel delay needs the loopback on both inputs") from None
        except ReferenceMissingError as missing:
            raise check_loopback(missing) from None
        break
    apart = found.response_gain / found.reference_gain - 1
    if abs(apart) > MOST_GAIN_ERROR:
        raise NotMeasuredError(
            f"the two inputs measure the same cable {100 * apart:+.1f} % apart: check cables and terminal configuration"
        )
    # The same wave appears earlier in a channel that is sampled later.
    delay_s = -found.late_s
    if abs(delay_s) > MOST_DELAY_S:
        raise NotMeasuredError(
            f"the inputs are sampled {1e3 * delay_s:.3f} ms apart, more than a multiplexer needs: is the signal on the "
            "response input the loopback itself?"
        )
    return Figures(delay_s, found.spread_s, found.reference_gain, found.response_gain, found.clock_ppm)


@dataclass(frozen=True, slots=True)
class OutputFigures:
    """One output of the player.

    latency_s: How much later it is than the loopback output.
    full_scale_v: Volts at full scale, by the recorder; None where the gain on the way is not given.
    polarity: -1 where its wires are crossed.
    spread_s: Largest less smallest latency over the records.
    """

    channel: int
    latency_s: float
    full_scale_v: float | None
    polarity: Literal[1, -1]
    spread_s: float


@dataclass(frozen=True, slots=True)
class OutputsTask:
    """Inputs of the measurement of outputs.

    channels: The outputs to measure, the loopback not among them.
    loopback_channel: The loopback output.
    full_scale_v: Volts at full scale of every output from 0, as the rig believes.
    reference_gain: Volts at the reference input per volt of the loopback output.
    inter_channel_delay_s: How much later the response input is sampled.
    summing_box: All outputs are plugged into the response input at once, through a box.
    box_gain: Its gain, where it is given.
    """

    channels: tuple[int, ...]
    loopback_channel: int
    full_scale_v: Sequence[float]
    reference_gain: float
    inter_channel_delay_s: float
    summing_box: bool = False
    box_gain: float | None = None


def measure_outputs(
    task: OutputsTask, probe: Probe, operator: Operator, progress: Callable[[int, int], None]
) -> tuple[OutputFigures, ...]:
    """Compare each output with the loopback output.

    task: Inputs of the measurement.
    operator: Plugs the response input into each output in turn, or into the summing box.
    progress: Called with the outputs done and the outputs there are.

    Returns figures of the outputs, the loopback's own first; an output that the operator gave up is left out.
    Raises NotMeasuredError: the loopback itself has no signal, the summing box is not there, or the probe is too loud.
    InstrumentError: of the instrument that failed for good.
    """
    if task.summing_box:
        _plug_box(probe, operator)
    measured: list[OutputFigures] = []
    loopback: OutputFigures | None = None
    for done, channel in enumerate(task.channels):
        progress(done, len(task.channels))
        figures = _heard(task, channel, probe, operator)
        if figures is None:
            continue
        measured.append(_of_output(task, channel, figures))
        if loopback is None:
            full_scale_v = task.full_scale_v[task.loopback_channel] * abs(figures.reference_gain) / task.reference_gain
            sign: Literal[1, -1] = -1 if figures.reference_gain < 0 else 1
            loopback = OutputFigures(task.loopback_channel, 0.0, full_scale_v, sign, 0.0)
    progress(len(task.channels), len(task.channels))
    return (*(() if loopback is None else (loopback,)), *measured)


def _plug_box(probe: Probe, operator: Operator) -> None:
    """Have the summing box plugged in; the loopback, which is not in it, must have no signal there."""
    while True:
        operator.connect(SUM)
        if not probe.detects(None):
            return
        if not operator.again("the response input carries the loopback, not the summing box"):
            raise NotMeasuredError("the outputs need the summing box in the response input, which has the loopback")


def _heard(task: OutputsTask, channel: int, probe: Probe, operator: Operator) -> Figures | None:
    """An output compared with the loopback, as often as the operator tries; None when it is given up."""
    while True:
        if not task.summing_box:
            operator.connect(output(channel))
            # Played without it: a signal now comes by another cable.
            other = next((one for one in task.channels if one != channel), None)
            if probe.detects(other):
                source = "the loopback" if other is None else f"output {other} or the loopback"
                if operator.again(f"the response input carries {source}, not output {channel} alone"):
                    continue
                return None
        try:
            return probe.compare(channel)
        except ResponseMissingError as missing:
            if not operator.again(f"no signal from output {channel} at the response input ({missing})"):
                return None
        except ReferenceMissingError as missing:
            raise check_loopback(missing) from None


def _of_output(task: OutputsTask, channel: int, found: Figures) -> OutputFigures:
    gain = task.box_gain if task.summing_box else 1.0
    full_scale_v = None if gain is None else task.full_scale_v[channel] * abs(found.response_gain) / gain
    # The response input is sampled later, so all on it seems earlier.
    return OutputFigures(
        channel=channel,
        latency_s=found.late_s + task.inter_channel_delay_s,
        full_scale_v=full_scale_v,
        polarity=-1 if found.response_gain < 0 else 1,
        spread_s=found.spread_s,
    )
