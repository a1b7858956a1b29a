"""Error of Green's functions from white noise, as it follows from the signal-to-noise ratios of their records."""

import json
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration import Float64Array
from wavefocus.storage.bank.ledger import median_of_pairs
from wavefocus.storage.bank.reading import Bank


def noise_error_db(
    snr_db: NDArray[np.floating], *, band_hz: tuple[float, float], response_s: float, period_s: float
) -> Float64Array:
    """Relative L2 error in band that white noise leaves in Green's functions.

    The ratio compares energies before the fit, over all bins of a period; a causal FIR of T seconds takes up only the
    noise of its own degrees of freedom, about 2 W T + 2 ln(2 pi W T) in a band of W Hz, so that its error is lower by
    their share.

    snr_db, any shape: Signal-to-noise ratio in band of the records, see `Estimate`; NaN where unknown.
    band_hz: Lowest and highest frequency of the sweep in Hz.
    response_s: Length of the FIRs in seconds, > 0.
    period_s: Sweep and silence (staggered: a period of the record) in seconds, > 0.

    Returns float64, the same shape: dB; held against the virtual rig's truth within 1 dB (tests/system/test_schedules).
    """
    width_hz = band_hz[1] - band_hz[0]
    freedom = 2 * width_hz * response_s + 2 * math.log(max(2 * math.pi * width_hz * response_s, 1.0))
    share = min(freedom / (2 * width_hz * period_s), 1.0)
    return np.asarray(10 * math.log10(share) - np.asarray(snr_db, np.float64))


def noise_share(error_db: NDArray[np.floating]) -> Float64Array:
    """Share that noise has in the energy of measured rows, 0 to 1, by their `noise_error_db`; NaN where unknown.

    Of a row that holds nothing but noise the ratio falls without end (to -225 dB), and noise is all that it holds.
    """
    return np.asarray(np.minimum(10.0 ** (0.1 * np.asarray(error_db, np.float64)), 1.0))


def bank_noise_error_db(bank: Bank) -> Float64Array | None:
    """The same of every row of a bank, (positions, actuators).

    NaN where a ratio is unknown; None where the bank does not state its band and how it was measured.
    """
    ratios_db, period_s = bank.quality.get("snr_db"), _period_s(bank.run_json, bank.actuators)
    if ratios_db is None or period_s is None or bank.band_hz is None:
        return None
    response_s = bank.taps / bank.sample_rate_hz
    return noise_error_db(ratios_db, band_hz=bank.band_hz, response_s=response_s, period_s=period_s)


def median_noise_error_db(bank: Bank) -> float | None:
    """Median of `bank_noise_error_db` over all measured pairs (position, actuator); None where none is known."""
    return median_of_pairs(bank_noise_error_db(bank), bank.status)


def _period_s(run_json: str | None, actuators: int) -> float | None:
    """Period of the records in s, by the run's configuration; None where another program has written that text."""
    try:
        run = json.loads(run_json or "")
        sweep: Mapping[str, Any] = run["sweep"]
        capture: Mapping[str, Any] = run["capture"]
        if capture["excitation"] == "staggered":
            period_s = -(-actuators // capture["groups"]) * float(capture["stagger_s"])
        else:
            period_s = float(sweep["duration_s"]) + float(capture["decay_s"])
    except (ValueError, TypeError, KeyError, ZeroDivisionError, RecursionError):
        return None
    return period_s if 0 < period_s < math.inf else None
