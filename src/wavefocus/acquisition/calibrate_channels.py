"""Calibrating inputs, outputs and actuators: levels, delays and gains of both interfaces, polarity of each actuator."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from wavefocus.acquisition.attempt import Play, channels_of, record_play
from wavefocus.acquisition.calibrate_mirror import BOTH, SUM, NotMeasuredError, Operator, output
from wavefocus.acquisition.leak import BAND_HZ, SWEEP_S
from wavefocus.acquisition.setup import Setup, point_at
from wavefocus.calibration import Float64Array
from wavefocus.calibration.estimator.estimate import Estimate
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.evidence import HEARD_DB, MOST, ROW_CHANGE, SILENT, SOUND, TOLERANCE
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.calibration.known_signal import ClockFit, ReferenceMissingError
from wavefocus.calibration.timing import ClockFitter
from wavefocus.drivers.protocols import Recording, RecordLabel

# Above what coupling capacitors turn, and below what converters begin to fold back.
LOWEST_HZ = 200.0
HIGHEST_SHARE = 0.4
SILENCE_S = 0.05
RECORDS = 3
TRIES = 3


@dataclass(frozen=True, slots=True)
class Figures:
    """The median over a few records of one signal on both channels.

    late_s: How much later the signal is on the response channel.
    spread_s: Largest less smallest of that over the records.
    reference_gain, response_gain: Volts recorded per volt asked for; negative where wires are crossed.
    clock_ppm: How much faster the recorder's clock runs than the player's.
    """

    late_s: float
    spread_s: float
    reference_gain: float
    response_gain: float
    clock_ppm: float


class ResponseMissingError(ReferenceMissingError):
    """The response channel does not hold the known signal."""


class Probe:
    """Plays a band-limited sweep and compares the two inputs.

    Each channel is fitted by itself; they are compared at the signal's centre of energy, where a fit's offset and
    ratio do not trade errors.

    amplitude_v: Peak of the sweep in volts, by the full scale that the rig believes in.
    """

    def __init__(self, setup: Setup, sample_rate_hz: float, amplitude_v: float) -> None:
        self.setup = setup
        self._rate_hz = sample_rate_hz
        band_hz = LOWEST_HZ, HIGHEST_SHARE * sample_rate_hz
        excitation = PlayedExcitation(sample_rate_hz, *band_hz, SWEEP_S, SILENCE_S, amplitude_v, averages=1)
        self.amplitude_v = amplitude_v
        self._signal_v: Float64Array = excitation.signal_v()
        self._fitter = ClockFitter(self._signal_v)
        energy = self._signal_v**2
        self._centre = float(np.arange(energy.size) @ energy / energy.sum())

    def compare(self, output: int | None) -> Figures:
        """Play the loopback, and one output with it, and compare the two inputs.

        output: The output; None for the loopback by itself.

        Raises ResponseMissingError: no signal at the response input. NotMeasuredError: no signal from the loopback at
        the reference input, or it reaches the end of an input's range. InstrumentError: of the instrument that failed
        for good.
        """
        found = [self._fits(self._in_range(output, record)) for record in range(RECORDS)]
        late_s = [
            sum(sign * (fit.offset_samples + fit.ratio * self._centre) for sign, fit in zip((-1, 1), fits, strict=True))
            / self._rate_hz
            for fits in found
        ]
        gains, ppm = [[fit.gain for fit in fits] for fits in found], [reference.skew_ppm for reference, _ in found]
        reference_gain, response_gain = np.median(gains, axis=0).tolist()
        spread_s = max(late_s) - min(late_s)
        return Figures(float(np.median(late_s)), spread_s, reference_gain, response_gain, float(np.median(ppm)))

    def detects(self, output: int | None) -> bool:
        """Whether the response input has a cable to what plays: the loopback, and one output with it.

        output: The output; None for the loopback by itself.

        Raises NotMeasuredError: the loopback is not on the reference input. InstrumentError: of the instrument that
        failed for good.
        """
        try:
            reference, response = self._fits(self._played(output, 0), diagnose=False)
        except ResponseMissingError:
            return False
        # A cable brings more, through a summing box of 32 outputs, too.
        return abs(response.gain) >= SOUND * abs(reference.gain)

    def _fits(self, recording: Recording, *, diagnose: bool = True) -> tuple[ClockFit, ClockFit]:
        """The signal on the reference and on the response channel of a record."""
        try:
            reference = self._fitter.fit(recording.volts[0])
        except ReferenceMissingError as missing:
            raise _check_loopback(missing) from None
        try:
            return reference, self._fitter.fit(recording.volts[1], diagnose=diagnose, name="the response channel")
        except ReferenceMissingError as missing:
            words = str(missing).replace("reference input", "response input")
            raise ResponseMissingError(words, advised=True) from None

    def _in_range(self, output: int | None, record: int) -> Recording:
        recording = self._played(output, record)
        for name, reached, range_v in zip(
            ("reference", "response"), recording.over_range, self.setup.range_v, strict=True
        ):
            if reached:
                raise NotMeasuredError(
                    f"the probe of {self.amplitude_v:g} V reaches the end of the {name} input's range of "
                    f"{range_v:g} V: lower --amplitude-v, or raise the range in the rig file"
                )
        return recording

    def _played(self, output: int | None, record: int) -> Recording:
        number = self.setup.loopback_channel if output is None else output
        signals_v = dict.fromkeys(sorted({self.setup.loopback_channel, number}), self._signal_v)
        label = RecordLabel(number, 1, record, "calibration")
        return record_play(self.setup, Play(number, signals_v), self._rate_hz, label)


def _check_loopback(missing: ReferenceMissingError) -> NotMeasuredError:
    """What to say when there is no signal from the loopback itself: nothing can be calibrated without it."""
    usable = "" if missing.cause == "silence" else "usable "
    return NotMeasuredError(f"no {usable}signal from the loopback at the reference input ({missing})")


# What a multiplexer needs at most: one record of the slowest converters.
MAX_DELAY_S = 1e-3


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
        break
    apart = found.response_gain / found.reference_gain - 1
    if abs(apart) > TOLERANCE:
        raise NotMeasuredError(
            f"the two inputs measure the same cable {100 * apart:+.1f} % apart: check cables and terminal configuration"
        )
    # The same wave appears earlier in a channel that is sampled later.
    delay_s = -found.late_s
    if abs(delay_s) > MAX_DELAY_S:
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


def measure_outputs(
    probe: Probe,
    full_scale_v: Sequence[float],
    operator: Operator,
    progress: Callable[[int, int], None],
    box_gain: float | None = None,
) -> tuple[OutputFigures, ...]:
    """Compare each output with the loopback output.

    full_scale_v: Volts at full scale of every output from 0, as the rig believes.
    operator: Plugs the response input into each output in turn, or into the summing box.
    progress: Called with the outputs done and the outputs there are.
    box_gain: Gain of the summing box that all outputs are plugged into at once, 0 where it is not known; None without.

    Returns figures of the outputs, the loopback's own first; an output that the operator gave up is left out.
    Raises NotMeasuredError: the loopback itself has no signal, the summing box is not there, or the probe is too loud.
    InstrumentError: of the instrument that failed for good.
    """
    setup, channels = probe.setup, probe.setup.actuator_channels
    if box_gain is not None:
        _plug_box(probe, operator)
    measured: list[OutputFigures] = []
    for done, channel in enumerate(channels):
        progress(done, len(channels))
        found = _heard(channel, probe, operator, has_box=box_gain is not None)
        if found is None:
            continue
        if not measured:
            loopback = setup.loopback_channel
            own_v = full_scale_v[loopback] * abs(found.reference_gain) / setup.reference_gain
            measured.append(OutputFigures(loopback, 0.0, own_v, -1 if found.reference_gain < 0 else 1, 0.0))
        gain = 1.0 if box_gain is None else box_gain
        volts = full_scale_v[channel] * abs(found.response_gain) / gain if gain else None
        # The response input is sampled later, so all on it seems earlier.
        latency_s = found.late_s + setup.inter_channel_delay_s
        polarity: Literal[1, -1] = -1 if found.response_gain < 0 else 1
        measured.append(OutputFigures(channel, latency_s, volts, polarity, found.spread_s))
    progress(len(channels), len(channels))
    return tuple(measured)


def _plug_box(probe: Probe, operator: Operator) -> None:
    """Have the summing box plugged in; the loopback, which is not in it, must have no signal there."""
    while True:
        operator.connect(SUM)
        if not probe.detects(None):
            return
        if not operator.again("the response input carries the loopback, not the summing box"):
            raise NotMeasuredError("the outputs need the summing box in the response input, which has the loopback")


def _heard(channel: int, probe: Probe, operator: Operator, *, has_box: bool) -> Figures | None:
    """An output compared with the loopback, as often as the operator tries; None when it is given up."""
    while True:
        if not has_box:
            operator.connect(output(channel))
            # Played without it: a signal now comes by another cable.
            other = next((candidate for candidate in probe.setup.actuator_channels if candidate != channel), None)
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


Verdict = Literal["good", "weak", "dead", "reversed", "unlike"]

# A magnet glued a few millimetres off is this much earlier or later, at some metres a second.
MAX_LAG_S = 1e-3
# Floor of a level, for a response of nothing at all.
FLOOR_DB = -200.0


@dataclass(frozen=True, slots=True)
class _ActuatorComparison:
    """Each actuator against the others.

    level_db, float64 (actuators,): Energy of the response over the median's.
    verdict: ``"good"``, ``"weak"``, ``"dead"``, ``"reversed"`` or ``"unlike"``, for each.
    """

    level_db: Float64Array
    verdict: tuple[Verdict, ...]

    @property
    def polarity(self) -> tuple[Literal[1, -1], ...]:
        """The sign of each, as far as it was measured: 1 for all that are not reversed."""
        return tuple(-1 if word == "reversed" else 1 for word in self.verdict)


def compare_actuators(
    green: NDArray[np.floating], snr_db: NDArray[np.floating], sample_rate_hz: float
) -> _ActuatorComparison:
    """Compare the responses of all actuators, each measured at the same distance from its actuator.

    The common response is the first singular vector of all that are not dead, each scaled to the same energy.
    The sign that most actuators share counts as positive.

    green, float (actuators, taps): Response per volt of drive.
    snr_db, float (actuators,): Signal-to-noise ratio of each.
    sample_rate_hz: Rate of the responses.
    """
    responses = np.asarray(green, dtype=np.float64)
    energy = np.sum(responses**2, axis=1)
    measurable = (np.asarray(snr_db) >= HEARD_DB) & (energy > 0)
    usual = float(np.median(energy[measurable])) if measurable.any() else 1.0
    level_db = 10 * np.log10(np.maximum(energy / usual, 10 ** (FLOOR_DB / 10)))
    alive = measurable & (level_db >= 20 * np.log10(SILENT))
    likeness = np.zeros(len(responses))
    if alive.any():
        shapes = responses[alive] / np.sqrt(energy[alive])[:, np.newaxis]
        common = np.linalg.svd(shapes, full_matrices=False)[2][0]
        found = _correlations(shapes, common, round(MAX_LAG_S * sample_rate_hz))
        likeness[alive] = found if np.count_nonzero(found < 0) <= len(found) / 2 else -found
    verdicts = tuple(_verdict(*figures) for figures in zip(alive, level_db, likeness, strict=True))
    return _ActuatorComparison(level_db, verdicts)


def _verdict(alive: np.bool_, level_db: float, likeness: float) -> Verdict:
    if not alive:
        return "dead"
    if abs(likeness) < MOST:
        return "unlike"
    if likeness < 0:
        return "reversed"
    return "weak" if level_db < 20 * np.log10(ROW_CHANGE) else "good"


def _correlations(shapes: Float64Array, common: Float64Array, most_lag: int) -> Float64Array:
    """The largest correlation in magnitude of each shape with the common one, over small lags."""
    length = scipy.fft.next_fast_len(shapes.shape[1] + most_lag, real=True)
    spectra = scipy.fft.rfft(shapes, length, axis=1) * scipy.fft.rfft(common, length).conj()
    lagged = np.roll(scipy.fft.irfft(spectra, length, axis=1), most_lag, axis=1)[:, : 2 * most_lag + 1]
    return np.asarray(lagged[np.arange(len(lagged)), np.abs(lagged).argmax(axis=1)])


REMEDIES: dict[Verdict, str] = {
    "dead": "check its cable, its amplifier channel and its coil, and that the beam meets the surface near it",
    "weak": "check its glue, its coil's gap and its amplifier's gain",
    "reversed": "swap the two wires of its coil, or leave it: a bank measured with it is right all the same",
    "unlike": "check the mirror map, its place in the rig file, its glue, and what touches the surface near it",
}
DECAY_S = 0.2
RESPONSE_S = 0.08  # the first waves; what comes back from the edge differs from place to place
# A record that fits worse was spoilt on the way, by speckle for instance.
POOR_RESIDUAL_DB = -30.0


def listening_places(actuator_mm: Float64Array, distance_mm: float) -> Float64Array:
    """Places at one distance from each actuator, on the way to the surface's centre.

    actuator_mm, float64 (actuators, 2): Where the actuators are.
    distance_mm: Distance from each, > 0.

    Returns float64 (actuators, 2).
    """
    from_centre_mm = np.hypot(*actuator_mm.T)[:, np.newaxis]
    outwards = np.where(from_centre_mm > 0, actuator_mm / np.maximum(from_centre_mm, 1e-9), [[-1.0, 0.0]])
    return np.asarray(actuator_mm - distance_mm * outwards)


def measure_actuators(
    place_mm: Float64Array,
    amplitude_v: float,
    sample_rate_hz: float,
    setup: Setup,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> _ActuatorComparison:
    """Listen to each actuator at the same distance and compare them.

    place_mm, float64 (actuators, 2): Where each is listened to.
    amplitude_v: Peak of the sweep in volts.
    setup: The rig, the vibrometer plugged into its response input.
    progress: Called with the actuators done and the actuators there are.

    Raises NotMeasuredError: no signal from the loopback, or a response is too loud for its input. InstrumentError: of
    the instrument that failed for good.
    """
    excitation = PlayedExcitation(sample_rate_hz, *BAND_HZ, SWEEP_S, DECAY_S, amplitude_v, averages=1)
    estimator = SequentialEstimator(excitation, round(RESPONSE_S * sample_rate_hz), channels_of(setup))
    estimates: list[Estimate] = []
    for actuator, (x_mm, y_mm) in enumerate(place_mm):
        progress(actuator, len(place_mm))
        point_at(setup, float(x_mm), float(y_mm))
        estimates.append(_best_of(setup, excitation, estimator, actuator))
    progress(len(place_mm), len(place_mm))
    green = np.stack([estimate.green[0] for estimate in estimates])
    return compare_actuators(green, np.array([estimate.snr_db[0] for estimate in estimates]), sample_rate_hz)


def _best_of(setup: Setup, excitation: PlayedExcitation, estimator: SequentialEstimator, actuator: int) -> Estimate:
    """The best of a few records of one actuator; the first that is good enough ends it."""
    play, found = Play(actuator, setup.signals_v(excitation.signal_v(), actuator)), list[Estimate]()
    for attempt in range(1, TRIES + 1):
        label = RecordLabel(actuator, attempt, 0, "calibration")
        recording = record_play(setup, play, excitation.sample_rate_hz, label)
        if any(recording.over_range):
            raise NotMeasuredError(
                f"actuator {actuator} at {excitation.amplitude_v:g} V reaches the end of an input's range: lower "
                "--amplitude-v, or raise the ranges in the rig file"
            )
        try:
            found.append(estimator.estimate(recording.volts[:1], recording.volts[1:], range_v=setup.range_v))
        except ReferenceMissingError as missing:
            raise _check_loopback(missing) from None
        if found[-1].residual_db[0] < POOR_RESIDUAL_DB and found[-1].snr_db[0] > HEARD_DB:
            break
    return min(found, key=lambda estimate: float(estimate.residual_db[0]))
