"""Banks for benchmarks: measured on the virtual rig, or the truth with noise."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import fft as scipy_fft

from wavefocus.acquisition.engine.campaign import Campaign
from wavefocus.acquisition.engine.session import StopRequest
from wavefocus.acquisition.grid import surface_grid
from wavefocus.acquisition.plan import Plan
from wavefocus.acquisition.setup import Setup
from wavefocus.calibration.excitation import PlayedExcitation, StaggeredSignal
from wavefocus.calibration.mirror_map import MirrorMap
from wavefocus.config.run import QualityLimits
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.rendering.field.metrics import band_weights
from wavefocus.rendering.greens.source import GreenArray
from wavefocus.storage.bank.layout import BankHeader, create_bank
from wavefocus.storage.bank.reading import Bank, open_bank
from wavefocus.storage.bank.writer import BankWriter

Float64Array = NDArray[np.float64]

RATE_HZ = 10_000.0
TAPS = 2000
BAND_HZ = (20.0, 500.0)
MARGIN_MM, SPACING_MM = 14.3, 4.0
QUICK_ERROR_DB = -58.0
"""Error of a campaign on the virtual rig (README)."""
CHUNK = 64


def paper_bank(out: Path, rig: VirtualRig, name: str, *, quick: bool) -> tuple[GreenArray, str]:
    """The bank ``plate-NAME.h5`` in a folder, measured there first if need be, and how; quick: the truth with noise."""
    if quick:
        bank = true_bank(rig, default_grid(rig), QUICK_ERROR_DB)
        return bank, f"true Green's functions with noise at {QUICK_ERROR_DB:g} dB"
    path = out / f"plate-{name}.h5"
    if not path.exists():
        # Under its final name only once it is whole: what is there is taken for a bank.
        part = path.with_name(f"measuring-{path.name}")
        part.unlink(missing_ok=True)
        measure_bank(part, sweep_plan(default_grid(rig), rig), rig_setup(rig))
        part.rename(path)
    with open_bank(path) as view:
        values = np.stack([view.green(row) for row in range(view.positions)])
        bank = GreenArray(
            values, np.asarray(view.position_mm), view.sample_rate_hz, status=np.asarray(view.status),
            actuator_mm=np.asarray(view.actuator_mm), band_hz=view.band_hz,
        )  # fmt: skip
    return bank, "measured on the virtual rig, three sweeps of 1 s per actuator and position"


def rig_setup(rig: VirtualRig) -> Setup:
    """The rig as engine and scan see it."""
    settings = rig.settings
    return Setup(
        mirror=rig.mirror,
        recorder=rig.recorder,
        player=rig.player,
        clock=rig.clock,
        mirror_map=MirrorMap.straight(1000.0),
        actuator_channels=settings.channel_of_actuator,
        loopback_channel=settings.channel_of_loopback,
        range_v=(settings.largest_range_v, settings.largest_range_v),
        response_per_volt=settings.sensitivity_m_s_per_v,
        inter_channel_delay_s=settings.inter_channel_delay_s,
    )


def sweep_plan(
    position_mm: Float64Array,
    rig: VirtualRig,
    *,
    staggered: bool = False,
    sweep_s: float = 1.0,
    averages: int = 3,
    periods: int = 1,
) -> Plan:
    """The default campaign at some positions: three sweeps of 1 s per actuator, or one period of staggered ones."""
    actuator_mm = np.asarray(rig.settings.actuator_mm, dtype=np.float64)
    sweep = PlayedExcitation(RATE_HZ, *BAND_HZ, sweep_s, TAPS / RATE_HZ, 1.0, averages)
    stagger = round(0.24 * RATE_HZ)
    signal = StaggeredSignal(sweep, rig.settings.actuators, TAPS, stagger, 1, periods) if staggered else None
    # Scattered positions of a grid would all be measured twice, which the whole grid is not.
    quality = QualityLimits(second_look="never")
    return Plan(position_mm, actuator_mm, sweep, TAPS, "0" * 64, quality, staggered=signal)


def measure_bank(path: Path, plan: Plan, setup: Setup) -> None:
    """Carry out a plan, into a new bank."""
    band_hz = plan.excitation.band_hz
    places = (plan.position_mm, plan.actuator_mm)
    create_bank(path, BankHeader(RATE_HZ, TAPS, band_hz, *places, "{}", "{}", plan.sha256, "wavefocus bench"))
    with BankWriter.open(path, plan_sha256=plan.sha256) as writer:
        Campaign(plan, setup, writer, lambda event: None, StopRequest()).run()


def true_bank(rig: VirtualRig, position_mm: Float64Array, error_db: float | None) -> GreenArray:
    """The plate's own Green's functions at any points, limited to the band."""
    length = int(scipy_fft.next_fast_len(2 * TAPS, real=True))
    weights = band_weights(length, RATE_HZ, BAND_HZ)
    used = np.flatnonzero(weights)
    bins = slice(int(used[0]), int(used[-1]) + 1)
    rng = np.random.default_rng(rig.settings.seed)
    values = np.empty((len(position_mm), rig.settings.actuators, TAPS), dtype=np.float32)
    for first in range(0, len(position_mm), CHUNK):
        part = rig.truth_spectra(position_mm[first : first + CHUNK], TAPS, length, bins, RATE_HZ)
        if error_db is not None:
            noise = rng.standard_normal((*part.shape, 2)).view(np.complex128)[..., 0]
            scale = np.linalg.norm(part, axis=2, keepdims=True) / np.linalg.norm(noise, axis=2, keepdims=True)
            part = part + 10.0 ** (error_db / 20.0) * scale * noise
        whole = np.zeros((*part.shape[:2], length // 2 + 1), dtype=np.complex128)
        whole[..., bins] = part * weights[bins]
        values[first : first + CHUNK] = scipy_fft.irfft(whole, length, axis=2)[..., :TAPS]
    actuator_mm = np.asarray(rig.settings.actuator_mm, dtype=np.float64)
    return GreenArray(values, position_mm, RATE_HZ, actuator_mm=actuator_mm, band_hz=BAND_HZ)


def default_grid(rig: VirtualRig) -> Float64Array:
    """The 1500 positions of the default campaign."""
    return surface_grid(rig.settings.outline, MARGIN_MM, SPACING_MM)


def compare_with_truth(bank: Bank, rig: VirtualRig) -> Float64Array:
    """Compare every measured pair with the plate's true FIR, over the bank's band.

    Returns (positions, actuators) ``20 log10(|G - G_true|_2 / |G_true|_2)``, NaN where not measured, over the bins
    from ``band_hz[0]`` to ``band_hz[1]`` of a transform of twice the length of the FIRs.
    """
    error_db = np.full((bank.positions, bank.actuators), np.nan)
    length = scipy_fft.next_fast_len(2 * bank.taps, real=True)
    frequency_hz = np.fft.rfftfreq(length, 1.0 / bank.sample_rate_hz)
    start_hz, stop_hz = bank.band_hz if bank.band_hz is not None else (0.0, np.inf)
    in_band = np.flatnonzero((frequency_hz >= start_hz) & (frequency_hz <= stop_hz))
    band = slice(int(in_band[0]), int(in_band[-1]) + 1)
    measured = np.flatnonzero(bank.status)
    for rows in np.split(measured, range(CHUNK, len(measured), CHUNK)):
        true = rig.truth_spectra(bank.position_mm[rows], bank.taps, length, band, bank.sample_rate_hz)
        for row, spectra in zip(rows.tolist(), true, strict=True):
            wrong = scipy_fft.rfft(bank.green(row).astype(np.float32, copy=False), length)[:, band] - spectra
            relative = np.linalg.norm(wrong, axis=1) / np.linalg.norm(spectra, axis=1)
            error_db[row] = 20.0 * np.log10(np.maximum(relative, np.finfo(np.float64).tiny))
    return error_db
