"""Rows of a file as Green's functions: unit, rate, taps, first sample and ends."""

import itertools
import math
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from wavefocus.calibration import Float64Array
from wavefocus.calibration.imports.causal_response import CausalConverter, frequency_axis
from wavefocus.options import ImportOptions
from wavefocus.storage.errors import InputError
from wavefocus.storage.exchange.measured import Measured, require_honest
from wavefocus.storage.units import MOTIONS, require_meant_rate, split_unit

_NOTICED_DB = -40.0
"""What is left out and holds more of the energy than this is a warning: it moves a response by 1 %."""


class Conversion:
    """Rows of a file as Green's functions, float32 (N, L), at the bank's rate and in its unit."""

    def __init__(self, measured: Measured, options: ImportOptions, source: Path) -> None:
        self._source, self._options = source, options
        self.said: list[str] = []
        self.assumed: list[str] = []
        self._count = measured.shape[1]
        self._measured = np.ones(measured.shape[0], bool) if measured.status is None else measured.status != 0
        self._choose_unit(measured)
        rows, before = iter(measured.rows), list[NDArray[Any]]()
        for first in rows:
            # A position that was not measured does not show how its values lie.
            if self._is_measured(len(before), first):
                before.append(first)
                break
            before.append(np.zeros(1))
        if not before:
            raise InputError(f"{source}: holds no response")
        self._rows = itertools.chain(before, rows)
        self._converter: CausalConverter | None = None
        self._take: Callable[[NDArray[Any]], NDArray[Any]] = np.asarray
        self._cut = self._whole = self._all_lines = self._lines_out = 0.0
        self._shift = 0
        if measured.frequency_hz is not None:
            self._from_spectra(measured, np.asarray(first))
        else:
            self._from_samples(measured)
        require_meant_rate(self.rate_hz, str(source))

    def _choose_unit(self, measured: Measured) -> None:
        unit = self._options.unit or measured.unit
        if not unit:
            raise InputError(
                f"{self._source} does not say the unit of its responses; name it with --unit, as --unit m/s/V"
            )
        try:
            over, self.drive_unit = split_unit(unit)
        except InputError as error:
            raise InputError(f"{self._source}: {error}; name it with --unit, as --unit m/s/V") from None
        if self._options.unit and measured.unit and measured.unit != self._options.unit:
            self.assumed.append(f"the unit is {unit}, as asked, where the file says {measured.unit}")
        self.is_motion = over in MOTIONS
        self.response_unit = over if self.drive_unit == "1" else f"{over}/{self.drive_unit}"

    def _band(self, measured: Measured) -> tuple[float, float] | None:
        if self._options.band_hz is None:
            return measured.band_hz
        low, high = self._options.band_hz
        if not 0 <= low < high < np.inf:
            raise InputError(f"--band is {low:g},{high:g}; 0 <= low < high is needed, in Hz")
        return low, high

    def _from_spectra(self, measured: Measured, first: NDArray[Any]) -> None:
        assert measured.frequency_hz is not None
        try:
            axis = frequency_axis(measured.frequency_hz, np.nan_to_num(first))
        except InputError as error:
            raise InputError(f"{self._source}: {error}") from None
        step, bins = axis.step_hz, axis.bins
        asked = self._options.sample_rate_hz or measured.sample_rate_hz
        period = asked / step if asked else float(axis.period or 2 * bins[-1])
        if abs(period - round(period)) > 0.01 or round(period) < 2 * bins[-1] or not period < 2**31:
            raise InputError(
                f"{self._source}: --sample-rate-hz {asked or 0:g}: a multiple of the frequencies' step, {step:.9g} Hz,"
                f" and at least twice the highest, {bins[-1] * step:.9g} Hz, is needed"
            )
        period = round(period)
        self.rate_hz = float(asked or self._tidy(period * step))
        band = self._band(measured)
        used = np.ones(len(bins), bool)
        if band is not None:
            used = (bins * step >= band[0] - 0.01 * step) & (bins * step <= band[1] + 0.01 * step)
        constant = axis.one_sided(np.asarray(first))[:, 0]
        if bins[0] == 0 and not np.isfinite(constant).all():
            used[0] = False
            self.said.append("the value at 0 Hz is left out")
        if not asked and not axis.period:
            self.assumed.append("the rate is twice the highest frequency; --sample-rate-hz names another")
        if used.sum() < 2:
            raise InputError(f"{self._source}: fewer than two frequencies lie in the band; name another with --band")
        self._take = lambda row: self._lines(axis.one_sided(row), used)
        bins = bins[used]
        self.band_hz = (float(bins[0] * step), min(float(bins[-1] * step), self.rate_hz / 2))
        complete = len(bins) == period // 2 + 1
        self.taps = self._options.taps or period
        if self.taps > period:
            raise InputError(f"{self._source}: --taps {self.taps}: at most the {period} samples of a period are there")
        self._converter = CausalConverter(bins, period, self.taps)
        side = "two-sided" if axis.period else "one-sided"
        missing = "" if complete else "; the rest up to half the rate is left to the fit of a causal response"
        self.said.append(
            f"{len(bins)} frequencies from {self.band_hz[0]:g} to {self.band_hz[1]:g} Hz ({side}, step {step:.6g} Hz)"
            f" became causal FIRs of {self.taps} taps of a period of {period}{missing}"
        )

    def _from_samples(self, measured: Measured) -> None:
        if not measured.sample_rate_hz:
            raise InputError(f"{self._source} does not say its sample rate; name it with --sample-rate-hz")
        asked = self._options.sample_rate_hz
        if asked and not math.isclose(asked, measured.sample_rate_hz, rel_tol=1e-6):
            raise InputError(
                f"{self._source}: --sample-rate-hz {asked:g}: the file says {measured.sample_rate_hz:.9g} Hz, and"
                " samples are not resampled; leave the option out"
            )
        self.rate_hz = self._tidy(measured.sample_rate_hz)
        shift = measured.start_s * self.rate_hz
        samples = measured.shape[2]
        if not abs(shift) <= 10 * samples + 1e6 or abs(shift - round(shift)) > 0.05:
            raise InputError(
                f"{self._source}: the first sample is at {measured.start_s:.6g} s, {shift:.3f} samples; a whole number"
                " is needed"
            )
        self._shift = round(shift)
        if self._shift:
            words = "zeros before it" if self._shift > 0 else "samples before 0 s left out"
            self.said.append(f"the first sample is at {measured.start_s:.6g} s: {abs(self._shift)} {words}")
        length = max(samples + self._shift, 1)
        band = self._band(measured)
        self.band_hz = (0.0, self.rate_hz / 2) if band is None else (band[0], min(band[1], self.rate_hz / 2))
        if not self.band_hz[0] < self.band_hz[1]:
            raise InputError(
                f"{self._source}: the band is {band}; it ends below half the rate, {self.rate_hz / 2:g} Hz"
            )
        if band is None:
            self.assumed.append("the band is not known and stands as 0 Hz to half the rate")
        self.taps = self._options.taps or length
        require_honest(self._source, "--taps", 4 * self._count * self.taps, 4 * self._count * length)

    def _lines(self, values: NDArray[Any], used: NDArray[Any]) -> NDArray[Any]:
        """Values at the lines that are used; what the others hold is counted."""
        kept, whole = values[:, used], np.nan_to_num(values)
        self._all_lines += _energy(np.abs(whole))
        self._lines_out += max(_energy(np.abs(whole)) - _energy(np.abs(kept)), 0.0)
        return kept

    def _tidy(self, rate_hz: float) -> float:
        """A whole rate where the file's digits allow it."""
        whole = float(round(rate_hz))
        if whole == rate_hz or not abs(whole - rate_hz) <= 1e-5 * rate_hz:
            return rate_hz
        if abs(whole - rate_hz) > 1e-9 * rate_hz:
            self.assumed.append(f"the rate is {whole:g} Hz, where the file's digits give {rate_hz:.9g} Hz")
        return whole

    def _shifted(self, row: NDArray[Any]) -> NDArray[np.float32]:
        """Samples of a row from 0 s on, (N, L)."""
        late = row[:, max(-self._shift, 0) :]
        start = max(self._shift, 0)
        out = np.zeros((len(row), self.taps), np.float32)
        out[:, start : start + late.shape[1]] = late[:, : max(self.taps - start, 0)]
        return out

    def rows(self) -> Iterator[tuple[int, NDArray[np.float32] | None, Float64Array | None]]:
        """Position, Green's functions (None where it was not measured) and residual in dB of each actuator, if any.

        Not measured are rows that are missing or zero throughout, as in a bank, and those that the file's status says.
        """
        for position, row in enumerate(self._rows):
            if not self._is_measured(position, row):
                yield position, None, None
            else:
                # What is beyond single precision becomes infinite and is refused.
                with np.errstate(over="ignore", invalid="ignore"):
                    green, residual_db = self._converted(row, position)
                yield position, green, residual_db

    def _is_measured(self, position: int, row: NDArray[Any]) -> bool:
        return bool(self._measured[position] and row.any() and not np.isnan(row).all())

    def _converted(self, row: NDArray[Any], position: int) -> tuple[NDArray[np.float32], Float64Array | None]:
        residual_db = None
        if self._converter is not None:
            values = self._take(row)
            self._require_finite(values, position)
            green, share = self._converter.convert(values)
            residual_db = 10 * np.log10(np.maximum(share, 1e-30))
        else:
            self._require_finite(row, position)
            green = self._shifted(row)
            first, last = max(-self._shift, 0), max(self.taps - self._shift, 0)
            self._whole += _energy(row)
            self._cut += _energy(row[:, :first]) + _energy(row[:, max(last, first) :])
        self._require_finite(green, position)
        return green, residual_db

    def _require_finite(self, row: NDArray[Any], position: int) -> None:
        if not np.isfinite(row).all():
            actuator = int(np.argmin(np.isfinite(row).all(axis=1)))
            raise InputError(
                f"{self._source}: the response at position {position} to actuator {actuator} holds NaN or infinity, or"
                " values beyond single precision; finite values are needed"
            )

    @property
    def residual_db(self) -> float | None:
        """Energy that causal FIRs, or samples that are left out, leave unexplained, in dB; None where nothing is."""
        if self._converter is not None:
            whole, left = self._converter.whole, self._converter.left
            return 10 * math.log10(max(left / whole, 1e-16)) if whole > 0 else None
        return 10 * math.log10(self._cut / self._whole) if self._cut > 0 else None

    @property
    def warnings(self) -> list[str]:
        """What is left out and holds more than `_NOTICED_DB`, and frequency responses that are not causal."""
        found = [] if self._converter is None else self._converter.energy.words()[1]
        return [*found, *(f"{text}; {remedy}" for level_db, text, remedy in self._left_out() if level_db > _NOTICED_DB)]

    def ending(self) -> list[str]:
        """Sentences about what the FIRs leave out, once all rows are converted."""
        said = [] if self._converter is None else self._converter.energy.words()[0]
        return [*said, *(text for _, text, _ in self._left_out())]

    def _left_out(self) -> Iterator[tuple[float, str, str]]:
        """Level in dB of what is left out, a sentence about it, and what keeps it."""
        level_db = -math.inf if self.residual_db is None else self.residual_db
        if self._converter is not None:
            level = f"{level_db:.1f} dB" if level_db > -140 else "below -140 dB"
            text = f"causal FIRs of {self.taps} taps leave {level} of the energy in the band unexplained"
            yield level_db, text, "a larger --taps, or none, keeps it"
        elif self._cut > 0:
            what, remedy = "samples before 0 s, which are left out,", "0 s must be the instant of the drive"
            if self._options.taps:
                what, remedy = "samples left out", "a larger --taps, or none, keeps it"
            yield level_db, f"{what} hold {level_db:.1f} dB of the energy", remedy
        if self._lines_out > 0:
            level_db = 10 * math.log10(max(self._lines_out / self._all_lines, 1e-30))
            text = f"frequencies left out hold {level_db:.1f} dB of the energy"
            yield level_db, text, "a wider --band, or none, keeps those that the file holds"


def _energy(rows: NDArray[Any]) -> float:
    return float(np.square(rows, dtype=np.float64).sum())
