"""One known signal on both inputs of the recorder: how much later it is on one, and how strong on each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from calibration.clock.timing import ClockFit, ClockFitter, ReferenceMissingError


class ResponseMissingError(ReferenceMissingError):
    """The response channel does not hold the known signal."""


@dataclass(frozen=True, slots=True)
class Comparison:
    """The known signal on the reference and on the response channel of one record.

    late_s: How much later the signal is on the response channel than on the reference channel, on the record's own time
        axis, in which both channels are sampled at once.
    reference, response: The signal on either channel.
    """

    late_s: float
    reference: ClockFit
    response: ClockFit


class ChannelComparer:
    """Compares the two channels of records of one known signal.

    Each channel is fitted by itself; they are compared at the signal's centre of energy, where a fit's offset and
    ratio do not trade errors.

    known_v, float64 (known,): What was played in volts, on the playback clock, its silences included.
    sample_rate_hz: Nominal rate of the record.
    """

    def __init__(self, known_v: NDArray[np.float64], sample_rate_hz: float) -> None:
        self._fitter = ClockFitter(known_v)
        self._rate_hz = sample_rate_hz
        energy = known_v**2
        self._centre = float(np.arange(known_v.size) @ energy / energy.sum())

    def compare(self, reference_v: ArrayLike, response_v: ArrayLike) -> Comparison:
        """Find the signal on both channels of one record.

        reference_v, response_v, (samples,): The two channels in volts, on the DAQ clock.

        Raises ReferenceMissingError: the reference does not hold the signal. ResponseMissingError: the response does
        not.
        """
        reference = self._fitter.fit(reference_v)
        try:
            response = self._fitter.fit(response_v)
        except ReferenceMissingError as missing:
            raise ResponseMissingError(str(missing).replace("reference channel", "response channel")) from None
        late = (response.offset_samples + response.ratio * self._centre) - (
            reference.offset_samples + reference.ratio * self._centre
        )
        return Comparison(late / self._rate_hz, reference, response)
