"""Crosstalk as a symptom: what of a difference between scan and prediction a leak of the loopback makes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.crosstalk import Crosstalk
from wavefocus.calibration.evidence import CERTAIN_SHARE
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.verify.results import Symptom

if TYPE_CHECKING:
    from wavefocus.rendering.verify.comparison import FieldComparison


def crosstalk_symptom(found: Crosstalk, fields: FieldComparison, marker_v: Float64Array | None) -> Symptom:
    """The symptom of a leak that was measured by itself, and the share of the excess that it explains.

    The same at all positions, a scan has the leaking marker, and a prediction from a bank that was measured with the
    leak has the sum of the drives.

    found: Level and delay of the leak.
    marker_v, float64 (samples,): What the loopback played in the scan; None for a leak that only the bank has.
    """
    spectra = fields.spectra
    late = np.exp(-2j * np.pi * spectra.frequency_hz * found.delay_s)
    pulses = [late * spectra.drive.sum(axis=0)]
    if marker_v is not None:
        turns = np.outer(spectra.frequency_hz, np.arange(marker_v.size) / fields.sample_rate_hz)
        pulses.append(late * (np.exp(-2j * np.pi * turns) @ marker_v))
    difference = (spectra.scanned - spectra.predicted).astype(np.complex128)
    excess = float(np.sum(np.abs(difference) ** 2)) - float(np.nansum(spectra.noise))
    # Real factors: a leak is a share. The mean over the positions is all that it can change.
    mean = difference.mean(axis=0)
    basis = np.stack([np.concatenate([pulse.real, pulse.imag]) for pulse in pulses], axis=1)
    wanted = np.concatenate([mean.real, mean.imag])
    fitted = basis @ np.linalg.lstsq(basis, wanted, rcond=None)[0]
    gained = len(difference) * (float(wanted @ wanted) - float(np.sum((wanted - fitted) ** 2)))
    explained = float(np.clip(gained / excess, 0.0, 1.0)) if excess > 0.0 else 0.0
    certain = explained >= CERTAIN_SHARE
    return Symptom("crosstalk", (), found.level_db, explained, certain, delay_s=found.delay_s)


def with_crosstalk(symptoms: tuple[Symptom, ...], leak: Symptom) -> tuple[Symptom, ...]:
    """All symptoms: one that explains enough takes the place of guesses, else it stands behind the others."""
    if leak.certain:
        return (leak, *(symptom for symptom in symptoms if symptom.certain and symptom.code != "wrong_bank"))
    return (*symptoms, leak)
