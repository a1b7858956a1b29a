"""How much later the response input is sampled than the reference input."""

from __future__ import annotations

from acquisition.calibration_procedures.operator import BOTH, Operator
from acquisition.calibration_procedures.probe import Figures, NotMeasuredError, Probe, check_loopback
from calibration.clock.timing import ReferenceMissingError
from calibration.rig.channel_comparison import ResponseMissingError

# One cable into two inputs: what differs by more is another signal, or a broken input.
MOST_GAIN_ERROR = 0.05
MOST_DELAY_S = 1e-3


def measure_inputs(probe: Probe, operator: Operator) -> Figures:
    """Listen to one signal on both inputs; the response channel is later by as much as it is sampled earlier.

    Parameters
    ----------
    probe : Probe
        What plays.
    operator : Operator
        Plugs the loopback into both inputs.

    Returns
    -------
    Figures
        `late_s` is the inter-channel delay: how much later the response is sampled than the reference.

    Raises
    ------
    NotMeasuredError
        The signal is not on both inputs, or not alike.
    InstrumentError
        Of the instrument that failed for good.
    """
    while True:
        operator.connect(BOTH)
        try:
            found = probe.compare(None)
        except ResponseMissingError as missing:
            if operator.again(f"the loopback is not heard at the response input ({missing})"):
                continue
            raise NotMeasuredError("the inter-channel delay needs the loopback on both inputs") from None
        except ReferenceMissingError as missing:
            raise check_loopback(missing) from None
        break
    apart = found.response_gain / found.reference_gain - 1
    if abs(apart) > MOST_GAIN_ERROR:
        raise NotMeasuredError(
            f"the two inputs hear the same cable {100 * apart:+.1f} % apart: check cables and terminal configuration"
        )
    # The same wave appears earlier in a channel that is sampled later.
    delay_s = -found.late_s
    if abs(delay_s) > MOST_DELAY_S:
        raise NotMeasuredError(
            f"the inputs are sampled {1e3 * delay_s:.3f} ms apart, more than a multiplexer needs: is the signal on the "
            "response input the loopback itself?"
        )
    return Figures(delay_s, found.spread_s, found.reference_gain, found.response_gain, found.clock_ppm)
