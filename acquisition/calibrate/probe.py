"""The signal that calibration listens for, and records of it on both inputs."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from acquisition.measuring.record import take_record
from acquisition.measuring.setup import Setup
from calibration.clock.timing import ReferenceMissingError
from calibration.excitation.sweeps import Excitation
from calibration.rig.comparison import ChannelComparer, Comparison, ResponseMissingError
from drivers.errors import TransientInstrumentError
from drivers.protocols import Float64Array, Recording, Take
from storage.errors import WavefocusError

# Above what coupling capacitors turn, and below what converters begin to fold back.
LOWEST_HZ = 200.0
HIGHEST_SHARE = 0.4
DURATION_S, SILENCE_S = 0.5, 0.05
RECORDS = 3
TRIES = 3
# A cable brings at least this much of the reference's level, through a summing box too; crosstalk is far below.
LEAST_OF_REFERENCE = 0.02


class NotMeasuredError(WavefocusError):
    """What was to be calibrated cannot be measured as things are; the message says what to do."""


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


class Probe:
    """Plays a band-limited sweep and compares the two inputs.

    amplitude_v: Peak of the sweep in volts, by the full scale that the rig believes in.
    """

    def __init__(self, setup: Setup, sample_rate_hz: float, amplitude_v: float) -> None:
        self._setup = setup
        self._rate_hz = sample_rate_hz
        band_hz = LOWEST_HZ, HIGHEST_SHARE * sample_rate_hz
        excitation = Excitation(sample_rate_hz, *band_hz, DURATION_S, SILENCE_S, amplitude_v, averages=1)
        self.amplitude_v = amplitude_v
        self._signal_v: Float64Array = excitation.signal_v()
        self._comparer = ChannelComparer(self._signal_v, sample_rate_hz)

    def compare(self, output: int | None) -> Figures:
        """Play the loopback, and one output with it, and compare the two inputs.

        output: The output; None for the loopback alone.

        Raises ReferenceMissingError: no signal from the loopback at the reference input. ResponseMissingError: no
        signal at the response input. NotMeasuredError: the signal reaches the end of an input's range. InstrumentError:
        of the instrument that failed for good.
        """
        found = [self._once(output, record) for record in range(RECORDS)]
        late_s = [one.late_s for one in found]
        return Figures(
            late_s=float(np.median(late_s)),
            spread_s=max(late_s) - min(late_s),
            reference_gain=float(np.median([one.reference.gain for one in found])),
            response_gain=float(np.median([one.response.gain for one in found])),
            clock_ppm=float(np.median([one.reference.skew_ppm for one in found])),
        )

    def detects(self, output: int | None) -> bool:
        """Whether the response input has a cable to what plays: the loopback, and one output with it.

        output: The output; None for the loopback alone.

        Raises NotMeasuredError: the loopback is not on the reference input. InstrumentError: of the instrument that
        failed for good.
        """
        try:
            found = self._comparer.compare(*self._played(output, 0).volts)
        except ResponseMissingError:
            return False
        except ReferenceMissingError as missing:
            raise check_loopback(missing) from None
        return abs(found.response.gain) >= LEAST_OF_REFERENCE * abs(found.reference.gain)

    def _once(self, output: int | None, record: int) -> Comparison:
        recording = self._played(output, record)
        for name, reached, range_v in zip(
            ("reference", "response"), recording.over_range, self._setup.range_v, strict=True
        ):
            if reached:
                raise NotMeasuredError(
                    f"the probe of {self.amplitude_v:g} V reaches the end of the {name} input's range of "
                    f"{range_v:g} V: lower --amplitude-v, or raise the range in the rig file"
                )
        return self._comparer.compare(*recording.volts)

    def _played(self, output: int | None, record: int) -> Recording:
        number = self._setup.loopback_channel if output is None else output
        signals_v = dict.fromkeys(sorted({self._setup.loopback_channel, number}), self._signal_v)
        return self._recorded(signals_v, number, record)

    def _recorded(self, signals_v: dict[int, Float64Array], number: int, record: int) -> Recording:
        """A record, taken again after a passing fault."""
        for attempt in range(1, TRIES):
            try:
                return take_record(self._setup, signals_v, self._rate_hz, Take(number, attempt, record, "calibration"))
            except TransientInstrumentError:
                continue
        return take_record(self._setup, signals_v, self._rate_hz, Take(number, TRIES, record, "calibration"))


def check_loopback(missing: ReferenceMissingError) -> NotMeasuredError:
    """What to say when there is no signal from the loopback itself: nothing can be calibrated without it."""
    return NotMeasuredError(f"no signal from the loopback at the reference input ({missing})")
