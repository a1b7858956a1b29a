"""Nights on the virtual rig: error against hours of measuring, and recordings streamed into a bank.

The campaign is that of the paper: 1500 positions, 20 actuators, 20-500 Hz, responses of 200 ms. Hours are those of the
rig's own clock over the positions that were measured, the whole way through the engine into a bank, times the
positions of it; errors are those of the same positions against the rig's truth.

Recordings that are streamed are a sample of a campaign with records of the same size, so that the figure per signal is
the campaign's. Two free cores do as many a second as their processor time allows; on a shared machine
wall time means less.

Long responses at audio rates: 10 records of a linear sweep from 20 Hz to 20 kHz in 3 s at 48 kHz, of which the raw file
says nothing but the band; responses of 40 echoes within 250 ms, 12,000 taps, 40 dB signal-to-noise ratio, clocks 37 ppm
apart. Error: relative L2 of the spectrum in band. Time and memory are those of the whole command.
"""

from __future__ import annotations

import json
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft
import scipy.signal
from numpy.typing import NDArray

from wavefocus.acquisition.plan import Plan
from wavefocus.acquisition.plays import keep_recordings, measuring_of, raw_header
from wavefocus.acquisition.setup import point_at, take_record
from wavefocus.benchmarks.harness import Entry, Mark, Times, band_error_db
from wavefocus.benchmarks.machine import run_command
from wavefocus.benchmarks.rig_bank import BAND_HZ, RATE_HZ, TAPS, default_grid, measure, rig_setup, sweep_plan
from wavefocus.drivers.protocols import Recording, RecordLabel
from wavefocus.mocks.virtual.rig import VirtualRig, VirtualSettings
from wavefocus.storage.bank.reading import open_bank
from wavefocus.storage.raw.header import RawHeader, sequential
from wavefocus.storage.raw.writer import RawWriter, create_raw

Float64Array = NDArray[np.float64]

NIGHT = 1500
# With the converter's rounding this leaves sequential capture at the -60 dB of the comparison.
NOISE_V = 1.2e-4

MARK_PER_S = 800.0
MARK_MB = 500.0
# Positions that are recorded; the others repeat them, for the estimator does not mind.
DIFFERENT = 4
# A campaign is longer than the loading of modules, the sample is not.
PRELOADED = ("scipy.optimize", "scipy.signal", "wavefocus.estimation", "wavefocus.campaign.blueprint")


def measuring_times(*, quick: bool = False) -> list[Entry]:
    """Error of a campaign against its hours: length and number of sweeps, one after another and all at once."""
    settings = VirtualSettings(dropout_probability=0.0, noise_v=NOISE_V)
    positions = 3 if quick else 12
    sequential = [(s, n) for s in (0.5, 1.0, 2.0) for n in (1, 3)] if not quick else [(0.5, 1), (1.0, 3)]
    schedules: list[tuple[str, dict[str, Any]]] = [
        *(("sequential", {"sweep_s": sweep_s, "averages": averages}) for sweep_s, averages in sequential),
        *(("staggered", {"periods": periods}) for periods in ((1, 2) if quick else (1, 2, 4, 8))),
    ]
    points = []
    for method, parameters in schedules:
        night = _night(settings, positions, staggered=method == "staggered", **parameters)
        points.append(
            Entry(
                work=f"measuring {NIGHT} x 20 responses, {positions} positions of it tried",
                method=method, parameters=parameters, error=10 ** (night["median_db"] / 20), figures=night,
            )
        )  # fmt: skip
    return points


def _night(settings: VirtualSettings, positions: int, **schedule: Any) -> dict[str, float]:
    """Measure some positions of the campaign, evenly spread, through the engine into a bank."""
    rig = VirtualRig(settings)
    rows = np.linspace(0, NIGHT - 1, positions).round().astype(np.int64)
    plan = sweep_plan(default_grid(rig)[rows], rig, **schedule)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "night.h5"
        setup = rig_setup(rig)
        began_s = setup.instruments.clock.now_s()
        measure(path, plan, setup)
        took_s = setup.instruments.clock.now_s() - began_s
        with open_bank(path) as bank:
            green = np.stack([bank.green(row) for row in range(positions)])
    error_db = _errors_db(rig, plan, green)
    # Commits and other overhead that the rig's clock does not see, as the plan estimates them.
    planned_s = max(took_s / positions, plan.position_s(setup))
    median_db, worst_tenth_db = np.percentile(error_db, [50, 90]).tolist()
    return {"hours": NIGHT * planned_s / 3600, "median_db": median_db, "worst_tenth_db": worst_tenth_db}


def _errors_db(rig: VirtualRig, plan: Plan, green: NDArray[np.generic]) -> Float64Array:
    length = scipy.fft.next_fast_len(2 * TAPS, real=True)
    hertz = np.fft.rfftfreq(length, 1 / RATE_HZ)
    inside = np.flatnonzero((hertz >= BAND_HZ[0]) & (hertz <= BAND_HZ[1]))
    band = slice(int(inside[0]), int(inside[-1]) + 1)
    found = []
    for row, here in enumerate(plan.position_mm):
        true = rig.truth_spectra(here[None], TAPS, length, band, RATE_HZ)[0]
        wrong = scipy.fft.rfft(green[row], length)[:, band] - true
        found.append(20 * np.log10(np.linalg.norm(wrong, axis=1) / np.linalg.norm(true, axis=1)))
    return np.stack(found)


def stream_recordings(*, quick: bool = False) -> list[Entry]:
    """Record samples of campaigns and stream them into banks."""
    points = []
    with tempfile.TemporaryDirectory() as folder:
        for name, positions in (("sequential 3 x 1 s", 4 if quick else 50), ("staggered 240 ms", 20 if quick else 300)):
            raw = Path(folder) / f"{positions}.raw.h5"
            record_sample(raw, positions, staggered=name.startswith("staggered"))
            points.append(_streamed(name, raw, positions))
            raw.unlink()
    return points


def record_sample(path: Path, positions: int, *, staggered: bool) -> None:
    """Keep recordings of the virtual rig, a few positions over and over."""
    rig = VirtualRig()
    setup = rig_setup(rig)
    position_mm = default_grid(rig)[np.linspace(0, NIGHT - 1, positions).astype(int)]
    plan = replace(sweep_plan(position_mm, rig, staggered=staggered), sha256="")
    measuring = measuring_of(plan, setup)
    taken: list[list[Recording]] = []
    for position in range(min(DIFFERENT, positions)):
        point_at(setup, *position_mm[position])
        taken.append(
            [
                play.cut(
                    take_record(setup, play.signals_v, RATE_HZ, RecordLabel(position, 1, play.actuator), play.samples)
                )
                for play in measuring.plays
            ]
        )
    create_raw(path, raw_header(plan, setup, rig_json="", run_json="", software="wavefocus bench estimate"))
    with RawWriter.open(path) as raw:
        for position in range(positions):
            keep_recordings(raw, position, taken[position % len(taken)])


def _streamed(name: str, raw: Path, positions: int) -> Entry:
    bank = raw.with_suffix(".bank.h5")
    done = run_command("estimate", raw, "--bank", bank, "--json", preload=PRELOADED)
    facts = json.loads(done.stdout.splitlines()[-1])
    processor_ms = 1e3 * done.processor_s / (positions * 20)
    bank.unlink()
    size_gb = raw.stat().st_size / 1e9
    return Entry(
        work="recordings into a bank, Green's functions a second",
        method=name,
        timing=Times(done.wall_s, done.processor_s),
        peak_mb=done.peak_bytes / 1e6,
        figures={
            "per_s": float(facts["green_functions_per_s"]),
            "per_s_two_free_cores": 2e3 / processor_ms,
            "sample_gb": size_gb,
            "night_gb": size_gb * NIGHT / positions,
            "night_minutes": NIGHT * 20 * processor_ms / 2e3 / 60,
        },
        marks=(Mark("per_s_two_free_cores", MARK_PER_S), Mark("peak_mb", MARK_MB, at_most=True)),
    )


AUDIO_HZ, AUDIO_BAND_HZ, SWEEP_S, PPM = 48_000.0, (20.0, 20_000.0), 3.0, 37.0
START_S, TAIL_S = 0.03, 0.28
ECHOES, SNR_DB = 40, 40.0
MARK_S = 20.0


def estimate_audio(*, quick: bool = False) -> list[Entry]:
    """Record and estimate long responses at audio rates."""
    records, taps = (2, 2_000) if quick else (10, 12_000)
    with tempfile.TemporaryDirectory() as folder:
        raw, bank = Path(folder) / "audio.raw.h5", Path(folder) / "bank.h5"
        truth, samples = _write(raw, records, taps)
        done = run_command("estimate", raw, "--bank", bank)
        with open_bank(bank) as view:
            green = view.green(0).astype(np.float64)
    error_db = band_error_db(green, truth, AUDIO_HZ, AUDIO_BAND_HZ, 4 * taps)
    limit_db = -SNR_DB + 10 * np.log10(taps / samples * (AUDIO_BAND_HZ[1] - AUDIO_BAND_HZ[0]) / (AUDIO_HZ / 2))
    return [
        Entry(
            work=f"{records} records at {AUDIO_HZ:g} Hz, {taps} taps",
            method="wavefocus estimate",
            timing=Times(done.wall_s, done.processor_s),
            peak_mb=done.peak_bytes / 1e6,
            figures={"worst_db": float(error_db.max()), "noise_limit_db": float(limit_db)},
            marks=(Mark("cpu_s", MARK_S, at_most=True), Mark("peak_mb", MARK_MB, at_most=True)),
        )
    ]


def _sweep(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    low, high = AUDIO_BAND_HZ
    inside = (time_s >= 0) & (time_s < SWEEP_S)
    since = np.where(inside, time_s, 0.0)
    fade = np.sin(np.pi / 2 * np.clip(np.minimum(since, SWEEP_S - since) / 0.01, 0, 1)) ** 2
    return np.asarray(inside * fade * np.sin(2 * np.pi * (low * since + (high - low) * since**2 / (2 * SWEEP_S))))


def _write(path: Path, records: int, taps: int) -> tuple[NDArray[np.float64], int]:
    """Write the raw file; return the truth (records, taps) and the samples of a record."""
    draw = np.random.default_rng(0)
    samples = round((START_S + SWEEP_S + TAIL_S) * AUDIO_HZ)
    time_s = np.arange(samples) / (AUDIO_HZ * (1 + 1e-6 * PPM)) - START_S
    truth, clean = np.zeros((records, taps)), _sweep(time_s)
    channels = np.zeros((2, records, samples), dtype=np.float32)
    for record in range(records):
        place = draw.choice(taps, ECHOES, replace=False)
        truth[record, place] = draw.standard_normal(ECHOES) * np.exp(-3.0 * place / taps)
        response = sum(truth[record, tap] * _sweep(time_s - tap / AUDIO_HZ) for tap in place.tolist())
        noise = 10 ** (-SNR_DB / 20) * np.std(response) * draw.standard_normal(samples)
        channels[0, record] = clean + 1e-3 * clean.std() * draw.standard_normal(samples)
        channels[1, record] = response + noise
    step_v = [1.02 * float(np.abs(channel).max()) / 32768 for channel in channels]
    header = RawHeader(
        sample_rate_hz=AUDIO_HZ,
        samples=samples,
        taps=taps,
        band_hz=AUDIO_BAND_HZ,
        schedule=sequential(records),
        position_mm=np.zeros((1, 2)),
        actuator_mm=np.zeros((records, 2)),
        response_per_volt=1.0,
        volts_per_count=(step_v[0], step_v[1]),
    )
    create_raw(path, header)
    with RawWriter.open(path) as writer:
        writer.commit(0, *channels)
    return truth, samples
