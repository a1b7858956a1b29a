"""Draw the picture of docs/explanation/how-a-recording-becomes-a-greens-function.md from one virtual record.

python -m tools.explanation_pictures docs/pictures
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np

from calibration.estimator.sequential import Estimator
from calibration.excitation.sweeps import Excitation
from mocks.virtual.rig import VirtualRig

RATE_HZ, TAPS, PPM, START = 10_000.0, 2000, 30e-6, 412.37
PLACE_MM, ACTUATOR = (22.0, 12.0), 3
NOISE_V, M_S_PER_V = 5e-3, 0.125


def draw(folder: Path) -> None:
    """Write recording-to-green.png into a folder."""
    from matplotlib.figure import Figure

    excitation = Excitation(RATE_HZ, 20.0, 500.0, 1.0, 0.2, 1.0, 3)
    truth = VirtualRig().truth(*PLACE_MM, TAPS)[ACTUATOR] / M_S_PER_V
    reference, response = _record(excitation, truth)
    found = Estimator(excitation, TAPS).estimate(reference[None], response[None], range_v=(10.0, 10.0))
    green, period = found.green[0].astype(np.float64), excitation.period_samples
    hertz = np.fft.rfftfreq(period, 1 / RATE_HZ)
    band = (hertz >= 20) & (hertz <= 500)
    repeats = [
        np.fft.rfft(channel[round(START) :][: 3 * period].reshape(3, period))[:, band]
        for channel in (reference, response)
    ]
    averaged = (repeats[0].conj() * repeats[1]).sum(axis=0) / np.square(np.abs(repeats[0])).sum(axis=0)
    fitted, wanted = (np.fft.rfft(fir, period)[band] for fir in (green, truth))

    figure = Figure(figsize=(11, 6.6), layout="constrained")
    axes = figure.subplots(2, 2)
    time_s = np.arange(len(reference)) / RATE_HZ
    axes[0, 0].plot(time_s, reference, lw=0.5, color="#777777", label="reference (V)")
    times = round(1 / float(np.abs(response).max()))
    axes[0, 0].plot(time_s, times * response - 2.4, lw=0.5, color="#0b5fa5", label=f"response ({times} x V)")
    axes[0, 0].set(
        title="1  record: three sweeps, both DAQ channels", xlabel="DAQ time (s)", yticks=[], ylim=(-4.6, 1.2)
    )
    axes[0, 0].legend(loc="lower right", fontsize=8, ncols=2)

    def level_db(spectrum: np.ndarray) -> np.ndarray:
        return np.asarray(20 * np.log10(np.abs(spectrum)))

    axes[0, 1].plot(hertz[band], level_db(averaged), lw=0.7, color="#bbbbbb", label="averaged quotient H")
    axes[0, 1].plot(hertz[band], level_db(fitted), lw=1.2, color="#0b5fa5", label="causal FIR of 2000 taps")
    axes[0, 1].set(title="2  transfer function", xlabel="frequency (Hz)", ylabel="dB re 1 V/V")
    axes[0, 1].legend(loc="lower right", fontsize=8)
    axes[1, 0].plot(hertz[band], level_db(averaged - wanted), lw=0.6, color="#bbbbbb", label="error of H")
    axes[1, 0].plot(hertz[band], level_db(fitted - wanted), lw=1.0, color="#b3541e", label="error of the FIR")
    axes[1, 0].set(title="3  error against the plate's true response", xlabel="frequency (Hz)", ylabel="dB re 1 V/V")
    axes[1, 0].legend(loc="lower right", fontsize=8)
    tap_ms = 1e3 * np.arange(TAPS) / RATE_HZ
    axes[1, 1].plot(tap_ms, _in_band(green, period, band), lw=1.4, color="#0b5fa5", label="estimated, 20-500 Hz")
    axes[1, 1].plot(tap_ms, _in_band(truth, period, band), lw=0.8, ls="--", color="#222222", label="true, 20-500 Hz")
    axes[1, 1].set(title="4  Green's function", xlabel="time (ms)", ylabel="V/V per sample", xlim=(0, 80))
    axes[1, 1].legend(loc="upper right", fontsize=8)
    for one in axes.ravel():
        one.title.set_fontsize(10)
        one.spines[["top", "right"]].set_visible(False)
    folder.mkdir(parents=True, exist_ok=True)
    figure.savefig(folder / "recording-to-green.png", dpi=110)
    error_db = 10 * np.log10(np.sum(np.abs(fitted - wanted) ** 2) / np.sum(np.abs(wanted) ** 2))
    print(f"clock {1e6 * (found.clock_ratio[0] - 1):.3f} ppm, start {found.offset_samples[0]:.4f} samples")
    print(f"residual {found.residual_db[0]:.1f} dB, error {error_db:.1f} dB")


def _record(excitation: Excitation, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Reference and response of one record on the DAQ's clock, with noise: float32 (samples,) each."""
    from scipy.interpolate import CubicSpline
    from scipy.signal import resample

    played = np.concatenate([excitation.signal_v(), np.zeros(4000)])
    answer = np.convolve(played, truth)[: len(played)]
    place = (np.arange(len(played) + 1000) - START) / (1 + PPM)
    draw = np.random.default_rng(1)
    channels = []
    for signal, noise_v in ((played, 1e-4), (answer, NOISE_V)):
        finer = resample(signal, 8 * len(signal))
        wave = CubicSpline(np.arange(len(finer)) / 8, finer)(np.clip(place, 0.0, len(signal) - 1.0))
        channels.append((wave + noise_v * draw.standard_normal(len(place))).astype(np.float32))
    return channels[0], channels[1]


def _in_band(fir: np.ndarray, period: int, band: np.ndarray) -> np.ndarray:
    """A FIR without what lies outside of a band."""
    spectrum = np.fft.rfft(fir, period)
    return np.asarray(np.fft.irfft(np.where(band, spectrum, 0), period)[: len(fir)])


if __name__ == "__main__":
    draw(Path(sys.argv[1]))
