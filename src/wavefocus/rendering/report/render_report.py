"""Report of a render: points snapped, drives scaled, parts left out, ends of responses, and warnings."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from wavefocus.calibration.numerics import evenly_spread
from wavefocus.rendering.arrays import Float64Array
from wavefocus.rendering.device import fast_length
from wavefocus.rendering.drive.coil_limits import Limiting
from wavefocus.rendering.field.metrics import band_weights, range_db
from wavefocus.rendering.field.wave_figures import impulse_travel
from wavefocus.rendering.greens.interpolation.errors import InterpolationErrors
from wavefocus.rendering.greens.regularisation import BankRows
from wavefocus.rendering.greens.source import DOUBTFUL_BITS, GreenSource, RowReader
from wavefocus.rendering.number_text import listed
from wavefocus.rendering.scene.emission import ContinuousEmission
from wavefocus.rendering.scene.model import Scene
from wavefocus.rendering.scene.sampling import SampledSource
from wavefocus.storage.drive_file import QuietTrack
from wavefocus.storage.errors import InputError

if TYPE_CHECKING:
    from wavefocus.rendering.drive.quiet_scene import QuietFigures

ROWS = 6


@dataclass(frozen=True, slots=True)
class ResponseTail:
    """The end of some rows' Green's functions.

    position: The row whose end is loudest.
    last_tenth_db: Energy of the last tenth of its taps over that of all, all actuators together.
    beyond_share: Share of the whole response's energy that lies beyond the window, 0 to 1, if it dies away from half
        window to half window as it does within: with r the energy of the second half over that of the first, r squared.
    """

    position: int
    last_tenth_db: float
    beyond_share: float

    @property
    def warning(self) -> str | None:
        """One sentence where the end is loud."""
        # Level of the last tenth from which it is said: 1 % of the response, the error of a sound bank's rows.
        if self.last_tenth_db <= -40.0:
            return None
        return (
            f"the last tenth of the Green's functions holds {self.last_tenth_db:z.0f} dB of their energy (position"
            f" {self.position}); if they die away as they do until then, {100 * self.beyond_share:.3g} % of the"
            " response lies beyond the bank's window: measure with more taps, or look for noise or for what wraps round"
        )


def _response_tail(bank: GreenSource, rows: Sequence[int]) -> ResponseTail | None:
    """Look at the ends of at most six of the rows, evenly chosen.

    A long response has a loud end with and without a low-pass at the upper end of the bank's band; noise beyond the
    band has it only without, the low-pass's own ringing only with it. So the quieter of both counts.

    Returns ResponseTail or None: None where there is no row, none that is not silent, or Green's functions have fewer
    than ten taps.
    """
    if not len(rows) or bank.taps < 10:
        return None
    found: ResponseTail | None = None
    chosen = [rows[index] for index in evenly_spread(len(rows), ROWS)]
    reader = RowReader(bank)
    green = np.stack([reader.read(row) for row in chosen]).astype(np.float32)
    kinds = [green]
    if bank.band_hz is not None:
        length = fast_length(2 * bank.taps)
        weights = band_weights(length, float(bank.sample_rate_hz), (1e-9, bank.band_hz[1]))
        kinds.append(np.fft.irfft(np.fft.rfft(green, length) * weights, length)[..., : bank.taps].astype(np.float32))
    for place, row in enumerate(chosen):
        ends = [_end_of(np.square(kind[place], dtype=np.float64).sum(axis=0)) for kind in kinds]
        last, ratio = min(ends)
        if not math.isnan(last) and (found is None or last > found.last_tenth_db):
            found = ResponseTail(row, last, ratio**2)
    return found


def _end_of(energy: Float64Array) -> tuple[float, float]:
    """Level of the last tenth in dB, NaN of silence, and energy of the second half over that of the first, up to 1."""
    total, taps = float(energy.sum()), len(energy)
    if total == 0.0:
        return math.nan, 1.0
    share = float(energy[-(taps // 10) :].sum()) / total
    first, second = float(energy[: taps // 2].sum()), float(energy[taps // 2 :].sum())
    return 10.0 * math.log10(share) if share > 0 else -math.inf, min(second / first, 1.0) if first > 0 else 1.0


SPREAD_SHARE = 0.1
"""Share of the signal's energy that cutting it into segments may move out of the band without a warning."""


class RenderWarning(UserWarning):
    """A remark about a drive that is right."""


@dataclass(frozen=True, slots=True)
class RenderReport:
    """Figures of one render.

    relative_rms_drive, float64 (actuators,): RMS of each actuator's drive relative to the largest (the paper's figure
        3B, right).
    out_of_band: Per source, the share of the emitted windows' energy outside the bank's band; None where it is unknown.
    omitted_bound: Proved bound on the relative error of the drives, 0 in double precision.
    interpolation_errors: Estimated error of the Green's functions between the bank's positions, by band; None where the
        paths keep to the positions, or the bank has too few of them.
    tail: Ends of some of the Green's functions, and an estimate of the response beyond them.
    quiet: Places that are kept quiet, and what that costs; None where there is none.
    """

    warnings: tuple[str, ...]
    limiting: Limiting
    relative_rms_drive: Float64Array
    out_of_band: tuple[float | None, ...]
    omitted_bound: float
    interpolation_errors: InterpolationErrors | None = None
    tail: ResponseTail | None = None
    quiet: QuietFigures | None = None

    @property
    def quiet_tracks(self) -> tuple[QuietTrack, ...]:
        """The places that are kept quiet, as drive files keep them."""
        return () if self.quiet is None else tuple(level.track for level in self.quiet.levels)

    @property
    def scale(self) -> float:
        """Factor by which the limits scaled the drive, 1 if they did not."""
        return self.limiting.scale

    @property
    def dynamic_range_db(self) -> float:
        """Largest over smallest rms of all actuators that are driven at all, in dB; 0 where fewer than two are."""
        found_db = range_db(self.relative_rms_drive)
        return 0.0 if math.isnan(found_db) else found_db


def report_render(
    scene: Scene,
    rows: BankRows,
    sources: Sequence[SampledSource],
    statistics: Float64Array,
    norms: Float64Array,
    *,
    limiting: Limiting,
    omitted_bound: float,
    errors: InterpolationErrors | None = None,
    remarks: Sequence[str] = (),
    quiet: QuietFigures | None = None,
) -> RenderReport:
    """Collect the figures and warnings of a render; `statistics` are those of `BlockAccumulator`."""
    measured: GreenSource = getattr(rows.bank, "measured", rows.bank)
    peak = float(norms.max())
    outside = tuple(1.0 - within / energy if energy > 0 else None for within, energy in statistics.tolist())
    tail = _response_tail(measured, [row for row in rows.used if row < measured.positions])
    warnings = [
        *_silent(rows),
        *_doubtful(rows),
        *remarks,
        *(quiet.warnings if quiet is not None else ()),
        *([str(caution)] if (caution := getattr(measured, "import_facts", {}).get("caution")) else []),
        *([tail.warning] if tail is not None and tail.warning is not None else []),
        *_too_fast(scene, rows),
        *(text for source, share in zip(sources, outside, strict=True) for text in _spread(source, share, rows.bank)),
    ]
    if peak == 0:
        warnings.append("the drive is silent: every amplitude is 0")
    return RenderReport(
        warnings=tuple(warnings),
        limiting=limiting,
        relative_rms_drive=norms / peak if peak > 0 else norms,
        out_of_band=outside,
        omitted_bound=omitted_bound,
        interpolation_errors=errors,
        tail=tail,
        quiet=quiet,
    )


def _silent(rows: BankRows) -> list[str]:
    if not (silent := rows.silent_actuators):
        return []
    return [f"actuator {listed(silent)}: all Green's functions on the path are zero, so the drive is zero there"]


def _doubtful(rows: BankRows) -> list[str]:
    doubtful = [row for row in rows.used if int(rows.status[row]) & DOUBTFUL_BITS]
    if not doubtful:
        return []
    return [f"position {listed(doubtful)} on the path: measured over range or with poor signal; remeasure to be sure"]


def _too_fast(scene: Scene, rows: BankRows) -> list[str]:
    speeds = [source.mean_speed_mm_s for source in scene.sources]
    # No plate or soft solid that is focused on carries waves slower than this.
    if max(speeds) < 500.0:
        return []
    try:
        travel = impulse_travel(rows.bank, rows.bank.band_hz, (1.0, math.inf), rows.used)
    except InputError:
        return []
    wave, error = travel.group_velocity_m_s, travel.velocity_error_m_s
    return [
        f"source {index} moves at {speed / 1000:.3g} m/s, faster than the waves (about {wave:.2g} m/s, give or take"
        f" {error:.1g} m/s, by their arrival times); the focus is rendered, but waves pile up along the path"
        for index, speed in enumerate(speeds)
        if travel.is_sure and speed > 1000 * wave
    ]


def _spread(source: SampledSource, share: float | None, bank: GreenSource) -> list[str]:
    moves = isinstance(source.emission, ContinuousEmission)
    if share is None or bank.band_hz is None or not moves or share <= SPREAD_SHARE:
        return []
    # In single precision, which does for a share; about 1 it neither over- nor underflows.
    # A signal is padded to so many samples, so that a click has bins outside the bank's band, too.
    samples = fast_length(max(len(source.signal), (2**13)))
    peak = float(np.abs(source.signal).max(initial=0.0))
    signal = (source.signal / (peak if peak > 0 else 1.0)).astype(np.float32)
    spectrum = np.fft.rfft(signal, samples)
    power = np.square(spectrum.real) + np.square(spectrum.imag)
    low, high = (edge_hz * samples / bank.sample_rate_hz for edge_hz in bank.band_hz)
    whole, inside = float(power.sum()), float(power[math.ceil(low) : math.floor(high) + 1].sum())
    own = 1.0 - inside / whole if whole > 0 else 0.0
    if share - own <= SPREAD_SHARE:
        return []
    return [
        f"source {source.index}: moving from row to row cuts its signal so short that {100 * share:.0f} % of its energy"
        f" lies outside the bank's band ({100 * own:.0f} % of the signal's own does); lower the speed or use a finer"
        " interpolation"
    ]
