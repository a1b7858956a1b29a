"""Long responses at audio rates: what `wavefocus estimate` takes for records of 48 kHz and 12,000 taps.

The workload: 10 records of a linear sweep from 20 Hz to 20 kHz in 3 s, of
which the file says nothing but the band; responses of 40 echoes within 250 ms, 40 dB signal-to-noise ratio, clocks
37 ppm apart. Error: relative L2 of the spectrum in band. Time and memory are those of the whole command, in a process
of its own.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.processes import run_command
from storage.bank.reading import open_bank
from storage.raw.header import RawHeader
from storage.raw.schedule import sequential
from storage.raw.writer import RawWriter, create_raw

RATE_HZ, BAND_HZ, SWEEP_S, PPM = 48_000.0, (20.0, 20_000.0), 3.0, 37.0
START_S, TAIL_S = 0.03, 0.28
ECHOES, SNR_DB = 40, 40.0
MARK_S, MARK_MB = 20.0, 500.0


def run(*, quick: bool = False) -> dict[str, Any]:
    """Record, estimate and print.

    Returns `audio_rate`: processor seconds, megabytes, worst error and the noise's limit in dB; `marks`.
    """
    records, taps = (2, 2_000) if quick else (10, 12_000)
    with tempfile.TemporaryDirectory() as folder:
        raw, bank = Path(folder) / "audio.raw.h5", Path(folder) / "bank.h5"
        truth, samples = _write(raw, records, taps)
        done = run_command("estimate", raw, "--bank", bank)
        with open_bank(bank) as view:
            green = view.green(0).astype(np.float64)
    error_db = _error_db(green, truth)
    limit_db = -SNR_DB + 10 * np.log10(taps / samples * (BAND_HZ[1] - BAND_HZ[0]) / (RATE_HZ / 2))
    figures = {
        "records": records,
        "taps": taps,
        "processor_s": done.processor_s,
        "peak_mb": done.peak_bytes / 1e6,
        "worst_error_db": float(error_db.max()),
        "noise_limit_db": float(limit_db),
    }
    print(
        f"{records} records at {RATE_HZ:g} Hz, {taps} taps: {done.processor_s:.1f} s of processor time, "
        f"{figures['peak_mb']:.0f} MB, worst error {figures['worst_error_db']:.1f} dB "
        f"(the noise alone {limit_db:.1f} dB)"
    )
    marks = {
        f"48 kHz, {taps} taps, {records} records: at most {MARK_S:g} s": done.processor_s <= MARK_S,
        f"48 kHz, {taps} taps, {records} records: at most {MARK_MB:g} MB": done.peak_bytes <= 1e6 * MARK_MB,
    }
    return {"audio_rate": figures, "marks": marks}


def _sweep(time_s: NDArray[np.float64]) -> NDArray[np.float64]:
    low, high = BAND_HZ
    inside = (time_s >= 0) & (time_s < SWEEP_S)
    since = np.where(inside, time_s, 0.0)
    fade = np.sin(np.pi / 2 * np.clip(np.minimum(since, SWEEP_S - since) / 0.01, 0, 1)) ** 2
    return np.asarray(inside * fade * np.sin(2 * np.pi * (low * since + (high - low) * since**2 / (2 * SWEEP_S))))


def _write(path: Path, records: int, taps: int) -> tuple[NDArray[np.float64], int]:
    """Write the raw file; return the truth (records, taps) and the samples of a record."""
    draw = np.random.default_rng(0)
    samples = round((START_S + SWEEP_S + TAIL_S) * RATE_HZ)
    time_s = np.arange(samples) / (RATE_HZ * (1 + 1e-6 * PPM)) - START_S
    truth, clean = np.zeros((records, taps)), _sweep(time_s)
    channels = np.zeros((2, records, samples), dtype=np.float32)
    for record in range(records):
        place = draw.choice(taps, ECHOES, replace=False)
        truth[record, place] = draw.standard_normal(ECHOES) * np.exp(-3.0 * place / taps)
        response = sum(truth[record, tap] * _sweep(time_s - tap / RATE_HZ) for tap in place.tolist())
        noise = 10 ** (-SNR_DB / 20) * np.std(response) * draw.standard_normal(samples)
        channels[0, record] = clean + 1e-3 * clean.std() * draw.standard_normal(samples)
        channels[1, record] = response + noise
    step_v = [1.02 * float(np.abs(channel).max()) / 32768 for channel in channels]
    header = RawHeader(
        sample_rate_hz=RATE_HZ,
        samples=samples,
        taps=taps,
        band_hz=BAND_HZ,
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


def _error_db(green: NDArray[np.float64], truth: NDArray[np.float64]) -> NDArray[np.float64]:
    length = 4 * truth.shape[1]
    hertz = np.arange(length // 2 + 1) * RATE_HZ / length
    band = (hertz >= BAND_HZ[0]) & (hertz <= BAND_HZ[1])
    wrong, right = (np.abs(np.fft.rfft(one, length)[:, band]) ** 2 for one in (green - truth, truth))
    return np.asarray(10 * np.log10(wrong.sum(axis=1) / right.sum(axis=1)))
