"""Estimators side by side, and error against hours of measuring.

Estimators: error of the Green's functions against run time, in one process.

The workload: 24 damped modes between 20 and 500 Hz, 200 ms; a
linear sweep of 3 s at 10 kHz with 0.5 s of silence, three times; 40 dB signal-to-noise ratio on the response,
60 dB on each record's own reference. Error: relative L2 of the 20-500 Hz spectrum of the first 200 ms.

Hours: the campaign is that of the paper on the virtual rig, 1500 positions, 20 actuators, 20-500 Hz, responses of
200 ms. Some positions are measured through the engine into a bank; hours are those of the rig's own clock, times the
positions, and errors those of the same positions against the rig's truth.
"""

import tempfile
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import scipy.fft
import scipy.signal
from numpy.typing import NDArray

from wavefocus.benchmarks.harness import Entry, Findings, Mark, band_error_db, measure
from wavefocus.benchmarks.rig_bank import TAPS, compare_with_truth, default_grid, measure_bank, rig_setup, sweep_plan
from wavefocus.calibration.estimator.sequential import SequentialEstimator
from wavefocus.calibration.excitation import PlayedExcitation
from wavefocus.mocks.virtual.rig import VirtualRig
from wavefocus.mocks.virtual.settings import VirtualSettings
from wavefocus.storage.bank.reading import open_bank

Float64Array = NDArray[np.float64]

NIGHT = 1500


def _measuring_times(*, quick: bool = False) -> list[Entry]:
    """Error of a campaign against its hours: length and number of sweeps, one after another and all at once."""
    # With the converter's rounding this leaves sequential capture at the -60 dB of the comparison.
    settings = VirtualSettings(dropout_probability=0.0, noise_v=1.2e-4)
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
        began_s = setup.clock.now_s()
        measure_bank(path, plan, setup)
        took_s = setup.clock.now_s() - began_s
        with open_bank(path) as bank:
            error_db = compare_with_truth(bank, rig)
    # Commits and other overhead that the rig's clock does not see, as the plan estimates them.
    planned_s = max(took_s / positions, plan.position_s(setup))
    median_db, worst_tenth_db = np.percentile(error_db, [50, 90]).tolist()
    return {"hours": NIGHT * planned_s / 3600, "median_db": median_db, "worst_tenth_db": worst_tenth_db}


OFFSET = 200
RESPONSE_SNR_DB = 40.0
REFERENCE_SNR_DB = 60.0
PYFAR = "pyfar deconvolve, whole records"

Method = Callable[[NDArray[np.float32], NDArray[np.float32]], NDArray[Any]]


@dataclass(frozen=True, slots=True)
class _Workload:
    """Records with their true Green's functions."""

    excitation: PlayedExcitation
    truth: NDArray[np.float64]
    reference: NDArray[np.float32]
    response: NDArray[np.float32]


def run(out: Path, *, quick: bool = False) -> Findings:
    """Time every estimator in turns on one thread; then the hours of campaigns."""
    work = _make_workload(records=8 if quick else 20)
    records, sweep = len(work.truth), work.excitation
    estimator = SequentialEstimator(sweep, TAPS)
    methods: dict[str, Method] = {
        "wavefocus": lambda x, y: estimator.estimate(x, y, range_v=(10.0, 1e3)).green,
        "plain H1, band mask, cut at 0": _plain_h1(sweep),
    }
    notes = []
    try:
        methods |= _pyfar_methods(sweep)
    except ImportError as error:
        notes.append(f"{error.name} is not installed; 'pip install wavefocus[bench]' adds the comparison.")
    actions = {name: partial(method, work.reference, work.response) for name, method in methods.items()}
    found = measure(actions, 3 if quick else 7, warm=True, memory=True)
    points = []
    for name, timing in found.items():
        error_db = band_error_db(timing.result, work.truth, sweep.sample_rate_hz, sweep.band_hz, sweep.period_samples)
        point = Entry(
            work=f"estimating {records} records on one thread",
            method=name,
            error=10 ** (float(np.median(error_db)) / 20),
            timing=timing,
            figures={
                "ms_a_record": 1e3 * timing.wall_s / records,
                "median_db": float(np.median(error_db)),
                "worst_db": float(error_db.max()),
            },
            marks=(Mark("times", 6.0), Mark("median_db", -65.0, at_most=True)) if name == "wavefocus" else (),
        )
        points.append(point.against(found[PYFAR]) if PYFAR in found else point)
    points += _measuring_times(quick=quick)
    return Findings(points, "the plate's true Green's functions, relative L2 in band", notes)


def _make_workload(records: int) -> _Workload:
    """Records of random damped modes, clocks in step, noise on both channels."""
    draw = np.random.default_rng(0)
    excitation = PlayedExcitation(10_000.0, 20.0, 500.0, 3.0, 0.5, 1.0, 3)
    time_s = np.arange(TAPS) / excitation.sample_rate_hz
    truth = np.zeros((records, TAPS))
    for record in range(records):
        for hertz in draw.uniform(20, 500, 24):
            decay = np.exp(-time_s * draw.uniform(25, 60))
            truth[record] += draw.standard_normal() * decay * np.sin(2 * np.pi * hertz * time_s)
    signal = excitation.signal_v()
    samples = OFFSET + signal.size + 1000
    length = scipy.fft.next_fast_len(samples + TAPS, real=True)
    placed = np.zeros(samples)
    placed[OFFSET : OFFSET + signal.size] = signal
    spectrum = scipy.fft.rfft(placed, length)
    response = np.stack([scipy.fft.irfft(spectrum * scipy.fft.rfft(g, length), length)[:samples] for g in truth])
    sounding = slice(OFFSET, OFFSET + signal.size)
    noise_v = np.sqrt((response[:, sounding] ** 2).mean(axis=1)) * 10 ** (-RESPONSE_SNR_DB / 20)
    reference_noise_v = np.sqrt((signal**2).mean()) * 10 ** (-REFERENCE_SNR_DB / 20)
    response += noise_v[:, None] * draw.standard_normal(response.shape)
    reference = placed + reference_noise_v * draw.standard_normal(response.shape)
    return _Workload(excitation, truth, reference.astype(np.float32), response.astype(np.float32))


def _repeats(recording: NDArray[np.float32], excitation: PlayedExcitation) -> NDArray[np.float32]:
    """Repeats (records, averages, period), cut at their true start."""
    length = excitation.averages * excitation.period_samples
    return recording[:, OFFSET : OFFSET + length].reshape(recording.shape[0], excitation.averages, -1)


def _plain_h1(excitation: PlayedExcitation) -> Method:
    hertz = np.arange(excitation.period_samples // 2 + 1) * excitation.sample_rate_hz / excitation.period_samples
    mask = ((hertz >= excitation.start_hz) & (hertz <= excitation.stop_hz)).astype(np.float32)

    def method(reference: NDArray[np.float32], response: NDArray[np.float32]) -> NDArray[Any]:
        x = scipy.fft.rfft(_repeats(reference, excitation))
        y = scipy.fft.rfft(_repeats(response, excitation))
        h1 = mask * (x.conj() * y).sum(axis=1) / (np.abs(x) ** 2).sum(axis=1)
        return np.asarray(scipy.fft.irfft(h1)[:, :TAPS])

    return method


def _pyfar_methods(excitation: PlayedExcitation) -> dict[str, Method]:
    import pyfar

    rate, band = excitation.sample_rate_hz, excitation.band_hz

    def deconvolve(x: NDArray[Any], y: NDArray[Any], edges: tuple[float, float], **options: Any) -> NDArray[Any]:
        found = pyfar.dsp.deconvolve(pyfar.Signal(y, rate), pyfar.Signal(x, rate), frequency_range=edges, **options)
        return np.asarray(found.time[:, :TAPS])

    def averaged(channel: NDArray[np.float32]) -> NDArray[np.float32]:
        return np.asarray(_repeats(channel, excitation).mean(axis=1))

    # Of 108 combinations of edges and regularisation on this workload.
    wide = (5.0, 550.0)
    return {
        PYFAR: lambda x, y: deconvolve(x, y, band),
        "pyfar, averaged, best settings found": lambda x, y: deconvolve(
            averaged(x), averaged(y), wide, regu_inside=1e-10, regu_outside=1e-4
        ),
    }
